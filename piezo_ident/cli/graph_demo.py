# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The demonstration on the running graph: six processes that know each other by topics alone.

The stage is driven, captured, recorded and identified live; the model node then predicts motions
that it has not seen; the bag is replayed into a second identifier in a namespace of its own, and
read offline; and the three models are compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
from dataclasses import dataclass
import os
from pathlib import Path
import random
import shutil
import time
from typing import TYPE_CHECKING

import numpy as np
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.common.files import parse_yaml
from piezo_ident.excitation.program import Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings
from piezo_ident.model.files import model_from_dict
from piezo_ident.model.free_run import PieceRun, SineError, sines_of
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.starter import Nodes
from piezo_ident.record.gaps import bridged
from piezo_ident.record.io import read_record
from piezo_ident.record.record import Record

if TYPE_CHECKING:
    from piezo_ident.nodes.client import Client

__all__ = ['SAME', 'GraphRun', 'graph_demo', 'largest_difference', 'replayed_model']

#: largest relative difference of a parameter between models that are the same
SAME = 1e-12
#: of the sample clock, as the stage and the excitation have it [Hz]
RATE = 20_000.0
#: rate_factor of the excitation
REAL_TIME, SLOWER = 1.0, 0.25
#: how long nothing must come before a recording ends [s]
QUIET = 1.5
#: how many times faster than real time the bag is replayed
REPLAY_RATE = 2.0


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
    differences : mapping of str to float
        Largest relative difference of a parameter to the live model, by where the other came from.
    lost : mapping of str to int
        Samples that did not arrive, by where; empty when all did.
    unclean : tuple of str
        Nodes that did not end with exit code 0.
    """

    found: Identification
    record: Record
    sines: tuple[SineError, ...]
    differences: Mapping[str, float]
    lost: Mapping[str, int]
    unclean: tuple[str, ...]

    @property
    def problem(self) -> str:
        """Why the graph did not do what it should, empty when it did."""
        lost = ', '.join(f'{n} {where}' for where, n in self.lost.items())
        differ = [name for name, d in self.differences.items() if not d <= SAME]
        if differ:
            why = f'samples were lost: {lost}' if lost else 'though no sample was lost'
            return f'the {" and the ".join(differ)} model differs from the live one; {why}'
        return '; '.join(self.unclean)


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


@contextlib.contextmanager
def lab_graph(log: Path, name: str = 'piezo_ident_client') -> Iterator[tuple[Nodes, Client]]:
    """
    Open a graph whose nodes end with it, and a client of it.

    Parameters
    ----------
    log : path
        Folder for what the nodes print.
    name : str, optional
        Of the client.

    Raises
    ------
    PiezoIdentError
        When rclpy cannot be imported.
    """
    # our own corner of the network, unless the user has chosen one
    os.environ.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 101)))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        from piezo_ident.nodes.client import Client
    except ImportError as error:
        raise PiezoIdentError(f'rclpy is installed but cannot be imported: {error}') from None
    with Nodes(log) as nodes, Client(name) as client:
        yield nodes, client


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
    folder = out / 'graph'
    for old in ('identification', 'validation'):
        for name in (old, f'{old}_again'):
            shutil.rmtree(folder / name, ignore_errors=True)
    with lab_graph(folder / 'log') as (nodes, client):
        return _session(nodes, client, folder, console)


def _session(nodes: Nodes, client: Client, folder: Path, console: Console) -> GraphRun:
    for node in ('stage', 'excitation', 'identifier', 'model', 'recorder'):
        client.follow(node)
    client.count('identifier')
    # a busy machine may be silent for a while
    nodes.start('stage', parameters={'silence': 2.0})
    nodes.start('identifier', parameters={'output': str(folder / 'live')})
    nodes.start('model')
    nodes.start('recorder')
    nodes.start('excitation', parameters={'subscribers': 4, 'wait_limit': 30.0})
    live, bag, lost = _identify(nodes, client, folder, console)
    console.say('   identified on the running graph; recorded to a bag')
    for name, factor in (('validation', REAL_TIME), ('validation_again', SLOWER)):
        _set(client, 'excitation', 'rate_factor', factor)
        sines, missed = _validate(nodes, client, folder / name, live, console)
        if not missed:
            break
        if factor == REAL_TIME:
            _once_more(f'{missed} samples of the live prediction were lost', console)
    _ask(client, 'identifier/save')

    nodes.start('identifier', namespace='replay')
    replayed, again = replayed_model(nodes, client, bag, console)
    client.wait(
        lambda: client.status('identifier').get('state') == 'done', 60.0, 'the report', nodes.check
    )
    codes = nodes.stop()

    record = read_record(bag)
    with console.progress() as progress:
        found = identify(record, Settings(thresholds=10), progress=progress)
    lost |= {'in the replay': record.n - again, 'of the live prediction': missed}
    return GraphRun(
        found,
        record,
        sines,
        {
            'replayed': largest_difference(live, replayed),
            'offline': largest_difference(live, found.model),
        },
        {where: n for where, n in lost.items() if n},
        tuple(f'{name}: exit code {code}' for name, code in codes.items() if code != 0),
    )


def _once_more(why: str, console: Console) -> None:
    """Say what came of real time."""
    console.say(f'   in real time: {why}')
    console.say('   this machine is too busy for it; once more, at a quarter of the rate')


def _identify(
    nodes: Nodes, client: Client, folder: Path, console: Console
) -> tuple[StageModel, Path, dict[str, int]]:
    """Have the identifier drive the stage; return its model, the bag, and what was lost."""
    models = client.listen('model')
    sent = Program.load('identification').build(RATE).n
    for name, factor in (('identification', REAL_TIME), ('identification_again', SLOWER)):
        bag, before = folder / name, client.count('identifier')
        models.clear()
        _set(client, 'excitation', 'rate_factor', factor)
        _set(client, 'recorder', 'output', str(bag))
        _record(nodes, client)
        _ask(client, 'identifier/run')
        failure = None
        try:
            _follow(nodes, client, console, 'identifier', 'identification', 120.0)
        except PiezoIdentError as error:
            nodes.check()
            failure = error
        _close_bag(nodes, client, bag)
        lost = {
            'on the way to the identifier': sent - client.count('identifier') + before,
            'on the way to the bag': sent - read_record(bag).n,
        }
        missing = [f'{n} samples were lost {where}' for where, n in lost.items() if n]
        if failure is not None and (factor != REAL_TIME or not missing):
            raise failure
        if not missing:
            break
        if factor == REAL_TIME:
            _once_more('; '.join([str(failure or 'identified'), *missing]), console)
    client.wait(lambda: bool(models), 10.0, 'the model on its topic', nodes.check)
    return _model(models[-1], 'the live model'), bag, lost


def _validate(
    nodes: Nodes, client: Client, bag: Path, model: StageModel, console: Console
) -> tuple[tuple[SineError, ...], int]:
    """Play what was not fitted; return the errors of the live prediction, and samples lost."""
    _set(client, 'recorder', 'output', str(bag))
    _set(client, 'excitation', 'program', 'validation')
    _record(nodes, client)
    _ask(client, 'excitation/start')
    _follow(nodes, client, console, 'excitation', 'validation', 120.0)
    _close_bag(nodes, client, bag)
    return _live_errors(bag, model)


def replayed_model(
    nodes: Nodes, client: Client, bag: Path, console: Console, rate: float = REPLAY_RATE
) -> tuple[StageModel, int]:
    """
    Replay a bag into ``replay/identifier``, which is running, and have it identify.

    Parameters
    ----------
    nodes, client
        The running graph.
    bag : path
    console : Console
    rate : float, optional
        How many times faster than real time, at most.

    Returns
    -------
    StageModel
    int
        How many samples the identifier captured.

    Raises
    ------
    PiezoIdentError
        When a node ends, refuses, or does not answer in time.
    """
    for node in ('replay/identifier', 'replay/player'):
        client.follow(node)
    client.count('replay/identifier')
    models = client.listen('replay/model')
    parameters = {'bag': str(bag), 'rate': rate, 'wait_limit': 30.0}
    nodes.start('player', namespace='replay', parameters=parameters)
    _ask(client, 'replay/player/start')
    _follow(nodes, client, console, 'replay/player', 'replay', 120.0)
    _ask(client, 'replay/identifier/identify')
    _follow(nodes, client, console, 'replay/identifier', 'identification', 120.0)
    client.wait(lambda: bool(models), 10.0, 'the model from the replay', nodes.check)
    return _model(models[-1], 'the replayed model'), client.count('replay/identifier')


def _record(nodes: Nodes, client: Client) -> None:
    """Begin a recording, and wait until it has met everybody who is there."""
    _ask(client, 'recorder/start')
    client.wait(
        lambda: client.status('recorder').get('state') == 'recording',
        20.0,
        'the recorder meeting all publishers',
        nodes.check,
    )


def _close_bag(nodes: Nodes, client: Client, bag: Path) -> None:
    """End a recording when nothing comes any more: the last predictions may be under way."""
    count, since = '', time.monotonic()

    def is_quiet() -> bool:
        nonlocal count, since
        now = client.status('recorder').get('messages', '')
        if now != count:
            count, since = now, time.monotonic()
        return time.monotonic() - since > QUIET

    client.wait(is_quiet, 30.0, 'the end of what is recorded', nodes.check)
    _ask(client, 'recorder/stop')
    client.wait((bag / 'metadata.yaml').exists, 20.0, 'the bag', nodes.check)


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
    run = PieceRun(bag.name, piece, y_hat, y_static)
    return sines_of([run]), int(piece.n - both.sum())


def _ask(client: Client, service: str) -> None:
    # an old status must not be taken for what comes of this
    client.forget(service.rpartition('/')[0])
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
            if status.get('state') in ('failed', 'refused', 'stopped', 'cancelled'):
                raise PiezoIdentError(f'{node}: {status.get("message")}')
            progress(what, float(status.get('progress', 0.0)) / 100.0)

        client.wait(lambda: client.status(node).get('state') == 'done', timeout, what, look)
