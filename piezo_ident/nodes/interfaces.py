# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What the graph says and hears as tables, and the tables as text for the documentation.

    python -m piezo_ident.nodes.interfaces docs/graph.md

rewrites what stands between the markers in a file; a test compares it with the declarations.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import re
import sys

from piezo_ident.nodes.parameters import NODES

__all__ = [
    'DIAGNOSTICS',
    'SERVICES',
    'STATES',
    'TOPICS',
    'Service',
    'State',
    'Topic',
    'Value',
    'parameter_table',
    'rewritten',
]

ARRAY = 'std_msgs/msg/Float64MultiArray'


@dataclass(frozen=True)
class Topic:
    """A topic: who publishes it, who listens, and its quality of service."""

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    qos: str
    contents: str


@dataclass(frozen=True)
class Service:
    """A std_srvs/Trigger service of a node."""

    node: str
    name: str
    does: str


@dataclass(frozen=True)
class State:
    """A word that a node's ``~/status`` may say as its state."""

    node: str
    name: str
    means: str


@dataclass(frozen=True)
class Value:
    """
    A value that a node reports on ``/diagnostics``.

    Attributes
    ----------
    node, name, means : str
    unit : str
        Empty when there is none.
    when : str
        From when on it is there; empty for always.
    """

    node: str
    name: str
    means: str
    unit: str = ''
    when: str = ''


_STREAM = 'reliable, keep last 100'
_LATCHED = 'reliable, transient local, 1'

TOPICS = (
    Topic(
        'voltage',
        ARRAY,
        ('excitation', 'player'),
        ('stage', 'identifier', 'model'),
        _STREAM,
        'blocks of (t, V): the command',
    ),
    Topic(
        'displacement',
        ARRAY,
        ('stage', 'player'),
        ('identifier', 'model', 'excitation'),
        _STREAM,
        'blocks of (t, m) with the t of the voltage',
    ),
    Topic(
        'applied_voltage',
        ARRAY,
        ('stage',),
        ('identifier',),
        _STREAM,
        'blocks of (t, V): what the amplifier got, after the guards',
    ),
    Topic(
        'captured',
        ARRAY,
        ('identifier',),
        ('excitation', 'player'),
        _STREAM,
        'every 20 ms while they come, rows for voltage and displacement: t of its newest sample, '
        'samples of both streams',
    ),
    Topic('prediction', ARRAY, ('model',), ('excitation', 'player'), _STREAM, 'blocks of (t, m)'),
    Topic(
        'residual', ARRAY, ('model',), (), _STREAM, 'blocks of (t, m): displacement - prediction'
    ),
    Topic(
        'preview',
        'sensor_msgs/msg/JointState',
        ('model',),
        (),
        'keep last 10',
        'mean, min and max over each 20 ms of displacement, prediction and residual, 50 Hz',
    ),
    Topic(
        'model',
        'std_msgs/msg/String',
        ('identifier',),
        ('model',),
        _LATCHED,
        'the model file as YAML',
    ),
    Topic(
        'report',
        'std_msgs/msg/String',
        ('identifier',),
        (),
        _LATCHED,
        'the last identification or diagnosis as JSON',
    ),
    Topic(
        '~/status',
        'diagnostic_msgs/msg/DiagnosticStatus',
        ('every node',),
        (),
        _LATCHED,
        'state, progress in %, message',
    ),
    Topic(
        '/diagnostics',
        'diagnostic_msgs/msg/DiagnosticArray',
        ('every node',),
        (),
        'keep last 10',
        'once a second: achieved rate, samples lost, head-room, residual',
    ),
)

SERVICES = (
    Service('excitation', 'start', 'plays the programme of the parameter `program`'),
    Service('excitation', 'stop', 'ramps to rest and ends the programme'),
    Service('identifier', 'run', 'asks the excitation for the programme, captures, identifies'),
    Service('identifier', 'identify', 'takes the three steps on what was captured'),
    Service('identifier', 'identify_delay', 'takes step 1 alone'),
    Service('identifier', 'identify_dynamics', 'takes step 2, after step 1'),
    Service('identifier', 'identify_hysteresis', 'takes step 3, and publishes the model'),
    Service(
        'identifier',
        'diagnose',
        'finds what the model lacks, adds it, and publishes the refined model; asks the '
        'excitation for what the captured data lack',
    ),
    Service('identifier', 'cancel', 'stops the work'),
    Service('identifier', 'clear', 'forgets what was captured'),
    Service('identifier', 'save', 'writes models, reports and pictures'),
    Service('recorder', 'start', 'opens a bag and records'),
    Service('recorder', 'stop', 'closes the bag'),
    Service('player', 'start', 'replays the bag from its beginning'),
    Service('player', 'stop', 'stops the replay'),
)

