# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Options of reading: units, columns and topics that a file does not name."""

from __future__ import annotations

from collections.abc import Mapping
import csv
from dataclasses import dataclass
import math
from numbers import Real
import re
import reprlib
import unicodedata

from piezo_ident.common.errors import DataError, expect

#: number of each unit in a second, a volt and a metre
UNITS: Mapping[str, Mapping[str, float]] = {
    't': {'s': 1.0, 'ms': 1e3, 'us': 1e6, 'ns': 1e9, 'min': 1 / 60},
    'v': {'V': 1.0, 'mV': 1e3, 'uV': 1e6, 'kV': 1e-3},
    'y': {'m': 1.0, 'mm': 1e3, 'um': 1e6, 'nm': 1e9},
}


@dataclass(frozen=True)
class ReadOptions:
    """
    Options of reading; each format uses its own.

    Parameters
    ----------
    displacement_unit : {'m', 'mm', 'um', 'nm'}, optional
        Unit of the displacement in the file; by default the unit of the header, else m.  A number
        before the unit is the value of a 1 in the file: ``'10um/V'`` for a sensor that writes
        volts, ``'20V'`` for a monitor that shows a twentieth.  Under a header of mV, the number
        is the value of one volt.  A unit without a number must agree with the header.
    voltage_limits : tuple of float, optional
        Smallest and largest voltage [V] that may occur.
    namespace, voltage_topic, displacement_topic : str, optional
        Topics to take from a bag with several stages.
    recover : bool, optional
        Read an unfinished bag as far as it goes instead of refusing it.
    voltage_alone : bool, optional
        Take a table without displacement, for example of a planned scan; y is then NaN.
    displacement_alone : bool, optional
        Take a table without voltage, for example of a wanted motion; v is then NaN.
    columns : mapping of str to str, or str, optional
        Name or number (from 1) of the columns ``t``, ``v``, ``y``, ``segment``, ``v_<name>`` and
        ``y_<name>`` of further axes, and ``x_<name>``; by default the header names them.
        Also as text, ``'t=time_s,v=voltage'``.
    rate : float, optional
        Samples a second [Hz]; the time of sample k is then k / rate, and no column is read.
    time_unit : {'s', 'ms', 'us', 'ns', 'min'}, optional
        Unit of the time in the file; by default the unit of the header, else s.
    voltage_unit : {'V', 'mV', 'uV', 'kV'}, optional
        Unit of the voltage in the file; by default the unit of the header, else V.

    Raises
    ------
    DataError
        For an unknown unit, a rate that is no positive number, or an unknown quantity.
    """

    displacement_unit: str | None = None
    voltage_limits: tuple[float, float] | None = None
    namespace: str | None = None
    voltage_topic: str | None = None
    displacement_topic: str | None = None
    recover: bool = False
    voltage_alone: bool = False
    displacement_alone: bool = False
    columns: Mapping[str, str] | str = ''
    rate: float | None = None
    time_unit: str | None = None
    voltage_unit: str | None = None

    def __post_init__(self) -> None:
        for role, quantity in (('t', 'time'), ('v', 'voltage'), ('y', 'displacement')):
            option = getattr(self, f'{quantity}_unit')
            if option is None:
                continue
            unit = scaled_unit(role, option) if isinstance(option, str) else ''
            if not unit:
                known = [*UNITS[role]]
                raise DataError(
                    f'unknown {quantity} unit {option!r}; use {", ".join(known[:-1])} or '
                    f'{known[-1]}, or what one of the file is, as in 10{known[-2]}'
                )
            object.__setattr__(self, f'{quantity}_unit', unit)
        if (limits := self.voltage_limits) is not None:
            try:
                low, high = map(float, limits)
            except (TypeError, ValueError, OverflowError):
                text = reprlib.repr(limits)
                raise DataError(f'voltage limits {text}: give two numbers, in volts') from None
            if not low <= high:
                raise DataError(f'voltage limits {low:g}..{high:g} V: give the lower one first')
            object.__setattr__(self, 'voltage_limits', (low, high))
        if self.rate is not None:
            cure = 'give the samples a second, as in 20e3'
            expect(self.rate, Real, 'rate', cure)
            if not (self.rate > 0 and math.isfinite(self.rate)):
                raise DataError(f'a rate of {self.rate:g} Hz; {cure}')
        for role, name in self.named.items():
            if not re.fullmatch(r't|v|y|segment|[vyx]_\w{1,60}', role, re.ASCII):
                raise DataError(
                    f'columns: {role!r} is no quantity; use t, v, y, segment, v_NAME, y_NAME '
                    'or x_NAME, as in --columns t=time_s,v=voltage,y=position_um'
                )
            if not name.strip():
                raise DataError(f'columns: {role} needs the name of a column, or its number')

    @property
    def named(self) -> dict[str, str]:
        """`columns` as a mapping."""
        if isinstance(self.columns, str):
            return parse_columns(self.columns)
        return {role: str(name) for role, name in (self.columns or {}).items()}

    @property
    def needed(self) -> tuple[str, ...]:
        """The columns that a table must have."""
        absent = self.rate is not None, self.displacement_alone, self.voltage_alone
        return tuple(role for role, gone in zip('tvy', absent, strict=True) if not gone)

    def unit(self, role: str) -> str | None:
        """Return the option for the unit of ``t``, ``v`` or ``y``."""
        return {'t': self.time_unit, 'v': self.voltage_unit, 'y': self.displacement_unit}[role]


