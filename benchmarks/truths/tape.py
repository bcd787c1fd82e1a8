# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Voltages for judging a diagnosis, put together independently of the package's programs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
import math

import numpy as np

from .cores import Array

Label = tuple[str, int, int]

#: top speed of the moves between segments [V/s]
SPEED = 40.0


class Tape:
    """
    Pieces of a motion in a row; every piece is joined to the one before by a soft move.

    `rate`: [Hz]; `speed`: top speed of the moves, in units of the motion a second; `level`: where
    it starts; `pace`: factor by which all but moves, rests and jumps are shorter.
    """

    def __init__(self, rate: float, speed: float, level: float = 0.0, pace: float = 1.0) -> None:
        self.rate, self.speed, self.level, self.pace = rate, speed, level, pace
        self.pieces: list[Array] = []
        self.labels: list[Label] = []
        self.n = 0

    def add(self, label: str, u: Array) -> None:
        if self.labels and self.labels[-1][0] == label:
            label += ':2' if ':' not in label else '-2'
        self.pieces.append(u)
        self.labels.append((label, self.n, self.n + u.size))
        self.n += u.size
        self.level = float(u[-1])

    def move(self, level: float) -> None:
        if abs(level - self.level) > 1e-9:
            self.add('ramp', self.way(self.level, level))

    def way(self, start: float, stop: float) -> Array:
        """Return half a cosine, at most `speed` steep."""
        n = max(2, math.ceil(0.5 * math.pi * abs(stop - start) / self.speed * self.rate))
        return start + (stop - start) * 0.5 * (1 - np.cos(np.pi * np.arange(1, n + 1) / n))

    def rest(self, label: str, seconds: float) -> None:
        self.add(label, np.full(max(2, round(seconds * self.rate)), self.level))

    def corners(self, label: str, levels: Sequence[float], slope: float) -> None:
        """Go straight from level to level, from the first on."""
        self.move(levels[0])
        parts = []
        for a, b in pairwise(levels):
            n = max(1, round(abs(b - a) / slope * self.pace * self.rate))
            parts.append(a + (b - a) * np.arange(1, n + 1) / n)
        self.add(label, np.concatenate(parts))

    def stairs(self, label: str, levels: Sequence[float], holds: Sequence[float]) -> None:
        parts, level = [], self.level
        for target, hold in zip(levels, holds, strict=True):
            n = round(hold * self.pace * self.rate)
            parts += [self.way(level, target), np.full(n, target)]
            level = target
        self.add(label, np.concatenate(parts))


class _Voltages(Tape):
    """A tape of volts."""

    def sine(
        self, label: str, bias: float, amplitude: float, frequency: float, periods: int
    ) -> None:
        """Start and end at the lowest point, at rest."""
        self.move(bias - amplitude)
        n = round(periods / frequency * self.rate)
        angle = 2 * np.pi * frequency * np.arange(1, n + 1) / self.rate
        self.add(label, bias - amplitude * np.cos(angle))

    def multisine(
        self,
        label: str,
        bias: float,
        amplitude: float,
        lines: Array,
        period: float,
        periods: int,
        rng: np.random.Generator,
    ) -> None:
        t = np.arange(1, round(period * self.rate) + 1) / self.rate
        best: Array | None = None
        for _ in range(8):
            phase = rng.uniform(0, 2 * np.pi, lines.size)
            x = np.zeros(t.size)
            for line, angle in zip(lines, phase, strict=True):
                x += np.cos(2 * np.pi * line / period * t + angle)
            x /= np.abs(x).max()
            if best is None or x.std() > best.std():
                best = x
        assert best is not None
        # begun where it is slow
        start = int(np.argmin(np.abs(np.gradient(best)) + 0.01 * np.abs(best)))
        v = bias + amplitude * np.tile(np.roll(best, -start - 1), periods)
        self.move(float(v[-1]))
        self.add(label, v)

    def result(self) -> tuple[Array, Array, list[Label]]:
        v = np.clip(np.concatenate(self.pieces), 0.0, 10.0)
        return np.arange(v.size) / self.rate, v, self.labels


