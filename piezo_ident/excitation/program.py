# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Programs: lists of named input signals with soft ramps in between, written as YAML.

    limits: [0, 10]          # V; no sample may leave them
    sample_rate: 20000       # Hz; by default the rate of the caller
    seed: 1
    segments:
      - {signal: idle, duration: 0.3}
      - {signal: sine, bias: 5, amplitude: 5, frequency: 10, duration: 1.5}
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
import math
import os
import re
import reprlib
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, frozen_array
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import load_yaml, parse_yaml
from piezo_ident.excitation import signals as excitation
from piezo_ident.excitation.catalogue import Option, Part, REQUIRED, Setting, SIGNALS
from piezo_ident.record.record import Segment

_HEAD = {
    'limits': Option('V', many=True),
    'sample_rate': Option('Hz', default=None, positive=True),
    'seed': Option('1', default=0.0),
    'rest': Option('V', default=0.0),
    'slew': Option('V/s', default=20.0, positive=True),
}
_NAME = re.compile(r'[\w.+-]+')


@dataclass(frozen=True, eq=False)
class Sequence:
    """
    Command voltage v [V] of a whole program, shape (n,), at its sampling rate [Hz].

    The segments cover every sample, and no two neighbours share a label.
    """

    v: Array
    sample_rate: float
    segments: tuple[Segment, ...]
    name: str = 'program'

    def __post_init__(self) -> None:
        object.__setattr__(self, 'v', frozen_array(self.v))

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.v.size)

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.n / self.sample_rate

    @property
    def t(self) -> Array:
        """Time of each sample [s], from zero."""
        return np.arange(self.n) / self.sample_rate

    def describe(self) -> str:
        """Write one line for each segment: start, length, label and voltages."""
        # the digits resolve a sample, so that the times can label a measured record
        rate, digits = self.sample_rate, max(3, math.ceil(math.log10(self.sample_rate)))
        return '\n'.join(
            f'{s.start / rate:{digits + 6}.{digits}f} s {s.n / rate:{digits + 6}.{digits}f} s  '
            f'{s.label:20s} '
            f'{self.v[s.start : s.stop].min():7.3f} .. {self.v[s.start : s.stop].max():.3f} V'
            for s in self.segments
        )


@dataclass(frozen=True)
class Entry:
    """Item of a program: a signal with its options, and optionally a name of its own."""

    signal: str
    options: Mapping[str, Any]
    name: str | None = None


@dataclass(frozen=True)
class Program:
    """
    Checked program.

    Attributes
    ----------
    name : str
        File or source, for messages.
    entries : tuple of Entry
    limits : tuple of float
        Lowest and highest voltage [V].
    sample_rate : float or None
        [Hz]; with None the caller chooses it.
    seed : int
        Seed of the random signals.
    rest, slew : float
        Voltage before and after the program [V], and largest speed of its ramps [V/s].
    unit : str
        Unit of the levels, V for a voltage; it appears in labels.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> program = pi.Program.load('validation')
    >>> sequence = program.build(20_000)
    >>> float(sequence.v.min()), float(sequence.v.max())
    (0.0, 10.0)
    """

    name: str
    entries: tuple[Entry, ...]
    limits: tuple[float, float]
    sample_rate: float | None = None
    seed: int = 0
    rest: float = 0.0
    slew: float = 20.0
    unit: str = 'V'

    @classmethod
    def load(cls, name_or_path: str | os.PathLike[str]) -> Program:
        """
        Read a shipped program, such as ``identification``, or a file of the user.

        ConfigError if the file cannot be read, and in the cases of `parse_program`.

        >>> import piezo_ident as pi
        >>> pi.Program.load('identification').limits
        (0.0, 10.0)
        """
        path = find_config(name_or_path, 'program')
        return _program(load_yaml(path), str(path))

    def build(
        self,
        sample_rate: float | None = None,
        rng: np.random.Generator | None = None,
        limits: tuple[float, float] | None = None,
    ) -> Sequence:
        """
        Build the voltage of the program, from rest to rest.

        Parameters
        ----------
        sample_rate : float, optional
            Sampling rate [Hz]; required if the program has none, and used instead of its rate.
        rng : numpy.random.Generator, optional
            Generator of the random signals; by default with the seed of the program.
        limits : tuple of float, optional
            Further limits, for example of the amplifier [V]; the narrower limits hold.

        Raises
        ------
        ConfigError
            If a sample leaves the limits, or a signal cannot be made at this rate.
        """
        rate = self.sample_rate if sample_rate is None else float(sample_rate)
        if rate is None or not (math.isfinite(rate) and rate > 0):
            raise ConfigError(f'{self.name}: sample_rate must be positive; add `sample_rate: 2e4`')
        low, high = self.limits
        if limits is not None:
            low, high = max(low, limits[0]), min(high, limits[1])
        if not low <= self.rest <= high:
            raise ConfigError(
                f'{self.name}: the rest voltage {self.rest:g} V lies outside the limits '
                f'{low:g} .. {high:g} V'
            )
        rng = np.random.default_rng(self.seed) if rng is None else rng
        setting = Setting(rate, (low, high), self.rest, rng, self.unit)
        parts = (self._parts(i, entry, setting) for i, entry in enumerate(self.entries, 1))
        return self._join(chain.from_iterable(parts), setting)

    def _parts(self, number: int, entry: Entry, setting: Setting) -> list[tuple[str, Part]]:
        signal, where = SIGNALS[entry.signal], _where(self.name, number, entry.signal)
        try:
            parts = signal.make(setting, entry.options)
        except ConfigError as error:
            raise ConfigError(f'{where}: {error}') from None
        low, high = setting.limits
        slack = 1e-9 * (high - low)
        labelled = []
        for part in parts:
            least, most = float(part.v.min()), float(part.v.max())
            # written so that NaN fails, too
            if not (low - slack <= least and most <= high + slack):
                raise ConfigError(
                    f'{where}: reaches {least:g} .. {most:g} V, outside the limits '
                    f'{low:g} .. {high:g} V; lower its amplitude or move its bias'
                )
            name = entry.name or ''
            if part.name and (not name or len(parts) > 1):
                name = f'{name}-{part.name}' if name else part.name
            label = f'{signal.kind}:{name}' if name else signal.kind
            # clipping here only removes rounding
            labelled.append((label, replace(part, v=np.clip(part.v, low, high))))
        return labelled

    def _join(self, parts: Iterable[tuple[str, Part]], setting: Setting) -> Sequence:
        low, high = setting.limits
        pieces: list[Array] = []
        segments: list[Segment] = []
        level, n = self.rest, 0

        def append(label: str, v: Array) -> None:
            nonlocal n
            if segments and segments[-1].label == label:
                label += '-2' if ':' in label else ':2'
            if n + v.size > excitation.MAX_SAMPLES:
                raise ConfigError(
                    f'{self.name}: more than {excitation.MAX_SAMPLES} samples in all; '
                    'split the program'
                )
            pieces.append(v)
            segments.append(Segment(label, n, n + v.size))
            n += v.size

        def go_to(target: float) -> None:
            if abs(target - level) > 1e-9 * (high - low):
                v = excitation.ramp(level, target, self.slew, setting.sample_rate)
                append('ramp', np.clip(v, low, high))

        for label, part in parts:
            go_to(float(part.v[0]))
            append(label, part.v)
            level = min(max(part.end, low), high)
        go_to(self.rest)
        # the last sample is at rest, so that the output holds the rest voltage
        if segments[-1].kind == 'ramp':
            pieces.append(np.array([self.rest]))
            segments[-1] = replace(segments[-1], stop=n + 1)
        return Sequence(np.concatenate(pieces), setting.sample_rate, tuple(segments), self.name)


