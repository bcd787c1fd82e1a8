# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The safety property of the drive, tried on generated command sequences.

    python benchmarks/reliability/safety.py --count 100000

Whatever arrives on `voltage`, for the voltage that is applied:

1. every sample is a number within the limits, or, where these were just moved, on its way back
   into them at the slew; no two samples in a row are further apart than the slew allows;
2. silence ends at rest exactly, and neither that ramp nor the one into a new stream that stands
   still is faster than `ramp_slew`; until then a second publisher moves nothing, at whatever time
   and number its stream is, unless the first one is silent and has gone;
3. how the command is cut into blocks changes no bit of it.

A sequence is a drive as the stage node builds it, a `SampleClock` and a `Guard`, and some ten
things that happen to it: blocks of every kind of number, with every kind of time, gaps, silence,
restarts, the stream of a second publisher, limits that are moved.  The seed of a sequence that
fails is named: `--first SEED --count 1` plays it again.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
import math
import sys
import time

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.record.blocks import Samples

#: what rounding may add to a step, relative to it and to the voltage
ROUNDING, ULPS = 1e-8, 4
#: longest ramp that is followed to its end [samples]
PATIENCE = 20_000


class Broken(Exception):
    """The property does not hold."""


def check(settings: GuardSettings, before: float, v: Array, what: str) -> None:
    """See that what is applied after a voltage keeps to limits and slew."""
    if not v.size:
        return
    path = np.concatenate([[before], v])
    if not np.isfinite(path).all():
        raise Broken(f'{what}: not a number')
    step = np.abs(np.diff(path))
    allowed = settings.step * (1 + ROUNDING) + ULPS * np.spacing(np.abs(path[1:]))
    if (step > allowed).any():
        raise Broken(f'{what}: a step of {step.max():g} V, allowed are {settings.step:g} V')
    outside = np.maximum(settings.low - path, path - settings.high).clip(0.0)
    wrong = (outside[1:] > 0) & (
        (outside[:-1] == 0) | (step < settings.step * (1 - 1e-6)) | (outside[1:] >= outside[:-1])
    )
    # the last step of the way back is as short as is left of it
    wrong &= outside[1:] > 0
    if wrong.any():
        raise Broken(f'{what}: {outside.max():g} V outside the limits')


class Drive:
    """Sample clock and guard as the stage node has them, watched sample by sample."""

    def __init__(self, settings: GuardSettings, silence: float) -> None:
        self.guard = Guard(settings)
        self.clock = SampleClock(settings.sample_rate, silence)
        self.operations: list[tuple[str, object, bool]] = []
        self.applied: list[Array] = []
        self.met: Counter[str] = Counter()

    def block(self, samples: Samples, number: int | None, ids: tuple[bytes, ...]) -> Kind:
        """Take a block as it comes."""
        verdict = self.clock.judge(samples, number, lambda: ids)
        self.met[verdict.kind.value] += 1
        if not verdict.is_taken:
            return verdict.kind
        start = verdict.kind is Kind.START
        if verdict.kind is Kind.GAP:
            self.do('hold', verdict.missing)
        inside = self._is_inside()
        before, v = self.guard.applied, self.do('process', samples.values, start)
        steady = np.isfinite(samples.values[0]) and np.all(samples.values == samples.values[0])
        if start and inside and steady:
            self._is_soft(v, before, 'a ramp into a stream')
        return verdict.kind

    def silence(self, n: int, whole: bool) -> None:
        """Let nothing come for so many samples, or until rest."""
        self.clock.pause()
        self.met['silence'] += 1
        s = self.guard.settings
        inside = self._is_inside()
        before, v = self.guard.applied, self.do('idle', n)
        if inside:
            self._is_soft(v, before, 'a ramp to rest')
        # a ramp may be under way already, and is at its slowest near its end
        length = math.ceil(2 * (s.high - s.low) / s.ramp_step) + 1
        if inside and length < PATIENCE:
            if whole:
                self.do('idle', length)
            if whole and self.guard.applied != s.rest:
                raise Broken(f'silence ends at {self.guard.applied:g} V, not at rest')
        if self.guard.is_at_rest:
            self.clock.end()

    def settings(self, settings: GuardSettings) -> None:
        """Move limits, slew, rest."""
        self.met['settings'] += 1
        self.operations.append(('settings', settings, False))
        self.guard.settings = settings

    def do(self, name: str, argument: object, restarted: bool = False) -> Array:
        """Have the guard apply something, and look at it."""
        before = self.guard.applied
        self.operations.append((name, argument, restarted))
        v = _act(self.guard, name, argument, restarted)
        check(self.guard.settings, before, v, name)
        if v.size and v[-1] != self.guard.applied:
            raise Broken(f'{name}: the guard thinks that {self.guard.applied:g} V are applied')
        self.applied.append(v)
        return v

    def _is_inside(self) -> bool:
        return self.guard.settings.low <= self.guard.applied <= self.guard.settings.high

    def _is_soft(self, v: Array, before: float, what: str) -> None:
        step = np.abs(np.diff(np.concatenate([[before], v])))
        s = self.guard.settings
        most = float(step.max(initial=0.0))
        if most > s.ramp_step * (1 + ROUNDING) + ULPS * np.spacing(abs(s.high) + abs(s.low)):
            raise Broken(f'{what}: {most * s.sample_rate:g} V/s, ramp_slew is {s.ramp_slew:g}')

    def replayed(self, start: GuardSettings, rng: np.random.Generator) -> None:
        """See that the same, cut elsewhere, is applied the same."""
        guard, applied = Guard(start), []
        for name, argument, restarted in self.operations:
            if name == 'settings':
                guard.settings = argument  # type: ignore[assignment]
                continue
            whole = isinstance(argument, int)
            n = argument if isinstance(argument, int) else np.size(argument)  # type: ignore[arg-type]
            cut = int(rng.integers(0, n + 1))
            for k, (a, b) in enumerate(((0, cut), (cut, n))):
                part = b - a if whole else np.asarray(argument)[a:b]
                applied.append(_act(guard, name, part, restarted and k == 0))
        one, other = np.concatenate(self.applied or [np.empty(0)]), np.concatenate([[], *applied])
        if one.tobytes() != other.tobytes():
            raise Broken('cut into other blocks, another voltage is applied')


