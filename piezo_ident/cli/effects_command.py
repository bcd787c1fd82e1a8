# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``effects``: print the catalogue, or one effect in detail."""

from __future__ import annotations

from collections.abc import Sequence
import inspect
from types import SimpleNamespace
from typing import Any

import numpy as np
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import ConfigError, did_you_mean
from piezo_ident.effects import catalogue, Effect, Parameter
from piezo_ident.report.table import plain_text, Table


def effect_name(text: str) -> str:
    """Check the name of an effect; ConfigError suggests a similar name."""
    if text in catalogue():
        return text
    cure = did_you_mean(text.lower().replace('-', '_'), catalogue()) or 'see piezo_ident effects'
    raise ConfigError(f'unknown effect {text!r}; {cure}')


def effect_names(texts: Sequence[str]) -> tuple[str, ...]:
    """Split names of effects at commas, check them, and drop repeated names."""
    names = [name.strip() for text in texts for name in text.split(',')]
    return tuple(dict.fromkeys(effect_name(name) for name in names if name))


def effects_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident effects``."""
    if args.name is not None:
        effect = catalogue()[effect_name(args.name)]
        console.say(f'{_at_length(effect)}\n\n{_documentation(effect)}')
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
    # for a plug-in that lacks a docstring, `inspect.getdoc` would take the text of the base class
    return inspect.cleandoc(effect.__doc__ or '')


def _at_length(effect: type[Effect]) -> str:
    notes = [
        (effect.rate_independent, 'follows the path of the voltage alone, as hysteresis does'),
        (effect.in_dynamics, 'changes the dynamics: named beyond errors of identification'),
        (effect.time_driven, 'driven by time: its amplitudes differ from record to record'),
    ]
    head = ('parameter', 'unit', 'from', 'to', 'neutral', 'default', '')
    parameters = Table('', head, [_row(p) for p in effect.parameters])
    return plain_text(
        [
            _title(effect),
            _about(effect),
            f'shows in: {effect.needs}' if effect.needs else '',
            *(text for holds, text in notes if holds),
            parameters,
        ]
    )


def _row(p: Parameter) -> tuple[str, ...]:
    default = '' if p.default is None else str(p.default)
    if p.kind == 'text':
        return (p.name, 'text', '', '', '', default, p.description)
    neutral = '' if np.isnan(p.neutral) else f'{p.neutral:g}'
    about = f'{p.description} (a list)' if p.vector else p.description
    return (p.name, p.unit, f'{p.lower:g}', f'{p.upper:g}', neutral, default, about)


def _data(effect: type[Effect]) -> dict[str, Any]:
    keys = ('name', 'unit', 'description', 'neutral', 'lower', 'upper', 'default', 'kind')
    return {
        'name': effect.name,
        'slot': effect.slot,
        'about': _about(effect),
        'needs': effect.needs,
        'time_driven': effect.time_driven,
        'module': effect.__module__,
        'parameters': [
            {**{key: getattr(p, key) for key in keys}, 'list': p.vector} for p in effect.parameters
        ],
        'documentation': _documentation(effect),
    }