def plain_unit(text: str) -> str:
    """
    Return a unit with the letters of `UNITS`; both micro signs become u.

    >>> [plain_unit(x) for x in ('\u00b5m', '\u03bcm', 'Volts', 'sec', 'MS', 'furlong')]
    ['um', 'um', 'V', 's', 'ms', 'furlong']
    """
    # NFKC turns the micro sign into the Greek letter
    text = unicodedata.normalize('NFKC', text).strip().replace('\u03bc', 'u')
    known = {unit.lower(): unit for units in UNITS.values() for unit in units}
    return known.get(text.lower()) or _SPELT.get(text.lower(), text)


def scaled_unit(role: str, text: str) -> str:
    """
    Return a unit of ``t``, ``v`` or ``y`` with the letters of `UNITS`; empty for other texts.

    >>> scaled_unit('y', ' 10 micron/V'), scaled_unit('y', 'um/V'), scaled_unit('v', '20V')
    ('10um/V', '1um/V', '20V')
    >>> scaled_unit('y', '0um')
    ''
    """
    number, unit, of_volts = split_unit(text)
    if unit not in UNITS[role] or (of_volts and role == 't'):
        return ''
    if number and not SMALL < float(number) < 1.0 / SMALL:
        return ''
    return f'{number or "1"}{unit}/V' if of_volts else number + unit


def split_unit(text: str) -> tuple[str, str, bool]:
    """
    Return the number before a unit, the unit with the letters of `UNITS`, and whether /V follows.

    >>> split_unit('10 \u00b5m/V'), split_unit('sec'), split_unit('')
    (('10', 'um', True), ('', 's', False), ('', '', False))
    """
    match = _SCALED.fullmatch(text.strip())
    return (match[1], plain_unit(match[2]), bool(match[3])) if match else ('', '', False)


def unit_factor(role: str, unit: str) -> float:
    """
    Return how many of a unit from `scaled_unit` make one SI unit; 1 for an empty unit.

    >>> unit_factor('y', '10um/V'), unit_factor('v', 'mV')
    (100000.0, 1000.0)
    """
    number, plain, _ = split_unit(unit)
    return UNITS.get(role, {}).get(plain, 1.0) / float(number or 1.0)


def name_and_unit(name: str) -> tuple[str, str]:
    """
    Return a column's name without its unit, and the unit.

    >>> [name_and_unit(x) for x in ('t [s]', 'Time (ms)', 'y/\u00b5m', 'position_um', 'drive')]
    [('t', 's'), ('Time', 'ms'), ('y', 'um'), ('position', 'um'), ('drive', '')]
    """
    # keep the name of the field or channel, and drop the name of its struct or group
    name = re.sub(PATH, '', name.strip())
    match = _NAMED.fullmatch(name)
    if not match:
        return name, ''
    unit = plain_unit(next((match[k] for k in 'abcd' if match[k] is not None), ''))
    known = any(unit in units for units in UNITS.values())
    if match['bare'] is not None:
        # v_min is no time
        return (match['bare'].strip(' _.'), unit) if known and unit != 'min' else (name, '')
    # a text in square brackets is a unit, known or not
    return (match['name'], unit) if known or match['a'] is not None else (name, '')


#: least number before a unit, and the inverse of the largest
SMALL = 1e-12
#: a unit, a number before it, and volts below it
_SCALED = re.compile(r'(\d*\.?\d+(?:e[-+]?\d+)?|)\s*([^\d/]+?)\s*(/\s*V)?', re.IGNORECASE)
#: a name with its unit
_NAMED = re.compile(
    r'(?P<name>.*?)\s*(?:\[(?P<a>[^][]*)\]|\((?P<b>[^()]*)\)|/\s*(?P<c>[^\W\d]+))'
    r'|(?P<bare>.*?)(?:[_\s.]+|\bin\s+)(?P<d>[^\W\d_]+)'
)
#: the structs or groups before the name of a column
PATH = r'^(\w+\.)+(?=\S)'
_SPELT = {
    **dict.fromkeys(('sec', 'secs', 'second', 'seconds', 'sekunden'), 's'),
    **dict.fromkeys(('msec', 'millisecond', 'milliseconds'), 'ms'),
    **dict.fromkeys(('usec', 'microsecond', 'microseconds'), 'us'),
    **dict.fromkeys(('minute', 'minutes'), 'min'),
    **dict.fromkeys(('volt', 'volts'), 'V'),
    **dict.fromkeys(('millivolt', 'millivolts'), 'mV'),
    **dict.fromkeys(('meter', 'metre', 'meters', 'metres'), 'm'),
    **dict.fromkeys(('millimeter', 'millimetre', 'millimeters', 'millimetres'), 'mm'),
    **dict.fromkeys(('micron', 'microns', 'micrometer', 'micrometre'), 'um'),
    **dict.fromkeys(('micrometers', 'micrometres', 'mikrometer'), 'um'),
    **dict.fromkeys(('nanometer', 'nanometre', 'nanometers', 'nanometres'), 'nm'),
}


def parse_columns(text: str) -> dict[str, str]:
    """
    Return the column of each quantity; a name with a comma in it stands in double quotes.

    DataError if a part is no pair, or a quantity comes twice.

    >>> parse_columns('t=time_s, v=U [V],"y=x, filtered"')
    {'t': 'time_s', 'v': 'U [V]', 'y': 'x, filtered'}
    """
    columns: dict[str, str] = {}
    for part in next(csv.reader([text], skipinitialspace=True), []):
        role, sign, name = (x.strip() for x in part.partition('='))
        if not sign or not role or not name or role in columns:
            fault = f'{role} comes twice' if role in columns else f'{part[:60]!r} is no pair'
            raise DataError(
                f'--columns {text[:200]!r}: {fault}; '
                'write it as in --columns t=time_s,v=voltage,y=position_um'
            )
        columns[role] = name
    return columns
