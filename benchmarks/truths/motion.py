# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What labs drive a stage with, in parts of the voltage range: labelled or in one stretch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
import math

import numpy as np
from scipy.signal import firwin, lfilter

from .cores import Array, Rng
from .tape import Label, Tape

#: top speed of the moves between segments [spans/s]
SPEED = 4.0
#: what a poorer diagnosis record lacks
POORER = ('holds', 'second frequency', 'minor loops')


@dataclass(frozen=True)
class Motion:
    """Command in parts of the range, shape (n,), and labels (label, start, stop) or none."""

    u: Array
    labels: tuple[Label, ...]


class _Tape(Tape):
    """A tape in parts of the range."""

    def sine(
        self, name: str, bias: float, amplitude: float, frequency: float, seconds: float
    ) -> None:
        """Whole periods from the lowest point and back to it, for about so long."""
        self.move(bias - amplitude)
        periods = max(2, round(seconds * self.pace * frequency))
        angle = (
            2
            * np.pi
            * frequency
            / self.rate
            * np.arange(1, round(periods * self.rate / frequency) + 1)
        )
        self.add(f'sine:{frequency:g}Hz{name}', bias - amplitude * np.cos(angle))

    def jumps(self, label: str, low: float, high: float, count: int, hold: float) -> None:
        self.move(low)
        n = round(hold * self.rate)
        self.add(label, np.concatenate([np.full(n, x) for _ in range(count) for x in (high, low)]))

    def around(self, label: str, bias: float, amplitude: float, wave: Array) -> None:
        """Add a wave of about unit height about a bias."""
        u = np.clip(bias + amplitude * wave / np.abs(wave).max(), 0.0, 1.0)
        self.move(float(u[0]))
        self.add(label, u)

    def chirp(self, low: float, high: float, seconds: float) -> Array:
        t = np.arange(round(seconds * self.pace * self.rate)) / self.rate
        k = math.log(high / low)
        return np.asarray(np.sin(2 * np.pi * low * t[-1] / k * np.expm1(k * t / t[-1])))

    def noise(self, top: float, seconds: float, rng: Rng) -> Array:
        n = round(seconds * self.pace * self.rate)
        x = lfilter(firwin(201, top, fs=self.rate), [1.0], rng.standard_normal(n + 200))[200:]
        return np.asarray(np.clip(x, -3 * x.std(), 3 * x.std()))

    def multisine(self, top: float, period: float, periods: int, rng: Rng) -> Array:
        t = np.arange(round(period * self.pace * self.rate)) / self.rate
        first = 1.0 / (t.size / self.rate)
        lines = np.arange(1, int(top / first) + 1, 2)
        lines = lines[rng.permutation(lines.size) % 4 > 0]
        x = np.zeros(t.size)
        for line in lines:
            x += np.cos(2 * np.pi * line * first * t + rng.uniform(0, 2 * np.pi))
        start = int(np.argmin(np.abs(np.gradient(x)) * self.rate / 2000 + np.abs(x)))
        return np.asarray(np.tile(np.roll(x, -start), periods))

    def motion(self, labelled: bool) -> Motion:
        u = np.clip(np.concatenate(self.pieces), 0.0, 1.0)
        return Motion(u, tuple(self.labels) if labelled else ())


def record_motion(
    name: str,
    rate: float,
    rng: Rng,
    *,
    labelled: bool,
    poorer: str = '',
    first: float = 500.0,
    rest: float = 0.0,
) -> Motion:
    """
    Return what a record is driven with.

    `name`: {'identification', 'diagnosis', 'unseen'}: The identification is for unlabelled
    records; the labelled ones follow a program; `rate`: [Hz]; `labelled`: unlabelled ones start
    anywhere, and their parts come in any order; `poorer`: one of `POORER` that a diagnosis record
    lacks, or nothing; `first`: first mode [Hz], which labs know well enough to excite it; `rest`:
    where a labelled record rests.
    """
    # long records at high rates cost too much
    pace = {10_000.0: 1.0, 20_000.0: 0.9, 50_000.0: 0.6}.get(rate, 1.0)
    start = rest if labelled else rng.uniform(0.1, 0.9)
    tape = _Tape(rate, SPEED, start, pace)
    make = {'identification': _identification, 'diagnosis': _diagnosis, 'unseen': _unseen}[name]
    parts = make(tape, rng, labelled, poorer, first)
    if not labelled:
        tape.rest('idle', 0.05)
    for part in parts:
        part()
    if labelled:
        tape.move(rest)
        tape.rest('idle', 0.3)
    return tape.motion(labelled)


Parts = list[Callable[[], None]]


def _mixed(parts: Parts, rng: Rng, labelled: bool) -> Parts:
    return parts if labelled else [parts[i] for i in rng.permutation(len(parts))]


def _swings(growing: bool, count: int) -> list[float]:
    sizes = np.linspace(1.0, count, count) / count * 0.5
    if not growing:
        sizes = sizes[::-1]
    levels = [0.5]
    for size in sizes:
        levels += [0.5 + size, 0.5 - size]
    return levels


