# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage, an identifier and a model on a graph whose excitation is the test."""

from collections.abc import Callable, Iterator
import contextlib
import re
import signal
import time

from course import block, column, FS, QUICK
from graph import Graph
import numpy as np
from piezo_ident.record.blocks import Samples
import pytest

#: blocks under way at once; more of this size do not fit into the middleware's shared memory
AHEAD = 10
#: a silence that no test reaches [s]
PATIENT = 600.0


def captured(g: Graph, name: str = 'identifier') -> dict[str, float]:
    """Return the seconds of each topic that an identifier says it has."""
    # at the end of a work, the status is about that
    idle = g.status(name)['state'] == 'idle'
    text = g.status(name)['text'] if idle else g.diagnostics(name).get('topics', '')
    found = re.findall(r'([0-9.]+) s of (\w+)', text)
    return {key: float(seconds) for seconds, key in found}


def warned(g: Graph, node: str, said: str, since: int) -> None:
    """Wait for a warning in the status of a node."""
    g.wait(
        lambda: any(said in s['text'] and s['level'] != '0' for s in g.statuses(node)[since:]),
        f'{node} to say {said!r}',
    )


class Rig:
    """Stage, identifier and model; the test plays the excitation."""

    def __init__(self, g: Graph) -> None:
        self.g = g
        self.answers = g.collect('displacement')
        self.applied = g.collect('applied_voltage')
        self.prediction = g.collect('prediction')
        self.models, self.reports = g.texts('model'), g.texts('report')
        # also where it is started once more
        stage = {'seed': 3, 'silence': PATIENT}
        g.start_all(('stage', stage), ('identifier', QUICK), ('model',))
        self.rest(clear=False)
        self.meet()

    def meet(self, tick: int = 0, volts: float = 0.0) -> int:
        """Keep a voltage until everybody hears everybody; return the tick from which to go on."""
        before, since = captured(self.g), len(self.g.diagnoses('model'))

        def met() -> bool:
            now = captured(self.g)
            return len([k for k in now if now[k] > before.get(k, 0.0)]) == 3 and any(
                float(d['rate']) > 0.0 for d in self.g.diagnoses('model')[since + 1 :]
            )

        self.g.wait(met, 'everybody to hear everybody', meanwhile=self.holding(tick, volts))
        return self.answered()

    def holding(self, tick: int, volts: float) -> Callable[[], None]:
        """Return a function that sends the next block of a constant voltage."""
        ticks, due = iter(range(tick, 10**9, 200)), 0.0

        def more() -> None:
            nonlocal due
            # what a dead node does not take keeps its place in the middleware's memory
            if time.monotonic() < due:
                return
            due = time.monotonic() + 0.03
            self.sent.append(block(next(ticks), np.full(200, volts), 'hold:wait'))
            self.g.publish('voltage', self.sent[-1])

        return more

    def answered(self) -> int:
        """Wait for the answer to the last block, and return the next tick."""
        last = self.sent[-1].t[-1]
        self.g.wait(
            lambda: self.answers and self.answers[-1].t[-1] == last == self.applied[-1].t[-1],
            'the last answer',
        )
        return round(last * FS) + 1

    def rest(self, *, clear: bool = True) -> None:
        """Let the stage go to rest, and the identifier forget."""
        g = self.g
        assert g.set('stage', 'silence', 0.05)[0]
        g.wait(lambda: g.status('stage')['state'] == 'idle', 'the stage at rest')
        # the end of the ramp belongs to what was before
        g.wait(lambda: not self.applied or abs(self.applied[-1].values[-1]) < 1e-9, '0 V')
        # from here on a test may take its time
        assert g.set('stage', 'silence', PATIENT)[0]
        if clear:
            assert g.call('identifier/clear')[0]
        self.sent = []
        self.begin = {key: len(self.heard(key)) for key in ('displacement', 'applied_voltage')}
        self.lacking = dict.fromkeys(('voltage', *self.begin), 0.0)
        self.since = {node: len(g.statuses(node)) for node in ('stage', 'identifier', 'model')}

    def heard(self, key: str) -> list[Samples]:
        return {'displacement': self.answers, 'applied_voltage': self.applied}[key]

    def send(self, blocks: list[Samples], refused: int = 0) -> None:
        """Send blocks no faster than they are answered; all but the refused ones are."""
        before = len(self.answers)
        for k, b in enumerate(blocks):
            self.g.publish('voltage', b)
            self.sent.append(b)
            self.g.wait(lambda k=k: len(self.answers) > before + k - AHEAD, 'answers')
        count = before + len(blocks) - refused
        self.g.wait(lambda: len(self.answers) >= count, f'{len(blocks) - refused} answers')
        # what was applied comes after the answer
        last = self.answers[-1].t[-1]
        self.g.wait(lambda: self.applied[-1].t[-1] == last, 'what was applied last')

    @contextlib.contextmanager
    def unanswered(self, blocks: list[Samples]) -> Iterator[None]:
        """Have the identifier hear blocks that a stage that stands still answers afterwards."""
        stage, count = self.g.handle('stage'), len(self.answers) + len(blocks)
        # a message that was lost on its way cannot come again from one who stands still
        self.settle()
        stage.send(signal.SIGSTOP)
        try:
            for b in blocks:
                self.g.publish('voltage', b)
                self.sent.append(b)
            self.settle()
            yield
        finally:
            stage.send(signal.SIGCONT)
        self.g.wait(lambda: len(self.answers) >= count, 'what waited for the stage')

    def to_capture(self) -> dict[str, float]:
        """Return the seconds of each topic that the observer has seen."""
        new = {key: self.heard(key)[begin:] for key, begin in self.begin.items()}
        new['voltage'] = self.sent
        return {key: sum(b.t.size for b in new[key]) / FS - self.lacking[key] for key in new}

    def forgive(self) -> None:
        """Let the identifier lack what came before it had met the node that sent it."""
        told = self.g.diagnoses('identifier')
        since = len(told) + 1
        self.g.wait(
            lambda: len(told) > since and told[-1]['topics'] == told[-2]['topics'],
            'what is under way to have come',
        )
        have = captured(self.g)
        self.lacking = {key: wanted - have[key] for key, wanted in self.to_capture().items()}

    def settle(self) -> None:
        """Wait until the identifier has all that was sent and answered."""
        # what is under way to the observer may be with the identifier already
        self.g.wait(
            lambda: captured(self.g) == pytest.approx(self.to_capture(), abs=6e-4),
            f'{self.to_capture()} captured',
        )

    def warned(self, node: str, said: str) -> None:
        warned(self.g, node, said, self.since[node])

    def is_safe(self) -> None:
        """See that what was applied kept to limits and slew."""
        t, v = column(self.applied[self.begin['applied_voltage'] :])
        assert v.min() >= 0.0 and v.max() <= 10.0
        steps = np.abs(np.diff(v))[np.rint(np.diff(t) * FS) == 1]
        assert steps.max() * FS <= 40_000.0 * (1 + 1e-9)
