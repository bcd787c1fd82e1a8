# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Declare the options of all verbs in lists, without heavy imports.

A new way to read records is one line of `READING` under the name of a field of `ReadOptions`.
Every verb that reads records then has this option.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import os
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem
from piezo_ident.common.config import shipped_names
from piezo_ident.common.errors import ConfigError
from piezo_ident.identification.settings import SOLVERS
from piezo_ident.record.options import parse_columns, scaled_unit, UNITS


def _name(text: str) -> str:
    # an empty shell variable would mean the working folder
    if not text.strip():
        raise click.BadParameter(f'{text!r} is empty; give a name, or leave it out')
    if text.startswith('--'):
        raise click.BadParameter(f'{text!r} is an option; a name is missing before it')
    return text


def _file(text: str) -> Path:
    return Path(_name(text))


def _columns(ctx: Any, param: Any, parts: tuple[str, ...]) -> str | None:
    text = ','.join(parts)
    parse_columns(text)  # refused before any work
    return text or None


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise click.BadParameter(f'{text!r} is no whole number; give 0 or more')
    return int(text)


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not speed > 0.0:
        raise click.BadParameter(f'{text!r} is no speed; give volts a second, above 0')
    return speed


def _order(text: str) -> tuple[int, ...]:
    parts = text.split(',')
    if len(parts) != 2:
        raise click.BadParameter(f'{text!r} is no order; give two numbers, say 10,10')
    return tuple(map(_whole, parts))


def _thresholds(text: str) -> int | None:
    if text != 'auto' and not text.isdecimal():
        raise click.BadParameter(f'{text!r}: give a number, or auto')
    return None if text == 'auto' else int(text)


def _limits(ctx: Any, param: Any, limits: tuple[float, float] | None) -> Any:
    if limits is not None and not limits[0] < limits[1]:
        raise click.BadParameter('give two numbers, the lower one first')
    return limits


def _among(known: Callable[[], Iterable[str]]) -> dict[str, Any]:
    """Complete a name from the known names, or else from files."""

    def complete(ctx: Any, param: Any, start: str) -> list[CompletionItem]:
        names = [CompletionItem(x) for x in known() if x.startswith(start)]
        return names or [CompletionItem(start, type='file')]

    return {'shell_complete': complete}


def _effects() -> Iterable[str]:
    from piezo_ident.effects import catalogue

    return catalogue()


def _option(name: str, kind: Any, metavar: str | None, text: str, **more: Any) -> click.Option:
    # an absent option is None; the defaults stand in the settings
    more = {**(_among(tuple) if kind is _file else {}), **more}
    return click.Option([name], type=kind, metavar=metavar, help=text, **more)


def _apart(ctx: Any, param: Any, path: Path | None) -> Path | None:
    """Refuse an output at the path of another output of the command."""
    for other in (x for x in ctx.command.params if x.callback is _apart):
        name, place = other.opts[0], ctx.params.get(other.name)
        # a place is absent until its option is parsed
        if path and isinstance(place, Path) and os.path.realpath(place) == os.path.realpath(path):
            both = f'{name} {place} and {param.opts[0]} {path}'
            raise ConfigError(f'{both} are one path; give each output a path of its own')
    return path


def _output(name: str, metavar: str, text: str) -> click.Option:
    return _option(name, _file, metavar, text, callback=_apart)


def _unit_of(quantity: str, role: str) -> click.Option:
    known = UNITS[role]

    def unit(text: str) -> str:
        if not (scaled := scaled_unit(role, text)):
            raise click.BadParameter(f'{text!r} is no unit; give {", ".join(known)}')
        return scaled

    volt = {'v': ', or one volt of a monitor', 'y': ', or one volt of a sensor'}.get(role, '')
    text = (
        f'Unit of {role} in the files (default: by the header, else {next(iter(known))}). '
        f'A number, as in 10{[*known][-2]}, says what a 1 in the file stands for{volt}.'
    )
    return _option(f'--{quantity}-unit', unit, '|'.join(known), text)


def _flag(name: str, text: str) -> click.Option:
    return click.Option([name], is_flag=True, help=text)


def _argument(name: str, metavar: str, **more: Any) -> click.Argument:
    return click.Argument([name], metavar=metavar, **{'type': _file, **_among(tuple), **more})


JSON = _flag('--json', 'Print the result as JSON, also an error.')
OVERWRITE = _flag('--overwrite', 'Replace outputs that exist.')

MODEL, MODEL_FILE = _argument('model', 'MODEL'), _argument('model_file', 'MODEL')
IN, OUT = _argument('record', 'IN'), _argument('out', 'OUT')
REFERENCE = _argument('record', 'REFERENCE')
RECORD = _argument('record', 'RECORD')
RECORDS = _argument('records', 'RECORD...', nargs=-1, required=True)
EFFECT = _argument('name', '[NAME]', type=_name, required=False, **_among(_effects))
NODE = _argument('name', '[NAME]', type=str, required=False)
NODE_ARGUMENTS = _argument('arguments', '[ARGUMENTS]...', nargs=-1, type=click.UNPROCESSED)

