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
The demonstration on the running graph: six processes that know each other by topics alone.

The stage is driven, captured, recorded and identified live; the model node then predicts motions
that it has not seen; the bag is replayed into a second identifier in a namespace of its own, and
read offline; and the three models are compared.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import random
import shutil
from typing import TYPE_CHECKING

import numpy as np
from piezo_ident.bridging import bridged
from piezo_ident.cli.console import Console
from piezo_ident.errors import PiezoIdentError
from piezo_ident.identification import identify
from piezo_ident.model import StageModel
from piezo_ident.model_io import model_from_dict, parse_yaml
from piezo_ident.nodes.starter import Nodes
from piezo_ident.record import Record
from piezo_ident.record_io import read_record
from piezo_ident.results import Identification, Settings
from piezo_ident.validation import FreeRun, SineError, sines_of

if TYPE_CHECKING:
    from piezo_ident.nodes.client import Client

__all__ = ['GraphRun', 'graph_demo', 'largest_difference']


@dataclass(frozen=True, eq=False)
class GraphRun:
    """
    What the graph left behind.

    Attributes
    ----------
    found : Identification
        From the bag, read offline.
    record : Record
        The bag.
    sines : tuple of SineError
        Errors of the live prediction.
    difference : float
        Largest relative difference of a parameter between live, replayed and offline model.
    lost : int
        Samples of the live prediction that did not arrive.
    unclean : tuple of str
        Nodes that did not end with exit code 0.
    """

    found: Identification
    record: Record
    sines: tuple[SineError, ...]
    difference: float
    lost: int
    unclean: tuple[str, ...]


def largest_difference(one: StageModel, other: StageModel) -> float:
    """Return the largest relative difference between the parameters of two models."""

    def numbers(m: StageModel) -> np.ndarray:
        h, g, s = m.hysteresis, m.dynamics, m.scaling
        single = [h.p1, h.p2, s.v0, s.V, s.y0, s.Y, m.delay.total, m.sample_rate]
        return np.concatenate([h.thresholds, h.weights, g.a, g.b, single])

    a, b = numbers(one), numbers(other)
    if a.shape != b.shape:
        return float('inf')
    scale = np.maximum(np.maximum(np.abs(a), np.abs(b)), np.finfo(float).tiny)
    return float(np.max(np.abs(a - b) / scale))


def graph_demo(out: Path, console: Console) -> GraphRun:
    """
    Run the graph.

    Parameters
    ----------
    out : path
        Folder for bags, logs and the report.
    console : Console

    Raises
    ------
    PiezoIdentError
        When a node ends, refuses, or does not answer in time.
    """
    # our own corner of the network, unless the user has chosen one
    os.environ.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 101)))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    from piezo_ident.nodes.client import Client

    folder = out / 'graph'
    for old in ('identification', 'validation'):
        shutil.rmtree(folder / old, ignore_errors=True)
    with Nodes(folder / 'log') as nodes, Client() as client:
        return _session(nodes, client, folder, console)


