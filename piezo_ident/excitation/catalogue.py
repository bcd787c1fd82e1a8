# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Catalogue of signals: their names in a program, their options, and their makers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
import math
import reprlib
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation import signals as excitation

#: default of an option that the user must set
REQUIRED = object()


@dataclass(frozen=True)
class Option:
    """
    Option of a signal: its unit, its default, and its allowed values.

    The default is `REQUIRED` for an option that must be set, and None for an option that may be
    absent.  `many` allows a list of numbers, `whole` numbers are at least one, `positive` numbers
    above zero.  The `choices` are the allowed words.
    """

    unit: str
    default: Any = REQUIRED
    many: bool = False
    whole: bool = False
    positive: bool = False
    choices: tuple[str, ...] = ()

    def read(self, value: Any) -> Any:
        """Check a value and convert it; ConfigError for another type, or out of range."""
        if self.choices:
            if value not in self.choices:
                raise ConfigError(f'{reprlib.repr(value)} is none of {", ".join(self.choices)}')
            return value
        if self.many:
            values = value if isinstance(value, list) else [value]
            if not values:
                raise ConfigError('the list is empty; give at least one number')
            return [self._number(x) for x in values]
        return self._number(value)

    def _number(self, value: Any) -> float | int:
        # YAML 1.1 reads 2e-5 as text, but people write it
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise ConfigError(f'{reprlib.repr(value)} is not a number; give it in {self.unit}')
        if self.whole and (number < 1 or number != int(number)):
            raise ConfigError(f'{number:g} must be a whole number of at least 1')
        if self.positive and number <= 0:
            raise ConfigError(f'{number:g} {self.unit} must be greater than zero')
        return int(number) if self.whole else number


@dataclass(frozen=True)
class Setting:
    """
    Context of a signal: sampling rate [Hz], limits and rest [V], random generator, and unit.

    Levels are in `unit`, which also appears in the names of segments.
    """

    sample_rate: float
    limits: tuple[float, float]
    rest: float
    rng: np.random.Generator
    unit: str = 'V'


@dataclass(frozen=True, eq=False)
class Part:
    """
    Part of a program without a ramp inside: its voltage v [V], shape (n,).

    `end` is the level at which the signal would continue after its last sample [V].  `name`, which
    may be empty, distinguishes parts of the same kind.
    """

    v: Array
    end: float
    name: str = ''


Maker = Callable[[Setting, Mapping[str, Any]], list[Part]]


@dataclass(frozen=True)
class Signal:
    """Signal of the catalogue: the kind of its segments, its options and its maker."""

    kind: str
    options: Mapping[str, Option]
    make: Maker


#: all signals that a program may use
SIGNALS: dict[str, Signal] = {}

_LEVEL = Option('V')
_SIZE = Option('V', positive=True)
_TIME = Option('s', positive=True)
_FREQUENCY = Option('Hz', positive=True)
_SLOPE = Option('V/s', default=excitation.PAPER_SLOPE, positive=True)
_COUNT = Option('1', whole=True)


def _signal(name: str, kind: str = '', **options: Option) -> Callable[[Maker], Maker]:
    """Enter a maker into the catalogue; by default `kind` is the name."""

    def enter(make: Maker) -> Maker:
        SIGNALS[name] = Signal(kind or name, options, make)
        return make

    return enter


def _periodic(v: Array, name: str = '') -> list[Part]:
    return [Part(v, float(v[0]), name)]


