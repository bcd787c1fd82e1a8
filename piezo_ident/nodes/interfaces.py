# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The topics and services of the graph as tables, and the tables as text for the documentation.

    python -m piezo_ident.nodes.interfaces docs/graph.md

rewrites what stands between the markers in a file; a test compares it with the declarations.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import re
import sys

from piezo_ident.nodes.parameters import NODES

__all__ = ['SERVICES', 'TOPICS', 'Service', 'Topic', 'parameter_table', 'rewritten']

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
    Topic('prediction', ARRAY, ('model',), (), _STREAM, 'blocks of (t, m)'),
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
        'the last identification as JSON',
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
    Service('identifier', 'cancel', 'stops the work'),
    Service('identifier', 'clear', 'forgets what was captured'),
    Service('identifier', 'save', 'writes model, report and pictures'),
    Service('recorder', 'start', 'opens a bag and records'),
    Service('recorder', 'stop', 'closes the bag'),
    Service('player', 'start', 'replays the bag from its beginning'),
    Service('player', 'stop', 'stops the replay'),
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
    tables = {'topics': topic_table(), 'services': service_table()}
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