def _act(guard: Guard, name: str, argument: object, restarted: bool) -> Array:
    if name == 'process':
        return guard.process(argument, restarted).voltage  # type: ignore[arg-type]
    act: Callable[[int], Array] = getattr(guard, name)
    return act(argument)  # type: ignore[arg-type]


# what arrives


def _drawn_settings(rng: np.random.Generator, rate: float) -> GuardSettings:
    low = float(rng.uniform(-10, 5))
    high = low + float(10 ** rng.uniform(-2, 1.5))
    return GuardSettings(
        low,
        high,
        slew=float(10 ** rng.uniform(0, 9)),
        ramp_slew=float(10 ** rng.uniform(-2, 6)),
        rest=float(rng.choice([low, high, rng.uniform(low, high)])),
        sample_rate=rate,
    )


def _drawn_values(rng: np.random.Generator, n: int, s: GuardSettings, last: float) -> Array:
    span = s.high - s.low
    kind = rng.integers(0, 10)
    if kind == 0:
        return np.full(n, rng.uniform(s.low, s.high))
    if kind == 1:
        return last + np.cumsum(rng.uniform(-1, 1, n)) * min(s.step, span)
    if kind == 2:
        return s.low + span * (0.5 + 0.7 * np.sin(rng.uniform(0, 3) * np.arange(n)))
    if kind == 3:
        return rng.uniform(s.low - span, s.high + span, n)
    if kind == 4:
        return rng.choice([s.low, s.high, last], n)
    if kind == 5:
        return np.full(n, np.nan)
    if kind == 6:
        odd = [np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, -0.0, s.low, s.high, last]
        return rng.choice(odd, n)
    if kind == 7:
        # any bits at all
        return np.frombuffer(rng.bytes(8 * n), dtype=np.float64)
    if kind == 8:
        v = np.full(n, last)
        v[rng.integers(0, n)] = rng.choice([np.nan, np.inf, 1e9, s.high + 1])
        return v
    return np.linspace(last, rng.uniform(s.low, s.high), n)


def _drawn_times(rng: np.random.Generator, n: int, head: int, rate: float, gap: int) -> Array:
    k = np.arange(n)
    # most blocks go on where the last one ended
    kind = rng.integers(0, 24)
    odd: dict[int, Callable[[], Array]] = {
        0: lambda: (head - n + k) / rate,  # once more
        1: lambda: (head - int(rng.integers(1, 500)) + k) / rate,  # backwards
        2: lambda: k / rate,  # from the beginning
        3: lambda: (head + int(rng.integers(1, gap)) + k) / rate,
        4: lambda: (head + gap + int(rng.integers(1, 10**9)) + k) / rate,
        5: lambda: (head + k + 0.3) / rate,
        6: lambda: (head + k[::-1]) / rate,
        7: lambda: np.full(n, rng.choice([np.nan, np.inf, 1e300, -1e300])),
        8: lambda: (head + 2 * k) / rate,
        9: lambda: (2.0**52 + k) / rate,
        10: lambda: -(head + k) / rate,
    }
    return odd[int(kind)]() if int(kind) in odd else (head + k) / rate