#: options for reading records: fields of `ReadOptions`, which holds their defaults
READING = [
    _option(
        *('--columns', str, 't=NAME,...'),
        'Name or number of t, v, y, and v_b, y_b of a second axis (default: by the header).',
        multiple=True,
        callback=_columns,
    ),
    _option('--rate', float, 'HZ', 'Samples a second of files without time, as in 20e3.'),
    _unit_of('time', 't'),
    _unit_of('voltage', 'v'),
    _unit_of('displacement', 'y'),
    _option('--voltage-limits', float, 'LO HI', 'Allowed range [V].', nargs=2, callback=_limits),
    _option('--namespace', _name, 'NAME', 'Namespace of the topics of a bag.'),
    _option('--voltage-topic', _name, 'TOPIC', 'Topic of a bag with the voltage.'),
    _option('--displacement-topic', _name, 'TOPIC', 'Topic of a bag with the displacement.'),
]

EACH = [
    _option('--each', _file, 'DIR', 'Process every record on its own; finished results stay.'),
    _option('--jobs', _whole, 'N', 'Processes (default: one a core).'),
    _option('--scheduler', _name, 'ADDRESS', 'Dask scheduler whose workers do the work.'),
    _flag('--reports', 'Write a report of every record, too.'),
]

RESULTS = [
    _output('--model', 'YAML', 'Write the model there.'),
    _output('--report', 'DIR', 'Write page and pictures there.'),
    _option('--validation', _file, 'RECORD...', 'Predict these; do not fit them.', multiple=True),
    OVERWRITE,
]

OUTPUT = [
    OVERWRITE,
    _option('--storage', click.Choice(['mcap', 'sqlite3']), None, 'Of a bag (default: mcap).'),
]

PREDICT = [
    _output('--out', 'OUT', 'Table .csv or .npz with the columns t, v, y, y_hat, estimate.'),
    _output('--plot', 'PICTURE', 'Picture of measured and predicted.'),
    _option(
        '--interval',
        click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
        'P',
        'Band that holds this share of the errors, for example 0.9; column half_width of OUT.',
    ),
    OVERWRITE,
]

INVERT = [
    _output('--out', 'OUT', 'Table .csv or .npz with the columns t, v.'),
    _output('--plot', 'PICTURE', 'Picture of voltage, wanted and predicted motion.'),
    OVERWRITE,
]

EXPORT = [
    _output('--out', 'FILE', 'Header .h or unit .fmu.'),
    _option('--format', click.Choice(['c', 'fmu']), None, 'Default: by the ending of FILE.'),
    _option('--name', _name, 'NAME', 'Start of all names in it (default: the name of the file).'),
    OVERWRITE,
]

#: options for reading a wanted motion
MOTION = [x for x in READING if x.name in ('columns', 'rate', 'time_unit', 'displacement_unit')]

#: limits of a voltage
KEPT = [
    _option(
        *('--limits', float, 'LO HI', 'Range of the voltage [V] (default: the identified range).'),
        nargs=2,
        callback=_limits,
    ),
    _option('--slew', _speed, 'V/S', 'Largest speed of the voltage (default: any).'),
]
FEEDFORWARD = [
    *KEPT,
    _option('--preview', _whole, 'N', 'Most samples by which the motion is known ahead.'),
]
DRIVE = [*KEPT, _flag('--clip', 'Come as near as the limits allow, instead of refusing.')]


def _shipped(kind: str, default: str) -> dict[str, Any]:
    return {'default': default, **_among(lambda: shipped_names(kind))}


SIMULATE = [
    _option(
        *('--config', _name, 'STAGE', 'Stage: a file, or the name of one (default: stage_paper).'),
        **_shipped('stage_', 'stage_paper'),
    ),
    _option(
        *('--program', _name, 'FILE', 'Program, or the name of one (default: identification).'),
        **_shipped('program_', 'identification'),
    ),
    _option('--seed', _whole, 'N', "Seed of the sensor noise (default: the stage's own)."),
    _option('--sample-rate', float, 'HZ', "Sampling rate (default: the stage's own)."),
    _option(
        *('--limits', float, 'LO HI', "Scale the program to these [V] (default: the program's)."),
        nargs=2,
        callback=_limits,
    ),
    _flag('--voltage-only', 'Write the columns t, v and segment, to drive a real stage.'),
]

_solver = click.Choice(SOLVERS)
#: fields of `Settings`
IDENTIFY = [
    _option('--thresholds', _thresholds, 'N|auto', 'Plays of H (default: by held-out error).'),
    _option('--order', _order, 'NA,NB', 'Order of G, less slow poles (default: searched).'),
    _option('--max-order', _whole, 'N', 'Largest order of the search (default: 15).'),
    _option('--delay', _whole, 'SAMPLES', 'Delay (default: identified).'),
    _option('--hold-out', float, 'SECONDS', 'End of an unlabelled record that is held out.'),
    _option('--solver', _solver, None, 'Of the weights of H; joint: all in one fit, no steps.'),
    _flag('--polish', 'Let least squares finish the fit of the swarm.'),
    _option('--seed', _whole, 'N', 'Seed of the swarm (default: 0).'),
]

#: fields of `DiagnosisSettings`, and names of effects
_SEVERAL = {'multiple': True, **_among(_effects)}
DIAGNOSE = [
    _option('--only', _name, 'NAME', 'Try only this effect; may be repeated.', **_SEVERAL),
    _option('--without', _name, 'NAME', 'Leave out this effect; may be repeated.', **_SEVERAL),
    _option('--most-effects', _whole, 'N', 'Most effects that are added (default: 4).'),
    _option('--most-samples', _whole, 'N', 'Most samples searched, from the starts of records.'),
    _option('--seed', _whole, 'N', 'Seed of random numbers (default: 0).'),
]