def _where(name: str, number: int, signal: object) -> str:
    return f'{name}: segment {number} ({reprlib.repr(signal).strip(chr(39))})'


def parse_program(text: str, name: str = 'program') -> Program:
    """
    Read a program from YAML; messages contain its `name`.

    Raises ConfigError if a key is unknown, missing, of the wrong type or out of range.

    >>> program = parse_program('''
    ... limits: [0, 10]
    ... segments:
    ...   - {signal: sine, bias: 5, amplitude: 2, frequency: 10, periods: 5}
    ... ''')
    >>> [s.label for s in program.build(sample_rate=1000).segments]
    ['ramp', 'sine:10Hz', 'ramp']
    """
    return _program(parse_yaml(text, name), name)


def _program(data: Mapping[str, Any], name: str) -> Program:
    _known(data, (*_HEAD, 'segments'), name)
    values = {}
    for key, option in _HEAD.items():
        try:
            values[key] = _read(data, key, option)
        except ConfigError as error:
            raise ConfigError(f'{name}: {error}') from None
    limits = values['limits']
    if len(limits) != 2 or limits[0] >= limits[1]:
        raise ConfigError(
            f'{name}: limits must be [lowest, highest] voltage, got {reprlib.repr(limits)}'
        )
    if not limits[0] <= values['rest'] <= limits[1]:
        raise ConfigError(f'{name}: rest = {values["rest"]:g} V lies outside the limits {limits}')
    if values['seed'] < 0 or values['seed'] != int(values['seed']):
        raise ConfigError(
            f'{name}: seed = {values["seed"]:g} must be a whole number, not negative'
        )
    items = data.get('segments')
    if not isinstance(items, list) or not items:
        raise ConfigError(f'{name}: segments must be a list with at least one signal')
    entries = tuple(_entry(item, number, name) for number, item in enumerate(items, 1))
    values |= {'limits': (limits[0], limits[1]), 'seed': int(values['seed'])}
    return Program(name, entries, **values)


def _entry(item: Any, number: int, name: str) -> Entry:
    kind = item.get('signal') if isinstance(item, Mapping) else None
    where = _where(name, number, kind)
    if not isinstance(kind, str) or kind not in SIGNALS:
        raise ConfigError(f'{where}: signal must be one of {", ".join(SIGNALS)}')
    options = SIGNALS[kind].options
    _known(item, ('signal', 'name', *options), where)
    try:
        values = {key: _read(item, key, option) for key, option in options.items()}
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from None
    label = item.get('name')
    if label is not None and not (isinstance(label, str) and _NAME.fullmatch(label)):
        raise ConfigError(
            f'{where}: name {reprlib.repr(label)} must be a word of letters, digits and . + - _'
        )
    return Entry(kind, MappingProxyType(values), label)


def _known(data: Mapping[str, Any], keys: Iterable[str], where: str) -> None:
    strange = [str(key)[:40] for key in data if key not in keys]
    if strange:
        raise ConfigError(f'{where}: unknown {", ".join(strange[:8])}; it knows {", ".join(keys)}')


def _read(data: Mapping[str, Any], key: str, option: Option) -> Any:
    if data.get(key) is None:
        if option.default is REQUIRED:
            raise ConfigError(f'{key} is missing; give it in {option.unit}')
        return option.default
    try:
        return option.read(data[key])
    except ConfigError as error:
        raise ConfigError(f'{key}: {error}') from None