@_signal('idle', duration=_TIME)
def _idle(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    return _periodic(excitation.staircase([s.rest], [o['duration']], s.sample_rate))


@_signal('hold', level=_LEVEL, duration=_TIME)
def _hold(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    v = excitation.staircase([o['level']], [o['duration']], s.sample_rate)
    return _periodic(v, f'{o["level"]:g}{s.unit}')


@_signal('step', bias=_LEVEL, size=_SIZE, hold=_TIME, count=_COUNT)
def _step(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    # check the length before the levels are listed
    n = excitation.sample_count(o['hold'], s.sample_rate)
    excitation.sample_count(n * (o['count'] + 1) / s.sample_rate, s.sample_rate)
    levels = [o['bias'] + (k % 2 - 0.5) * o['size'] for k in range(o['count'] + 1)]
    v = excitation.staircase(levels, [o['hold']] * len(levels), s.sample_rate)
    return [Part(v, float(v[-1]))]


@_signal('staircase', levels=Option('V', many=True), hold=Option('s', many=True, positive=True))
def _staircase(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    levels, hold = o['levels'], o['hold']
    if len(hold) == 1:
        hold = hold * len(levels)
    if len(hold) != len(levels):
        raise ConfigError(
            f'{len(levels)} levels and {len(hold)} holds; give one hold, or one each'
        )
    v = excitation.staircase(levels, hold, s.sample_rate)
    return [Part(v, float(v[-1]))]


@_signal(
    'settle',
    bias=_LEVEL,
    amplitude=_SIZE,
    cycles=replace(_COUNT, default=20),
    frequency=replace(_FREQUENCY, default=20.0),
)
def _settle(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    return _periodic(excitation.settling_sweep(**o, sample_rate=s.sample_rate))


@_signal(
    'noise',
    bias=_LEVEL,
    amplitude=_SIZE,
    cutoff=_FREQUENCY,
    duration=_TIME,
    crest=Option('1', default=2.5, positive=True),
)
def _noise(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    # the noise fades to its bias, where it continues
    return [Part(excitation.noise(**o, sample_rate=s.sample_rate, rng=s.rng), o['bias'])]


@_signal(
    'triangle',
    preset=Option('', default='range', choices=('range', 'paper')),
    peaks=Option('V', default=None, many=True),
    base=Option('V', default=None),
    slope=_SLOPE,
)
def _triangle(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    low, high = s.limits
    if o['preset'] == 'paper':
        own = [n for n in ('peaks', 'base') if o[n] is not None]
        own += ['slope'] if o['slope'] != _SLOPE.default else []
        if own:
            raise ConfigError(
                f'preset: paper has its own {" and ".join(own)}; leave out the one or the other'
            )
        peaks, base, slope, name = excitation.PAPER_PEAKS, 0.0, excitation.PAPER_SLOPE, 'paper'
    else:
        base = low if o['base'] is None else o['base']
        # the last peak reaches the end of the range, so that every threshold is excited
        peaks = o['peaks'] or (low + (high - low) / 3, low + 2 * (high - low) / 3, high)
        slope, name = o['slope'], ''
    return _periodic(excitation.triangle(peaks, base, slope, s.sample_rate), name)


def _about(bias: float, sizes: Iterable[float]) -> list[float]:
    """List corners on both sides of a bias in turn, starting and ending at the bias."""
    return [bias, *(x for a in sizes for x in (bias + a, bias - a)), bias]


@_signal(
    'decaying_triangle', 'triangle', bias=_LEVEL, amplitude=_SIZE, cycles=_COUNT, slope=_SLOPE
)
def _decaying_triangle(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    # check the length before the corners are listed; each leg has at least one sample
    excitation.sample_count(2 * o['cycles'] / s.sample_rate, s.sample_rate)
    sizes = (o['amplitude'] * (1.0 - k / o['cycles']) for k in range(o['cycles']))
    levels = _about(o['bias'], sizes)
    return _periodic(excitation.corners(levels, o['slope'], s.sample_rate), 'decaying')


@_signal(
    'minor_loops',
    'triangle',
    biases=Option('V', many=True),
    amplitude=_SIZE,
    cycles=_COUNT,
    slope=_SLOPE,
)
def _minor_loops(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    excitation.sample_count(2 * len(o['biases']) * o['cycles'] / s.sample_rate, s.sample_rate)
    parts = []
    for bias in o['biases']:
        levels = _about(bias, [o['amplitude']] * o['cycles'])
        v = excitation.corners(levels, o['slope'], s.sample_rate)
        parts += _periodic(v, f'minor-{bias:g}{s.unit}')
    return parts


@_signal(
    'sine',
    bias=_LEVEL,
    amplitude=_SIZE,
    frequency=_FREQUENCY,
    periods=replace(_COUNT, default=None),
    duration=replace(_TIME, default=None),
    phase=Option('rad', default=0.0),
)
def _sine(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    f = o['frequency']
    if (o['periods'] is None) == (o['duration'] is None):
        raise ConfigError('give either periods or duration')
    # rounded first, so that 1.4 s of 10 Hz are 14 periods, not 15
    if o['duration']:
        excitation.sample_count(o['duration'], s.sample_rate)
    periods = o['periods'] or math.ceil(round(o['duration'] * f, 6))
    v = excitation.sine(o['bias'], o['amplitude'], f, periods, s.sample_rate, o['phase'])
    return _periodic(v, f'{f:g}Hz')


@_signal(
    'multisine',
    bias=_LEVEL,
    amplitude=_SIZE,
    lowest=_FREQUENCY,
    highest=_FREQUENCY,
    period=_TIME,
    periods=_COUNT,
    realisations=replace(_COUNT, default=1),
    lines=Option('', default='odd', choices=('odd', 'all')),
)
def _multisine(s: Setting, o: Mapping[str, Any]) -> list[Part]:
    period, count = o['period'], o['realisations']
    # check the length of all realisations before any is made
    excitation.sample_count(period * o['periods'] * count, s.sample_rate)
    for end in ('lowest', 'highest'):
        if o[end] > s.sample_rate / 2:
            raise ConfigError(
                f'{end} = {o[end]:g} Hz is above half the sampling rate ({s.sample_rate / 2:g} Hz)'
            )
    lowest = max(1, math.ceil(round(o['lowest'] * period, 6)))
    highest = math.floor(round(o['highest'] * period, 6))
    parts = []
    for number in range(1, count + 1):
        lines = np.arange(lowest, highest + 1)
        if o['lines'] == 'odd':
            lines = excitation.odd_lines(lowest, highest, s.rng)
        v = excitation.multisine(
            o['bias'], o['amplitude'], lines, period, o['periods'], s.sample_rate, s.rng
        )
        parts += _periodic(v, str(number) if count > 1 else '')
    return parts
