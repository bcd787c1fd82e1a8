# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The demonstration of a diagnosis: a stage with effects that nobody declared, on the running graph.

The identifier is told to identify and to diagnose, no more.  The same motions are played before
and after, and the residual on its topic is compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from piezo_ident.cli.console import Console
from piezo_ident.cli.graph_demo import _ask, _follow, _set, lab_graph
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.diagnosis import diagnose
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification.identify import identify
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.starter import Nodes
from piezo_ident.record.record import Record

if TYPE_CHECKING:
    from piezo_ident.nodes.client import Client

__all__ = ['DiagnosisRun', 'diagnosis_demo', 'offline_diagnosis_demo']

#: played before and after, and what the model is first judged by: slow, fast, large and small
PROBE = """
limits: [0, 10]
slew: 80
segments:
  - {signal: idle, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 1, periods: 2}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 10, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 50, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 120, duration: 0.3}
  - {signal: sine, name: 120Hz-small, bias: 5, amplitude: 2, frequency: 120, duration: 0.3}
  - {signal: idle, duration: 0.3}
"""
#: the shipped holds, shortened
HOLDS = """
limits: [0, 10]
slew: 200
segments:
  - {signal: idle, duration: 0.5}
  - {signal: hold, level: 5, duration: 1}
  - {signal: hold, level: 10, duration: 2.2}
  - {signal: idle, duration: 1.5}
"""
STAGE = 'stage_effects'
#: longest that a diagnosis may take [s]
LONGEST = 600.0


