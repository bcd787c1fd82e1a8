# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Scale a program to another voltage range and another sampling rate, and write it as text."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.catalogue import Option, SIGNALS
from piezo_ident.excitation.program import Program
import yaml

#: highest frequency over the sampling rate; noise ends at 1.2 times its cutoff
HIGHEST = 0.4


def scaled(program: Program, limits: tuple[float, float], sample_rate: float) -> Program:
    """
    Scale a program to other limits [V] and another sampling rate [Hz]; its duration stays.

    Levels are shifted and scaled, sizes and speeds scaled.  Frequencies above 0.4 times the
    sampling rate are lowered to it.  Raises ConfigError for a signal with voltages of its own.

    >>> import piezo_ident as pi
    >>> v = scaled(pi.Program.load('validation'), (-20, 120), 2000).build().v
    >>> float(v.min()), float(v.max())
    (-20.0, 120.0)
    """
    (low, high), lowest = limits, program.limits[0]
    factor = (high - low) / (program.limits[1] - lowest)

    def fit(option: Option, x: Any) -> Any:
        if isinstance(x, list):
            return [fit(option, each) for each in x]
        if x is None or option.unit not in ('V', 'V/s', 'Hz'):
            return x
        if option.unit == 'Hz':
            return min(x, HIGHEST * sample_rate)
        # a size is a difference of levels, so a shift does not change it
        return factor * x if option.positive else low + factor * (x - lowest)

    entries = []
    for entry in program.entries:
        if entry.options.get('preset') == 'paper' and limits != program.limits:
            raise ConfigError(
                f'{program.name}: preset: paper cannot be scaled; give peaks, base and slope'
            )
        known = SIGNALS[entry.signal].options
        options = {key: fit(known[key], x) for key, x in entry.options.items()}
        entries.append(replace(entry, options=MappingProxyType(options)))
    return replace(
        program,
        entries=tuple(entries),
        limits=(low, high),
        sample_rate=sample_rate,
        # rounding must not lead out of the limits
        rest=min(max(low + factor * (program.rest - lowest), low), high),
        slew=factor * program.slew,
    )


def program_to_yaml(program: Program) -> str:
    """
    Write the text of a program, which `pi.Program.load` reads from a file.

    >>> import piezo_ident as pi
    >>> from piezo_ident.excitation.program import parse_program
    >>> program = scaled(pi.Program.load('holds'), (0, 120), 10_000)
    >>> again = parse_program(program_to_yaml(program))
    >>> bool((again.build().v == program.build().v).all())
    True
    """
    head = {
        'limits': [float(x) for x in program.limits],
        'sample_rate': program.sample_rate,
        'seed': program.seed,
        'rest': program.rest,
        'slew': program.slew,
    }
    lines = [f'{key}: {_flow(value)}' for key, value in head.items() if value is not None]
    lines.append('segments:')
    for entry in program.entries:
        named = {} if entry.name is None else {'name': entry.name}
        set_options = {key: x for key, x in entry.options.items() if x is not None}
        lines.append(f'  - {_flow({"signal": entry.signal, **named, **set_options})}')
    return '\n'.join([*lines, ''])


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**9)
    return text.removesuffix('...\n').strip()