STATES = (
    State('excitation', 'idle', 'nothing was played yet'),
    State('excitation', 'waiting', 'looks for another publisher, waits for subscribers'),
    State('excitation', 'running', 'plays; further value: `segment`'),
    State('excitation', 'stopping', 'ramps to rest'),
    State('excitation', 'done', 'the programme was played to its end'),
    State('excitation', 'stopped', 'ended by `~/stop`, at rest'),
    State('excitation', 'failed', 'ended by itself, at rest; the message says why'),
    State('stage', 'idle', 'at rest, no stream; further value: `segment`'),
    State('stage', 'running', 'follows a stream'),
    State('stage', 'ramping', 'the stream fell silent: ramps to rest'),
    State('identifier', 'idle', 'captures what passes'),
    State('identifier', 'exciting', 'drives the excitation, and captures'),
    State('identifier', 'identifying', 'works on what was captured'),
    State('identifier', 'diagnosing', 'looks for what the model lacks'),
    State('identifier', 'saving', 'writes models, reports and pictures'),
    State('identifier', 'done', 'the work has come to its end; the message has the verdict'),
    State('identifier', 'failed', 'nothing came of it; the message says why'),
    State('identifier', 'cancelled', 'ended by `~/cancel`'),
    State('model', 'idle', 'starts'),
    State('model', 'waiting', 'for a model; further value: `models`, how many it took'),
    State('model', 'predicting', 'with a model'),
    State('recorder', 'idle', 'nothing was recorded yet'),
    State('recorder', 'recording', 'all publishers are met; further values as on `/diagnostics`'),
    State('recorder', 'done', 'the bag is closed'),
    State('recorder', 'failed', 'the bag could not be written; the message says why'),
    State('player', 'idle', 'nothing was replayed yet'),
    State('player', 'waiting', 'for subscribers'),
    State('player', 'playing', 'further values as on `/diagnostics`'),
    State('player', 'done', 'the bag was replayed; the message says if it ended early'),
    State('player', 'stopped', 'ended by `~/stop`'),
    State('player', 'refused', 'the bag cannot be replayed; the message says why'),
    State('player', 'failed', 'ended by itself; the message says why'),
)

_PLAYED = 'a first start'
_MODEL = 'there is a model'

DIAGNOSTICS = (
    Value('excitation', 'publishers', 'of voltage, this node included', '1'),
    Value('excitation', 'rate', 'samples sent', '1/s', _PLAYED),
    Value('excitation', 'samples', 'sent since the start', '1', _PLAYED),
    Value('excitation', 'segment', 'that is played', '', _PLAYED),
    Value('excitation', 'blocks', 'sent since the start', '1', 'the first block'),
    Value('excitation', 'late', 'of them sent after the next was due', '1', 'the first block'),
    Value('excitation', 'worst_delay', 'of a block', 's', 'the first block'),
    Value('excitation', 'slipped', 'by how much the schedule moved', 's', 'the first block'),
    Value(
        'excitation', 'head_room', 'share of the time that sending leaves', '1', 'the first block'
    ),
    Value('stage', 'rate', 'samples answered', '1/s'),
    Value('stage', 'samples', 'answered', '1'),
    Value('stage', 'blocks', 'answered', '1'),
    Value('stage', 'lost', 'samples missing in gaps', '1'),
    Value('stage', 'gaps', 'in a stream', '1'),
    Value('stage', 'streams', 'begun', '1'),
    Value('stage', 'silences', 'that ended in a ramp to rest', '1'),
    Value('stage', 'refused_malformed', 'blocks that are none', '1'),
    Value('stage', 'refused_repeat', 'blocks that came before', '1'),
    Value('stage', 'refused_late', 'blocks whose time had passed', '1'),
    Value('stage', 'refused_second', 'blocks of a second publisher', '1'),
    Value('stage', 'altered_not_finite', 'samples that are no numbers', '1'),
    Value('stage', 'altered_outside_limits', 'samples applied at the limit', '1'),
    Value('stage', 'altered_too_fast', 'samples followed at the slew', '1'),
    Value('stage', 'altered_joining', 'samples of a ramp into a stream', '1'),
    Value('stage', 'clipped', 'samples at the end of a converter', '1'),
    Value('stage', 'publishers', 'of voltage', '1'),
    Value('stage', 'applied', 'voltage applied last', 'V'),
    Value('stage', 'head_room', 'share of the sample time left', '1', 'while a stream comes'),
    Value('identifier', 'state', 'as in `~/status`'),
    Value('identifier', 'rate', 'samples of voltage captured', '1/s'),
    Value('identifier', 'captured', 'voltage that is kept', 's'),
    Value('identifier', 'topics', 'how much of each is kept'),
    Value('identifier', 'segments', 'that were met'),
    Value('identifier', 'room', 'left of `capture_limit`', 's'),
    Value('identifier', 'lost', 'samples missing, all topics', '1'),
    Value('model', 'rate', 'samples of voltage', '1/s'),
    Value('model', 'load', 'share of the time that blocks take', '%'),
    Value('model', 'lost', 'samples of voltage missing or not usable', '1'),
    Value('model', 'late', 'samples that came again or out of turn', '1'),
    Value('model', 'restarts', 'of the sample clock', '1'),
    Value('model', 'unreadable', 'messages that are no blocks', '1'),
    Value('model', 'unmatched', 'samples of displacement without a prediction', '1'),
    Value('model', 'memory_known', 'whether the plays are where they must be', '', _MODEL),
    Value('model', 'residual_rms', 'live error over `window`', 'm', _MODEL),
    Value('model', 'residual_percent', 'the same', '% of stroke', _MODEL),
    Value(
        'model', 'head_room', 'of the voltage in the identified range', 'V', 'while a stream comes'
    ),
    Value('recorder', 'messages', 'in the bag', '1'),
    Value('recorder', 'bytes', 'in the bag, on disk', '1'),
    Value('recorder', 'lost', 'messages sent and not received', '1'),
    Value('recorder', 'path', 'of the bag'),
    Value('recorder', 'rate', 'messages received', '1/s'),
    Value('player', 'messages', 'sent', '1'),
    Value('player', 'total', 'to send', '1'),
    Value('player', 'bag', 'that is replayed'),
    Value('player', 'slipped', 'by how much the schedule moved', 's'),
    Value('player', 'rate', 'messages sent', '1/s'),
)


