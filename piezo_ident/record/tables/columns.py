# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the quantity of each column of a file.

The names ``t``, ``v``, ``y``, ``segment``, ``x_<name>``, ``v_<name>`` and ``y_<name>`` give the
quantity.  Otherwise the words and the unit of a header decide, if one column alone fits; a fault
reports the choice.  If no column or several columns fit, the error names the option that decides.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import re
import shlex

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.record.channels import channel_of_column, role_of
from piezo_ident.record.options import name_and_unit, PATH, ReadOptions, split_unit, UNITS
from piezo_ident.record.record import Fault

_QUANTITIES = {'t': 'time', 'v': 'voltage', 'y': 'displacement'}
_WORDS = {
    't': 't time times zeit timestamp elapsed temps tiempo',
    'v': 'v u voltage volt volts spannung command drive input vin uin tension',
    'y': 'y displacement disp position pos weg auslenkung verschiebung deflection elongation '
    'stroke sensor gauge feedback measured',
}
#: names, letters only, of the sampling rate or the sampling period beside the columns
_RATES = r'fs|rate|(sampl(e|ing)|scan)(rate|frequency)|samplesper(s|sec|second)'
_PERIODS = (
    r'd[tx]|ts|delta[tx]|(sampl(e|ing)|scan)(time|interval|period)|tinterval|'
    r'(wf|t|x|time)?incr?(ement)?|timestep|hresolution'
)
#: names of numbers that are likely a rate, or a period
_LIKELY = (
    '.*(sampl|scan|acqui|record).*(rate|freq|clock).*',
    'sampling|interval|.*(sampl|scan|acqui|record|time).*(interval|incr|period|step|resol).*',
)
_HERTZ = re.compile(r'(|k|M|G)(Hz|Sa?/s)', re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class RecordTable:
    """
    Raw columns of a file, shape (n,), by quantity; without ``t`` if the `rate` [Hz] is known.

    `names` and `starts` are the label and the first row of each stretch, `ignored` the columns
    that are not read, `units` the units in the file or the options.  `faults` report guesses.
    """

    columns: dict[str, Array]
    names: list[str] = field(default_factory=list)
    starts: ArrayLike = ()
    ignored: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    rate: float | None = None
    faults: tuple[Fault, ...] = ()


def listed(names: Iterable[str]) -> str:
    """Return names for a message, in one short line."""
    shown = ', '.join(n if n.isprintable() else ascii(n) for n in names if n)
    return shown if len(shown) <= 200 else f'{shown[:200]}...'


def choose(
    names: Sequence[str],
    options: ReadOptions,
    path: Path,
    *,
    scalars: Mapping[str, float] | None = None,
    empty: Iterable[int] = (),
) -> tuple[dict[str, int], RecordTable]:
    """
    Return the place of each quantity among the columns, and a table that lacks the columns.

    The names are those of the file; a name may be empty or stand twice.  The `scalars`, numbers
    beside the columns, may hold a sampling rate; `empty` are the places of empty columns.
    DataError for a missing or ambiguous quantity; the message names the option and the file.
    """
    by_option = {role: _place(role, name, names, path) for role, name in options.named.items()}
    for role in by_option:
        if role not in ('t', 'v', 'y', 'segment') and not channel_of_column(role):
            raise DataError(f'{path}: --columns {role}: {role[2:]} is a unit; name it otherwise')
    rate, origin = options.rate, '--rate'
    if rate is not None and 't' in by_option:
        raise DataError(f'{path}: --rate and a column of time do not go together; drop one')
    wanted = [role for role in 'tvy' if role != 't' or rate is None]
    exact = [role for role in (*wanted, 'segment') if role not in by_option]
    places = by_option | _exact(exact, names, {*by_option.values(), *empty}, path)
    free = [i for i in range(len(names)) if i not in {*places.values(), *empty}]
    guessed = _guessed([role for role in wanted if role not in places], names, free, places, path)
    free = [i for i in free if i not in guessed.values()]
    if rate is None and 't' not in {*places, *guessed}:
        rate, origin = _rate_of(scalars or {})
    known = {*places, *guessed, *('t' if rate is not None else '')}
    missing = [role for role in options.needed if role not in known]
    if missing:
        raise _missing(missing, names, free, rate_option(scalars or {}), path)
    places |= guessed
    _add_channels(places, free, names, path)
    roles = ('t', 'v', 'y', *filter(role_of, places))
    units = {role: _unit_of(role, places, names, options, path) for role in roles}
    used = set(places.values())
    faults = []
    if guessed or by_option or (rate is not None and options.rate is None):
        parts = [] if rate is None else [f't is k / {rate:.9g} Hz by {origin}']
        for role in filter(places.__contains__, 'tvy'):
            k = places[role]
            name = repr(names[k]) if names[k] else f'column {k + 1}'
            plain = f'{next(iter(UNITS[role]))} as no unit is named'
            parts.append(f'{role} is {name} in {units[role] or plain}')
        action = 'guessed; --columns names others' if guessed else 'as named'
        faults.append(Fault('columns', ', '.join(parts), len(parts), action))
    ignored = tuple(n for i, n in enumerate(names) if n and i not in used)
    named = {role: unit for role, unit in units.items() if unit}
    return places, RecordTable({}, [], (), ignored, named, rate, tuple(faults))


def _exact(
    roles: Iterable[str], names: Sequence[str], barred: Collection[int], path: Path
) -> dict[str, int]:
    """Return the places of columns whose names are quantities."""
    places: dict[str, int] = {}
    for role in roles:
        here = [i for i, name in enumerate(names) if name == role and i not in barred]
        if len(here) > 1:
            way = f'--columns {role}={here[0] + 1}'
            fault = f'column {role} stands there twice; keep one, or name its number'
            raise DataError(f'{path}: {fault}: {way}', options=way)
        places.update((role, i) for i in here)
    return places


def _guessed(
    roles: Iterable[str],
    names: Sequence[str],
    free: Sequence[int],
    places: Mapping[str, int],
    path: Path,
) -> dict[str, int]:
    """Return the places of quantities whose words and units fit one free column alone."""
    guessed: dict[str, int] = {}
    for role in roles:
        near = [i for i in free if i not in guessed.values() and not _is_apart(role, i, names)]
        fitting = _fitting(role, [(i, names[i]) for i in near])
        if len(fitting) > 1:
            # of several groups, the group of the known columns
            groups = {_group(names[i]) for i in {*places.values(), *guessed.values()}} - {''}
            fitting = [i for i in fitting if _group(names[i]) in groups] or fitting
        if len(bare := [i for i in fitting if name_and_unit(names[i])[0] == role]) == 1:
            # v [V] beside v_b [V]
            fitting = bare
        if len(fitting) > 1:
            titles = [names[i] for i in fitting]
            # numbers distinguish equal names
            ways = titles if len({*titles}) == len(titles) else [str(i + 1) for i in fitting]
            first, second = (_option(role, way) for way in ways[:2])
            fault = f'{len(titles)} columns may be the {_QUANTITIES[role]} ({listed(titles)})'
            cure = f'say which: {first} or {second}'
            if role in 'vy' and _may_be_axes(names):
                cure += '; for two axes name all columns with --columns: v, y, v_b and y_b'
            raise DataError(f'{path}: {fault}; {cure}', options=first)
        guessed.update((role, i) for i in fitting)
    return guessed


def _may_be_axes(names: Sequence[str]) -> bool:
    """Return whether several columns may be a voltage, and several a displacement."""
    # v_y is a voltage, though its words name a displacement too; a unit tells for X and Y
    roles = [
        role_of(base) or next((role for role in 'vy' if unit in UNITS[role]), '')
        for base, unit in map(name_and_unit, names)
    ]
    columns = [(i, name) for i, name in enumerate(names) if not roles[i]]
    return all(roles.count(role) + len(_fitting(role, columns)) > 1 for role in 'vy')


def _is_apart(role: str, place: int, names: Sequence[str]) -> bool:
    """Return whether a column belongs to a further axis: y_b, with v_b beside v."""
    bases, partner = [name_and_unit(name)[0] for name in names], {'v': 'y', 'y': 'v'}.get(role, '')
    return bool(role_of(bases[place])) and {partner, partner + bases[place][1:]} <= {*bases}


def _add_channels(
    places: dict[str, int], free: Iterable[int], names: Sequence[str], path: Path
) -> None:
    """Add the columns of further axes and channels to the places."""
    # of several groups, the group of the first axis
    group = next((_group(names[places[role]]) for role in 'vy' if role in places), '')
    for i in free:
        base = name_and_unit(names[i])[0]
        is_axis = role_of(base) and _group(names[i]) == group
        role = base if is_axis else names[i]
        if not channel_of_column(role):
            continue
        channels = [channel_of_column(place) for place in places]
        if channel_of_column(role) in channels:
            raise DataError(f'{path}: column {role} stands there twice; keep one of them')
        places[role] = i


def _place(role: str, wanted: str, names: Sequence[str], path: Path) -> int:
    """Return the place of a column by its name, its name without unit, or its number."""
    low = wanted.strip().casefold()
    is_number = wanted.isdecimal() and 1 <= int(wanted) <= len(names)
    words = None if is_number else words_of(wanted) or None
    # a wanted 1 is the first column, not the channel 1 [V] of an oscilloscope
    others = [] if is_number else [name_and_unit(name)[0] for name in names]
    for ways, one in (
        ([*names], wanted),
        ([name.strip().casefold() for name in names], low),
        ([name.casefold() for name in others], low),
        # run1/ao0 for run1.ao0
        ([words_of(name) for name in names], words),
        ([words_of(_group(x) + name) for x, name in zip(names, others, strict=False)], words),
    ):
        here = [i for i, way in enumerate(ways) if way == one]
        if len(here) > 1:
            option = f'--columns {role}={here[0] + 1} or {role}={here[1] + 1}'
            fault = f'column {listed([wanted])} stands there twice; say which by its number'
            raise DataError(f'{path}: {fault}: {option}')
        if here:
            return here[0]
    if is_number:
        return int(wanted) - 1
    known = listed(names) or f'1 to {len(names)}'
    fault = f'no column {listed([wanted])!r}; --columns {role}=NAME takes one of'
    raise DataError(f'{path}: {fault}: {known}')


def _group(name: str) -> str:
    """Return the struct or group of a column."""
    match = re.match(PATH, name)
    return match[0] if match else ''


def words_of(name: str) -> tuple[str, ...]:
    """
    Return the words of a name, since programs write the path to a column in different ways.

    >>> words_of("/'Log'/'Strain gauge'"), words_of('out.signals(2).values')
    (('log', 'strain', 'gauge'), ('out', 'signals', '2', 'values'))
    """
    return tuple(re.findall(r'\w+', name.casefold()))


def _fitting(role: str, columns: Iterable[tuple[int, str]]) -> list[int]:
    """Return the places of columns whose words name a quantity, else whose unit does."""
    by_word, by_unit = [], []
    for i, name in columns:
        base, unit = name_and_unit(name)
        measured = next((r for r, units in UNITS.items() if unit in units), None)
        if measured not in (None, role):
            continue
        # LabVIEW's name for time
        base = 'time' if base.casefold() == 'x_value' else base
        words = set(re.findall(r'[^\W\d_]+', re.sub(r'([a-z])([A-Z])', r'\1 \2', base).casefold()))
        named = {r for r, known in _WORDS.items() if words & set(known.split())}
        # a name with words of two quantities, as `sensor voltage`, fits neither quantity
        if named == {role}:
            by_word.append(i)
        elif measured and not named:
            by_unit.append(i)
    return by_word or by_unit


def _rate_of(
    scalars: Mapping[str, float], names: tuple[str, str] = (_RATES, _PERIODS)
) -> tuple[float | None, str]:
    """Return the sampling rate among some numbers, and its name."""
    for name, value in scalars.items():
        # square brackets keep a unit that `UNITS` lacks
        base, unit = name_and_unit(re.sub(r'\((\w[^()]*)\)\s*$', r'[\1]', name))
        base = re.sub(r'[^a-z]', '', base.casefold())
        if not (value > 0 and np.isfinite(value)):
            continue
        hertz = _HERTZ.fullmatch(unit or 'Hz')
        if hertz and re.fullmatch(names[0], base):
            return value * {'': 1.0, 'k': 1e3, 'm': 1e6, 'g': 1e9}[hertz[1].lower()], name
        if unit in ('', *UNITS['t']) and re.fullmatch(names[1], base):
            return UNITS['t'][unit or 's'] / value, name
    return None, ''


def rate_option(scalars: Mapping[str, float]) -> str:
    """
    Return an option with a likely sampling rate among some numbers, or with an example.

    >>> rate_option({'Recording step [ms]': 0.5}), rate_option({'Trigger [V]': 0.5})
    ('--rate 2000', '--rate 20e3')
    """
    rate = _rate_of(scalars)[0] or _rate_of(scalars, _LIKELY)[0]
    return f'--rate {rate:.9g}' if rate else '--rate 20e3'


def _unit_of(
    role: str, places: Mapping[str, int], names: Sequence[str], options: ReadOptions, path: Path
) -> str:
    """Return the unit of a column by its header and the option; empty without either."""
    first = role_of(role) or role
    # the unit of the first axis holds for the others
    own = [names[places[r]] for r in (role, first) if r in places]
    name = next((x for x in own if name_and_unit(x)[1]), '')
    unit, wanted = name_and_unit(name)[1], options.unit(first) or ''
    kind = next((r for r, units in UNITS.items() if unit in units), None)
    number, plain, of_volts = split_unit(wanted)
    if not unit or (wanted and not kind):
        return wanted
    if number and kind == 'v' and plain != unit:
        # the number of the option is for one volt, also under a header of mV
        return f'{float(number) / UNITS["v"][unit]:.15g}{plain}'
    if number and (kind == 'v' or not of_volts):
        return wanted
    # an axis whose header has a unit of its own keeps it
    if kind == first and (wanted in ('', unit) or (role != first and not number)):
        return unit
    raise _contradiction(first, kind, name, unit, wanted, path)


def _contradiction(
    role: str, kind: str | None, name: str, unit: str, wanted: str, path: Path
) -> DataError:
    """Return the error for a unit of a header that contradicts the quantity or the option."""
    option = f'--{_QUANTITIES[role]}-unit'
    common = [*UNITS[role]][-2]
    column = f'{path}: {listed([name])} is to be the {_QUANTITIES[role]}, '
    if kind is None:
        way = f'{option} {common}'
        fault = f'whose unit {unit!r} is unknown; name another column, or its unit: {way}'
        return DataError(f'{column}{fault}', options=way)
    if kind != role:
        one, scale = ('V', f'10{common}/V') if kind == 'v' else (unit, f'10{common}')
        return DataError(
            f'{column}but its unit is of a {_QUANTITIES[kind]}; name another column, or what one '
            f'{one} is, as in {option} {scale}'
        )
    _, plain, of_volts = split_unit(wanted)
    cure = 'leave the option out'
    if not of_volts:
        # how many of the header's unit make one volt
        cure += f', or overrule it by {option} {UNITS["v"].get(unit, 1.0):g}{plain}'
    return DataError(f'{column}in {unit} by the header, and {option} says {wanted}; {cure}')


def _option(role: str, name: str) -> str:
    return f'--columns {shlex.quote(f"{role}={name}")}'


def _missing(
    missing: list[str], names: Sequence[str], free: list[int], rate: str, path: Path
) -> DataError:
    # a column of time, or of counts, is no example for another quantity
    likely = ('', *UNITS['v'], *UNITS['y'])
    fit = [i for i in free if 't' in missing or name_and_unit(names[i])[1] in likely] or free
    # of several runs in a file, the columns of the run that was named
    groups = {_group(name) for i, name in enumerate(names) if i not in free}
    fit = [i for i in fit if _group(names[i]) in groups] or fit
    ways = [names[i] or str(i + 1) for i in fit]
    fault = f'{path}: {", ".join(missing)} missing (found: {listed(names) or "nothing"})'
    further = ''
    if missing == ['t']:
        further = f', or the column of time: {_option("t", ways[0])}' if ways else ''
        return DataError(f'{fault}; give the sampling rate, as in {rate}{further}', options=rate)
    if len(ways) < len(missing) and missing[0] == 't':
        # not enough columns for time too
        missing, further = missing[1:], f' {rate}'
    if len(ways) < len(missing):
        return DataError(f'{fault}; add a column named {missing[-1]} to the file')
    # an example that can be typed
    pairs = ','.join(f'{role}={name}' for role, name in zip(missing, ways, strict=False))
    options = f'--columns {shlex.quote(pairs)}{further}'
    either = f', or without a column of time {rate}' if 't' in missing else ''
    return DataError(f'{fault}; name the columns, as in {options}{either}', options=options)