class Publishers:
    """Two publishers of voltage, and which of them the drive follows."""

    def __init__(self, rng: np.random.Generator, drive: Drive, rate: float) -> None:
        self.rng, self.drive, self.rate = rng, drive, rate
        self.is_numbered = bool(rng.integers(0, 2))
        self.numbers = {b'A': int(rng.integers(1, 1000))}
        self.followed: bytes | None = None
        self.heard: set[bytes] = set()

    def play(self, t: Array, values: Array) -> Kind:
        """Send a block of the publisher that is followed, or of the one that comes first."""
        return self._send(self.followed or b'A', t, values, tuple(self.numbers))

    def play_other(self, values: Array) -> None:
        """Send blocks of the other publisher, at any time and number."""
        rng, clock = self.rng, self.drive.clock
        other = b'A' if self.followed == b'B' else b'B'
        if other not in self.numbers:
            self.numbers[other] = self.numbers[b'A'] + int(rng.choice([-500, -3, 1, 3, 500]))
        head = clock.head or int(rng.integers(0, 10**6))
        tick = head + int(rng.choice([-values.size, 0, 1, 20, values.size, 10**5]))
        for k in range(int(rng.integers(1, 5))):
            first = tick + k * values.size
            # the very next block of the stream, by time and number, could be anybody's
            close = abs(self.numbers[other] - self.numbers[self.followed or other]) < 20
            first += first == clock.head and (close or not self.is_numbered)
            ids = (other,) if self.followed and not rng.integers(0, 4) else tuple(self.numbers)
            self._send(other, (first + np.arange(values.size)) / self.rate, values, ids)

    def _send(self, name: bytes, t: Array, values: Array, ids: tuple[bytes, ...]) -> Kind:
        drive, before, silent = self.drive, self.drive.guard.applied, self.drive.clock.head is None
        self.numbers[name] += 1
        if name not in self.heard and self.followed not in (None, name):
            # the next number, from a publisher that was never heard, could be anybody's
            self.numbers[name] += self.numbers[name] == self.numbers[self.followed] + 1
        self.heard.add(name)
        number = self.numbers[name] if self.is_numbered else None
        kind = drive.block(Samples(t, values, 'x'), number, ids)
        if self.followed is None and kind is Kind.START:
            self.followed = name
        elif self.followed not in (None, name) and self.followed not in ids and silent:
            # the one that was followed is silent and has gone
            self.followed = name if kind is Kind.START else self.followed
        elif self.followed not in (None, name):
            if kind not in (Kind.SECOND, Kind.MALFORMED):
                raise Broken(f'a block of a second publisher is taken as {kind.value}')
            if drive.guard.applied != before:
                raise Broken('a second publisher moves the stage')
        return kind


def sequence(seed: int) -> Counter[str]:
    """Play one sequence, and return what was met in it."""
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([1000.0, 20_000.0, 51_200.0]))
    start = _drawn_settings(rng, rate)
    drive, gap, last = Drive(start, silence=0.02), max(2, int(0.02 * rate)), start.rest
    publishers = Publishers(rng, drive, rate)
    for _ in range(int(rng.integers(4, 16))):
        what = rng.integers(0, 16)
        if what == 0:
            drive.silence(int(rng.integers(0, 400)), whole=bool(rng.integers(0, 2)))
            if drive.guard.is_at_rest:
                publishers.followed = None
            continue
        if what == 1:
            drive.settings(_drawn_settings(rng, rate))
            continue
        n = int(rng.choice([1, 2, 7, 40, 100]))
        values = _drawn_values(rng, n, drive.guard.settings, last)
        if what in (2, 4):
            publishers.play_other(values)
            continue
        if what == 3:
            n, values = 0, values[:0]
        publishers.play(_drawn_times(rng, n, drive.clock.head or 0, rate, gap), values)
        finite = values[np.isfinite(values)]
        last = float(np.clip(finite[-1], -100, 100)) if finite.size else last
    drive.replayed(start, rng)
    drive.met['samples'] += sum(v.size for v in drive.applied)
    return drive.met


def run(first: int, count: int) -> Counter[str]:
    """Play many sequences; the first one that fails is named."""
    met: Counter[str] = Counter()
    for seed in range(first, first + count):
        try:
            met += sequence(seed)
        except Broken as error:
            raise Broken(f'seed {seed}: {error}') from error
    return met


def main() -> int:
    """Play them all, and write the row."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--count', type=int, default=100_000)
    parser.add_argument('--first', type=int, default=0, help='seed of the first sequence')
    args = parser.parse_args()
    begin = time.perf_counter()
    try:
        met = run(args.first, args.count)
    except Broken as error:
        print(error)
        return 1
    kinds = ', '.join(f'{n:,} {kind}' for kind, n in met.most_common() if kind != 'samples')
    print(f'{args.count:,} sequences in {time.perf_counter() - begin:.0f} s: {kinds}')
    if args.first == 0:
        from rows import write_rows

        what = (
            'the safety property of the drive on generated command sequences: every kind of '
            'number and time, gaps, silence, restarts, a second publisher, limits moved'
        )
        how_often = f'{args.count:,} sequences, {met["samples"]:,} applied samples'
        result = 'limits and slew kept in all; silence ends at rest; cut elsewhere, no bit differs'
        command = f'python benchmarks/reliability/safety.py --count {args.count}'
        write_rows('safety', [(what, how_often, result)], command)
    return 0


if __name__ == '__main__':
    sys.exit(main())
