# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``effects``: print the catalogue, or one effect in detail."""

from __future__ import annotations

from collections.abc import Sequence
import difflib
import inspect
import textwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import ConfigError
from piezo_ident.effects import catalogue, Effect, Parameter

#: width of the text [characters]
WIDTH = 99


def effect_name(text: str) -> str:
    """Check the name of an effect; ConfigError suggests a similar name."""
    if text in catalogue():
        return text
    close = difflib.get_close_matches(text.lower().replace('-', '_'), catalogue(), n=1)
    cure = f'did you mean {close[0]}?' if close else 'see piezo_ident effects'
    raise ConfigError(f'unknown effect {text!r}; {cure}')


def effect_names(texts: Sequence[str]) -> tuple[str, ...]:
    """Split names of effects at commas, check them, and drop repeated names."""
    names = [name.strip() for text in texts for name in text.split(',')]
    return tuple(dict.fromkeys(effect_name(name) for name in names if name))


def effects_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident effects``."""
    if args.name is not None:
        effect = catalogue()[effect_name(args.name)]
        for line in _at_length(effect):
            console.say(line)
        console.result(_data(effect))
        return
    effects = [effect for _, effect in sorted(catalogue().items())]
    for effect in effects:
        console.say(_title(effect))
        console.say(f'    {_about(effect)}')
        if effect.needs:
            console.say(f'    shows in: {effect.needs}')
    console.say('\npiezo_ident effects NAME says more about one of them')
    console.result([_data(effect) for effect in effects])


def _title(effect: type[Effect]) -> str:
    package = effect.__module__.partition('.')[0]
    own = '' if package == 'piezo_ident' else f'  from {package}'
    return f'{effect.name}  (slot: {effect.slot}){own}'


def _about(effect: type[Effect]) -> str:
    return effect.description or _documentation(effect).partition('\n')[0]


def _documentation(effect: type[Effect]) -> str:
    # `inspect.getdoc` would give a plug-in without a docstring the text of the base class
    return inspect.cleandoc(effect.__doc__ or '')


def _at_length(effect: type[Effect]) -> list[str]:
    lines = [_title(effect), *textwrap.wrap(_about(effect), WIDTH)]
    if effect.needs:
        lines += textwrap.wrap(f'shows in: {effect.needs}', WIDTH, subsequent_indent='  ')
    if effect.rate_independent:
        lines.append('follows the path of the voltage alone: a wide enough hysteresis imitates it')
    if effect.in_dynamics:
        lines.append('changes the dynamics: named beyond what the model missed at identification')
    if effect.time_driven:
        lines.append('driven by time: its amplitudes differ from record to record')
    head = ('parameter', 'unit', 'from', 'to', 'neutral', 'default', '')
    rows = [head, *(_row(p) for p in effect.parameters)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines.append('')
    for row in rows:
        cells = [cell.ljust(w) for cell, w in zip(row, widths, strict=True)]
        lines.append('  '.join(cells).rstrip())
    lines += ['', *_documentation(effect).splitlines()]
    return lines


def _row(p: Parameter) -> tuple[str, ...]:
    default = '' if p.default is None else str(p.default)
    if p.kind == 'text':
        return (p.name, 'text', '', '', '', default, p.description)
    neutral = '' if np.isnan(p.neutral) else f'{p.neutral:g}'
    about = f'{p.description} (a list)' if p.vector else p.description
    return (p.name, p.unit, f'{p.lower:g}', f'{p.upper:g}', neutral, default, about)


def _data(effect: type[Effect]) -> dict[str, Any]:
    return {
        'name': effect.name,
        'slot': effect.slot,
        'about': _about(effect),
        'needs': effect.needs,
        'time_driven': effect.time_driven,
        'module': effect.__module__,
        'parameters': [
            {
                'name': p.name,
                'unit': p.unit,
                'description': p.description,
                'neutral': p.neutral,
                'lower': p.lower,
                'upper': p.upper,
                'default': p.default,
                'kind': p.kind,
                'list': p.vector,
            }
            for p in effect.parameters
        ],
        'documentation': _documentation(effect),
    }