@dataclass(frozen=True)
class DiagnosisRun:
    """
    What came of it.

    Attributes
    ----------
    verdict, sentence : str
    effects : tuple of str
        That were added.
    asked : tuple of str
        What the identifier asked the excitation for, and why.
    before, after : float
        Rms of the residual of the same motions [m].
    stroke : float
        [m]
    unclean : tuple of str
        Nodes that did not end with exit code 0.
    """

    verdict: str
    sentence: str
    effects: tuple[str, ...]
    asked: tuple[str, ...]
    before: float
    after: float
    stroke: float
    unclean: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return what to print."""
        percent = [100.0 * x / self.stroke for x in (self.before, self.after)]
        return [
            *self.asked,
            f'verdict: {self.verdict} ({", ".join(self.effects) or "nothing was added"})',
            self.sentence,
            f'residual of the same motions, rms: before {1e9 * self.before:.0f} nm '
            f'({percent[0]:.3f} % of stroke), after {1e9 * self.after:.0f} nm '
            f'({percent[1]:.3f} %)',
            *self.unclean,
        ]


@dataclass
class _Ear:
    """Adds up what passes on two topics."""

    squares: float = 0.0
    n: int = 0
    low: float = field(default=float('inf'))
    high: float = field(default=float('-inf'))
    last: float = 0.0

    def residual(self, message: Any) -> None:
        rows = np.array(message.data).reshape(-1, 2)
        self.squares += float(np.sum(rows[:, 1] ** 2))
        self.n, self.last = self.n + len(rows), float(rows[-1, 0])

    def displacement(self, message: Any) -> None:
        y = np.array(message.data)[1::2]
        self.low, self.high = min(self.low, float(y.min())), max(self.high, float(y.max()))

    def clear(self) -> None:
        self.squares, self.n, self.last = 0.0, 0, 0.0

    @property
    def rms(self) -> float:
        return float(np.sqrt(self.squares / max(self.n, 1)))


def diagnosis_demo(out: Path, console: Console) -> DiagnosisRun:
    """
    Run the graph.

    Parameters
    ----------
    out : path
        Folder for logs and the reports.
    console : Console

    Raises
    ------
    PiezoIdentError
        When a node ends, refuses, or does not answer in time.
    """
    with lab_graph(out / 'log', 'piezo_ident_diagnosis_demo') as (nodes, client):
        return _session(nodes, client, out, console)


def _session(nodes: Nodes, client: Client, out: Path, console: Console) -> DiagnosisRun:
    from piezo_ident.nodes.wire import STREAM
    from std_msgs.msg import Float64MultiArray

    for node in ('excitation', 'identifier', 'model'):
        client.follow(node)
    reports, ear = client.listen('report'), _Ear()
    for topic, hear in (('residual', ear.residual), ('displacement', ear.displacement)):
        client.node.create_subscription(Float64MultiArray, topic, hear, STREAM)
    nodes.start('stage', parameters={'stage': STAGE, 'silence': 2.0})
    nodes.start(
        'identifier', parameters={'output': str(out), 'holds_program': HOLDS, 'requests': 1}
    )
    nodes.start('model')
    nodes.start('excitation', parameters={'subscribers': 3, 'wait_limit': 30.0})
    _ask(client, 'identifier/run')
    _follow(nodes, client, console, 'identifier', 'identification', 120.0)
    _wait_for_model(nodes, client, 1)
    before = _probe(nodes, client, console, ear)
    _ask(client, 'identifier/diagnose')
    asked = _follow_diagnosis(nodes, client, console)
    client.wait(lambda: 'verdict' in reports[-1], 10.0, 'the report', nodes.check)
    report = json.loads(reports[-1])
    if report['effects']:
        _wait_for_model(nodes, client, 2)
    after = _probe(nodes, client, console, ear)
    _ask(client, 'identifier/save')
    _follow(nodes, client, console, 'identifier', 'reports', 120.0)
    codes = nodes.stop()
    return DiagnosisRun(
        verdict=report['verdict'],
        sentence=report['sentence'],
        effects=tuple(effect['name'] for effect in report['effects']),
        asked=asked,
        before=before,
        after=after,
        stroke=ear.high - ear.low,
        unclean=tuple(f'{name}: exit code {code}' for name, code in codes.items() if code != 0),
    )


def _wait_for_model(nodes: Nodes, client: Client, number: int) -> None:
    client.wait(
        lambda: int(client.status('model').get('models', 0)) >= number,
        20.0,
        'the model node taking the model over',
        nodes.check,
    )


def _probe(nodes: Nodes, client: Client, console: Console, ear: _Ear) -> float:
    """Return the rms of the residual while the probe is played [m]."""
    end = parse_program(PROBE).build(SimulatedStage.load(STAGE).model.sample_rate)
    _set(client, 'excitation', 'program', PROBE)
    ear.clear()
    _ask(client, 'excitation/start')
    _follow(nodes, client, console, 'excitation', 'probe', 120.0)
    client.wait(
        lambda: ear.last > end.duration - 2.0 / end.sample_rate, 20.0, 'the residual', nodes.check
    )
    return ear.rms


def _follow_diagnosis(nodes: Nodes, client: Client, console: Console) -> tuple[str, ...]:
    """Show how the diagnosis goes, and return what was asked for."""
    asked: dict[str, None] = {}
    with console.progress() as progress:

        def look() -> None:
            nodes.check()
            status = client.status('identifier')
            message = status.get('message', '')
            if status.get('state') in ('failed', 'cancelled'):
                raise PiezoIdentError(f'identifier: {message}')
            if message.startswith('asking for'):
                # how much was captured follows
                asked[': '.join(message.split(': ')[:2])] = None
            progress('diagnosis', float(status.get('progress', 0.0)) / 100.0)

        def ended() -> bool:
            return client.status('identifier').get('state') == 'done'

        client.wait(ended, LONGEST, 'diagnosis', look)
    return tuple(asked)


def offline_diagnosis_demo(console: Console) -> DiagnosisRun:
    """
    Do the same without nodes: nobody asks, so all is played beforehand.

    Parameters
    ----------
    console : Console
    """
    stage = SimulatedStage.load(STAGE)
    rate = stage.model.sample_rate

    def play(text: str, seed: int) -> Record:
        sequence = parse_program(text).build(rate)
        return stage.play(sequence, np.random.default_rng([stage.seed, seed]))

    program = Program.load('identification').build(rate)
    record = stage.play(program, np.random.default_rng([stage.seed, 6]))
    probe, holds, again = (play(text, 7 + i) for i, text in enumerate((PROBE, HOLDS, PROBE)))
    with console.progress() as progress:
        model = identify(record, progress=progress).model
    with console.progress() as progress:
        found = diagnose(model, [probe, holds], progress=progress)
    before, after = (
        free_run(m, again).errors.percent * again.stroke / 100.0 for m in (model, found.model)
    )
    return DiagnosisRun(
        verdict=found.verdict,
        sentence=found.sentence,
        effects=tuple(effect.name for effect in found.effects),
        asked=(),
        before=before,
        after=after,
        stroke=again.stroke,
    )