def _session(nodes: Nodes, client: Client, folder: Path, console: Console) -> GraphRun:
    for node in ('stage', 'excitation', 'identifier', 'model', 'recorder'):
        client.follow(node)
    nodes.start('stage')
    # early, so that it has met everybody when its turn comes
    nodes.start('identifier', namespace='replay')
    nodes.start('identifier', parameters={'output': str(folder / 'live')})
    nodes.start('model')
    nodes.start('recorder', parameters={'output': str(folder / 'identification')})
    nodes.start('excitation', parameters={'subscribers': 4})
    models = client.listen('model')
    _ask(client, 'recorder/start')
    _ask(client, 'identifier/run')
    _follow(nodes, client, console, 'identifier', 'identification', 120.0)
    client.wait(lambda: bool(models), 10.0, 'the model on its topic', nodes.check)
    live = _model(models[-1], 'the live model')
    _ask(client, 'recorder/stop')
    client.wait(
        lambda: (folder / 'identification' / 'metadata.yaml').exists(),
        10.0,
        'the bag',
        nodes.check,
    )
    console.say('   identified on the running graph; recorded to a bag')

    _set(client, 'recorder', 'output', str(folder / 'validation'))
    _set(client, 'excitation', 'program', 'validation')
    _ask(client, 'recorder/start')
    _ask(client, 'excitation/start')
    _follow(nodes, client, console, 'excitation', 'validation', 60.0)
    _ask(client, 'recorder/stop')
    client.wait(
        lambda: (folder / 'validation' / 'metadata.yaml').exists(), 10.0, 'the bag', nodes.check
    )
    _ask(client, 'identifier/save')

    for node in ('replay/identifier', 'replay/player'):
        client.follow(node)
    again = client.listen('replay/model')
    nodes.start(
        'player',
        namespace='replay',
        parameters={'bag': str(folder / 'identification'), 'rate': 2.0},
    )
    _ask(client, 'replay/player/start')
    _follow(nodes, client, console, 'replay/player', 'replay', 60.0)
    _ask(client, 'replay/identifier/identify')
    _follow(nodes, client, console, 'replay/identifier', 'replayed', 60.0)
    client.wait(lambda: bool(again), 10.0, 'the model from the replay', nodes.check)
    replayed = _model(again[-1], 'the replayed model')
    codes = nodes.stop()

    record = read_record(folder / 'identification')
    with console.progress() as progress:
        found = identify(record, Settings(), progress=progress)
    difference = max(largest_difference(live, m) for m in (replayed, found.model))
    sines, lost = _live_errors(folder / 'validation', live)
    unclean = tuple(f'{name}: exit code {code}' for name, code in codes.items() if code != 0)
    return GraphRun(found, record, sines, difference, lost, unclean)


def _live_errors(bag: Path, model: StageModel) -> tuple[tuple[SineError, ...], int]:
    """Return the errors of what the model node predicted live, and how many samples were lost."""
    measured, predicted = read_record(bag), read_record(bag, displacement_topic='/prediction')
    part = max(bridged(measured), key=lambda p: p.piece.n)
    piece = part.piece
    ticks = np.round((np.concatenate([p.t for p in predicted]) - piece.start_time) / piece.dt)
    y_hat = np.full(piece.n, np.nan)
    inside = (ticks >= 0) & (ticks < piece.n)
    y_hat[ticks[inside].astype(np.int64)] = np.concatenate([p.y for p in predicted])[inside]
    both = part.sound & np.isfinite(y_hat)
    # what was lost on the way is left out of the comparison, on both sides alike
    y_hat = np.where(both, y_hat, piece.y)
    y_static = np.where(both, model.without_dynamics().predict_piece(piece), piece.y)
    run = FreeRun(bag.name, piece, y_hat, y_static)
    return sines_of([run]), int(piece.n - both.sum())


def _ask(client: Client, service: str) -> None:
    done, answer = client.call(service, timeout=20.0)
    if not done:
        raise PiezoIdentError(f'{service} was refused: {answer}')


def _set(client: Client, node: str, name: str, value: object) -> None:
    done, reason = client.set(node, name, value, timeout=20.0)
    if not done:
        raise PiezoIdentError(f'{node}: {name} was refused: {reason}')


def _model(text: str, name: str) -> StageModel:
    return model_from_dict(parse_yaml(text, name), name)


def _follow(
    nodes: Nodes, client: Client, console: Console, node: str, what: str, timeout: float
) -> None:
    """Show the progress of a node until it is done."""
    with console.progress() as progress:

        def look() -> None:
            nodes.check()
            status = client.status(node)
            if status.get('state') == 'failed':
                raise PiezoIdentError(f'{node}: {status.get("message")}')
            progress(what, float(status.get('progress', 0.0)) / 100.0)

        client.wait(lambda: client.status(node).get('state') == 'done', timeout, what, look)