def program(
    kind: str, seed: int = 0, sample_rate: float = 20000.0
) -> tuple[Array, Array, list[Label]]:
    """
    Return time [s], command [V] and labelled segments, from rest to rest at 0 V.

    `kind`: {'diagnosis', 'unseen'}: About 17 s that show every effect; about 12 s with other
    frequencies, levels and holds; `seed`: of the phases of the multisine and the order of the
    levels; `sample_rate`: [Hz].
    """
    rng = np.random.default_rng([55, seed])
    tape = _Voltages(sample_rate, SPEED)
    if kind == 'diagnosis':
        _diagnosis(tape, rng)
    elif kind == 'unseen':
        _unseen(tape, rng)
    else:
        raise ValueError(f'program must be diagnosis or unseen, got {kind!r}')
    return tape.result()


def _diagnosis(tape: _Voltages, rng: np.random.Generator) -> None:
    tape.rest('idle', 1.0)
    tape.sine('sine:1Hz', 5.0, 5.0, 1.0, 3)
    tape.sine('sine:80Hz-large', 5.0, 4.5, 80.0, 56)
    tape.sine('sine:80Hz-small', 5.0, 1.5, 80.0, 56)
    tape.move(0.0)
    up = [2.6, 5.2, 9.6] if rng.random() < 0.5 else [3.4, 6.1, 9.6]
    tape.stairs('staircase:up', up, [0.3, 0.8, 2.0])
    tape.stairs('staircase:down', [6.4, 3.1, 0.4], [0.5, 1.2, 0.3])
    for bias in (2.5, 5.0, 7.5):
        low, high = bias - 1.5, bias + 1.5
        tape.corners(f'triangle:minor-{bias:g}V', [low, high, low, high, low], 20.0)
    lines = np.arange(1.0, 200.0, 2.0)
    # one line in four stays silent, so that odd nonlinearity shows there
    kept = lines[rng.permutation(lines.size) % 4 > 0]
    tape.multisine('multisine', 5.0, 4.4, kept, 1.0, 2, rng)
    tape.corners('triangle:fast', [0.0, 10.0] * 4 + [0.0], 120.0)
    tape.rest('idle', 0.6)


def _unseen(tape: _Voltages, rng: np.random.Generator) -> None:
    tape.rest('idle', 0.3)
    tape.sine('sine:3Hz', 4.2, 3.9, 3.0, 5)
    tape.sine('sine:35Hz', 5.5, 4.0, 35.0, 25)
    tape.sine('sine:110Hz', 4.6, 3.6, 110.0, 60)
    tape.move(7.2 if rng.random() < 0.5 else 6.7)
    tape.rest(f'hold:{tape.level:g}V', 3.0)
    tape.move(1.8)
    tape.rest('hold:1.8V', 0.7)
    swings = [4.6, 4.0, 3.4, 2.8, 2.2, 1.6, 1.0, 0.4]
    levels = [5.0]
    for swing in swings:
        levels += [5.0 + swing, 5.0 - swing]
    tape.corners('triangle:decaying', levels, 45.0)
    tape.sine('sine:17Hz', 7.0, 2.0, 17.0, 12)
    tape.corners('triangle:minor-3.5V', [2.5, 4.5, 2.5, 4.5, 2.5], 8.0)
    tape.move(0.0)
    tape.rest('idle', 0.4)


def other_axis(t: Array, rng: np.random.Generator) -> Array:
    """Return another axis's voltage [V], shape (n,): a 7 Hz class triangle and three sines."""
    frequency = rng.uniform(5.0, 9.0)
    swing = np.abs(((t * frequency + 1e-12) % 1.0) * 2 - 1)
    v = 2.2 * (1 - swing)
    for f in rng.uniform([0.2, 15.0, 55.0], [0.6, 25.0, 90.0]):
        phase = rng.uniform(0, 2 * np.pi)
        v = v + 0.7 * (1 + np.sin(2 * np.pi * f * t + phase))
    # from rest, and back to it
    soft = np.clip(np.minimum(t - t[0], t[-1] - t) / 0.3, 0.0, 1.0)
    return np.asarray(v * 0.5 * (1 - np.cos(np.pi * soft)))


def table_one_sines(sample_rate: float = 20000.0) -> tuple[Array, Array, list[Label]]:
    """Return the published six sines, v = 5 + 5 sin(2 pi f t), each reached by a soft move."""
    tape = _Voltages(sample_rate, SPEED)
    tape.rest('idle', 0.2)
    for f, periods in ((1, 3), (10, 20), (50, 75), (80, 120), (100, 150), (120, 180)):
        tape.sine(f'sine:{f}Hz', 5.0, 5.0, float(f), periods)
    tape.move(0.0)
    tape.rest('idle', 0.2)
    return tape.result()