def _row(*cells: str) -> str:
    return '| ' + ' | '.join(cells) + ' |'


def _code(names: tuple[str, ...]) -> str:
    return ', '.join(names) or '-'


def topic_table() -> str:
    """Return the topics as a Markdown table."""
    lines = [_row('topic', 'type', 'from', 'to', 'QoS', 'contents'), '|---|---|---|---|---|---|']
    for t in TOPICS:
        kind = t.type.replace('/msg/', '/')
        cells = (f'`{t.name}`', kind, _code(t.publishers), _code(t.subscribers), t.qos, t.contents)
        lines.append(_row(*cells))
    return '\n'.join(lines)


def service_table() -> str:
    """Return the services as a Markdown table."""
    lines = [_row('node', 'service', 'does'), '|---|---|---|']
    lines += [_row(s.node, f'`~/{s.name}`', s.does) for s in SERVICES]
    return '\n'.join(lines)


def state_table() -> str:
    """Return the states as a Markdown table."""
    lines = [_row('node', 'state', 'means'), '|---|---|---|']
    lines += [_row(s.node, f'`{s.name}`', s.means) for s in STATES]
    return '\n'.join(lines)


def diagnostics_table() -> str:
    """Return the values on /diagnostics as a Markdown table."""
    lines = [_row('node', 'value', 'unit', 'means', 'from when on'), '|---|---|---|---|---|']
    for v in DIAGNOSTICS:
        unit = '' if v.unit == '1' else v.unit
        lines.append(_row(v.node, f'`{v.name}`', unit, v.means, v.when))
    return '\n'.join(lines)


def parameter_table(node: str) -> str:
    """Return the parameters of a node as a Markdown table."""
    lines = [_row('parameter', 'default', 'range', 'meaning'), '|---|---|---|---|']
    for d in NODES[node]:
        value = ', '.join(d.default) if isinstance(d.default, tuple) else str(d.default)
        unit = f' {d.unit}' if d.unit not in ('', '1') else ''
        span = ' or '.join(d.choices)
        if d.low is not None and d.high is not None:
            span = f'{d.low:g} .. {d.high:g}{unit}'
        fixed = ' (at start only)' if d.read_only else ''
        lines.append(_row(f'`{d.name}`', f'{value}{unit}', span, f'{d.description}{fixed}'))
    return '\n'.join(lines)


def rewritten(text: str) -> str:
    """Return a page with every marked table made anew."""
    tables = {
        'topics': topic_table(),
        'services': service_table(),
        'states': state_table(),
        'diagnostics': diagnostics_table(),
    }
    tables.update({f'parameters {node}': parameter_table(node) for node in NODES})

    def table(match: re.Match[str]) -> str:
        return f'{match[1]}\n{tables[match[2]]}\n{match[3]}'

    return re.sub(r'(<!-- table: ([a-z ]+) -->)\n.*?(<!-- end -->)', table, text, flags=re.S)


def main() -> None:
    """Rewrite the tables of the file named on the command line."""
    page = Path(sys.argv[1])
    page.write_text(rewritten(page.read_text(encoding='utf-8')), encoding='utf-8')


if __name__ == '__main__':
    main()