def _identification(tape: _Tape, rng: Rng, labelled: bool, poorer: str, first: float) -> Parts:
    if labelled:
        raise ValueError('a labelled identification follows a program')
    top = min(2.5 * first, 0.4 * tape.rate)
    slow, fast = rng.uniform(0.7, 2.0), rng.uniform(15.0, 60.0)
    growing, bias = rng.random() < 0.5, rng.uniform(0.4, 0.6)
    wide: Parts = [
        lambda: tape.around('chirp', bias, 0.06, tape.chirp(2.0, top, 2.0)),
        lambda: tape.around('noise', bias, 0.05, tape.noise(top, 2.0, rng)),
        lambda: tape.around('multisine', 0.5, 0.45, tape.multisine(120.0, 1.0, 2, rng)),
    ]
    chosen = [wide[i] for i in rng.permutation(3)[: int(rng.integers(1, 3))]]
    if wide[2] in chosen and len(chosen) == 1:
        # the modes must be excited somehow
        chosen.append(wide[int(rng.integers(2))])
    parts: Parts = [
        lambda: tape.corners('triangle', _swings(growing, 5), rng.uniform(1.5, 2.5)),
        lambda: tape.sine('', 0.5, 0.48, round(slow, 2), 2.0 / slow),
        lambda: tape.sine('', 0.5, rng.uniform(0.2, 0.4), round(fast, 1), 0.4),
        lambda: tape.jumps('step', bias - 0.05, bias + 0.05, 5, 0.06),
        *chosen,
    ]
    return _mixed(parts, rng, labelled)


def _diagnosis(tape: _Tape, rng: Rng, labelled: bool, poorer: str, first: float) -> Parts:
    slow = round(rng.uniform(1.0, 2.0), 1)
    low = round(rng.uniform(15.0, 40.0))
    high = round(min(rng.uniform(60.0, 150.0), 0.5 * first))
    large, small = rng.uniform(0.4, 0.46), rng.uniform(0.12, 0.2)
    up = list(np.array([0.3, 0.6, 0.95]) + rng.uniform(-0.04, 0.04, 3))
    down = list(np.array([0.62, 0.3, 0.05]) + rng.uniform(-0.04, 0.04, 3))

    def minor() -> None:
        for bias in (0.22, 0.5, 0.78):
            a, b = bias - 0.14, bias + 0.14
            tape.corners(f'triangle:minor-{bias:g}', [a, b, a, b, a], 3.0)

    def sines(f: float) -> None:
        tape.sine('-large', 0.5, large, f, 0.45)
        tape.sine('-small', 0.5, small, f, 0.45)

    parts: Parts = [
        lambda: tape.sine('', 0.5, 0.5, slow, 2.0 / slow),
        lambda: sines(low),
    ]
    if poorer != 'second frequency':
        parts.append(lambda: sines(high))
    if poorer != 'holds':
        parts.append(lambda: tape.stairs('staircase:up', up, [0.3, 0.4, 0.9]))
        parts.append(lambda: tape.stairs('staircase:down', down, [0.4, 0.7, 0.25]))
    if poorer != 'minor loops':
        parts.append(minor)
    parts.append(lambda: tape.corners('triangle:fast', [0.0, 1.0] * 3 + [0.0], 15.0))
    if labelled:
        parts.append(lambda: tape.around('multisine', 0.5, 0.45, _multi(tape, rng)))
    else:
        parts.append(lambda: tape.around('chirp', 0.5, 0.3, tape.chirp(2.0, 200.0, 1.0)))
    parts = _mixed(parts, rng, labelled)
    return [lambda: tape.rest('idle', 0.5), *parts, lambda: tape.rest('hold:end', 0.4)]


def _multi(tape: _Tape, rng: Rng) -> Array:
    return tape.multisine(150.0, 1.0, 1, rng)


def _unseen(tape: _Tape, rng: Rng, labelled: bool, poorer: str, first: float) -> Parts:
    slow = round(rng.uniform(2.5, 4.0), 1)
    middle = round(rng.uniform(42.0, 55.0))
    high = round(min(rng.uniform(90.0, 130.0), 0.4 * first))

    def raster() -> None:
        # slow way there, fast way back, every line from another level
        levels = [0.1]
        for _ in range(5):
            levels += [levels[-1] + 0.55, levels[-1] + 0.06]
        tape.move(0.1)
        parts = []
        for a, b in pairwise(levels):
            n = round(tape.pace * tape.rate * (0.15 if b > a else 0.02))
            parts.append(a + (b - a) * np.arange(1, n + 1) / n)
        tape.add('triangle:raster', np.concatenate(parts))

    levels = list(rng.uniform(0.05, 0.95, 6))
    parts: Parts = [
        lambda: tape.sine('', 0.45, 0.42, slow, 1.0),
        lambda: tape.sine('', 0.55, 0.38, middle, 0.4),
        lambda: tape.sine('', 0.47, 0.33, high, 0.4),
        raster,
        lambda: tape.stairs('staircase:unseen', levels, [0.2, 0.35, 0.15, 0.5, 0.25, 0.3]),
        lambda: tape.corners('triangle:decaying', _swings(False, 6), 4.0),
    ]
    return [
        lambda: tape.rest('idle', 0.2),
        *_mixed(parts, rng, labelled),
    ]
