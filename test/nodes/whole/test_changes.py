# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What changed of a running stage, as the model node names it: one graph, one change a stream."""

from dataclasses import replace

from course import FS, model_of, paper
from graph import Graph
import numpy as np
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.blocks import Samples
import pytest

CREEP = {'gain': [0.02] * 3, 'time_constant': [0.1, 1.0, 10.0]}
TEXT = paper(
    effects=[{'name': 'creep', 'parameters': CREEP}],
    identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}},
)
MODEL = model_of(TEXT)
H, G = MODEL.hysteresis, MODEL.dynamics
#: samples of a block, and before the stage changes
SIZE, AT = 1000, 20_000
#: blocks of each topic under way at once: less than the half second after which the estimate goes
#: on without displacement, and no more than the middleware keeps for a node that gets no time
AHEAD = 5


def with_modes(factor):
    """Return the dynamics with the frequencies of its modes multiplied."""
    a = np.real(np.poly(G.poles**factor))
    return Dynamics(a[1:], G.b * a.sum() / (1.0 + G.a.sum()))


def sine(n, first=0):
    t = np.arange(first, first + n) / FS
    return t, 5.0 - 5.0 * np.cos(2.0 * np.pi * 5.0 * t)


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.start('model', {'window': 0.2})
        for topic in ('prediction', 'residual'):
            g.matched(topic)
        g.publish_text('model', TEXT)
        g.wait(lambda: g.status('model').get('models') == '1', 'the model')
        yield g


class Stage:
    """A stage that has another model, another zero and a gain that drifts from a sample on."""

    def __init__(self, model=MODEL, zero=0.0, drift=0.0, before=()):
        sensor = Sensor(noise_rms=2e-9)
        runs = [
            SimulatedStage(m, sensor).run(np.random.default_rng(k))
            for k, m in enumerate((MODEL, model))
        ]
        for run in runs:
            run.process(np.zeros(1))
            if len(before):
                run.process(before)
        self._runs, self._zero, self._drift, self._count = runs, zero, drift, 0

    def process(self, v):
        old, new = (run.process(v) for run in self._runs)
        since = self._count + np.arange(v.size) - AT
        self._count += v.size
        return np.where(since >= 0, new * (1.0 + self._drift * since / FS) + self._zero, old)


def at_the_top():
    """Return the voltage of a stage that was at the top for a second, and came down."""
    up = np.linspace(0.0, 10.0, 2000)
    return np.concatenate([up, np.full(20_000, 10.0), up[::-1]])


def says(g, stage, segment, wanted):
    """Drive a stage until the node says all that is wanted in one sentence; return it."""
    since, sent, prediction = len(g.diagnoses('model')), 0, g.collect('prediction')

    def answered():
        return sum(b.segment == segment for b in prediction)

    def told():
        messages = [d['message'] for d in g.diagnoses('model')[since:]]
        return [m for m in messages if all(part in m for part in wanted)]

    def drive():
        nonlocal sent
        if sent - answered() < AHEAD:
            t, v = sine(SIZE, SIZE * sent)
            g.publish('voltage', Samples(t, v, segment))
            g.publish('displacement', Samples(t, stage.process(v), segment, 'displacement'))
            sent += 1

    g.wait(told, f'{wanted}', meanwhile=drive)
    return told()[0]


CHANGES = {
    'creep': (Stage(before=at_the_top()), ('creep from earlier motion +',)),
    'offset': (Stage(zero=1e-6), ('corrected: offset +1 um',)),
    'gain': (
        Stage(replace(MODEL, hysteresis=H.scaled(1.03))),
        ('identify again', 'what changed: gain +3.0 +- 0.1 %'),
    ),
    'dynamics': (
        Stage(replace(MODEL, dynamics=with_modes(1.3))),
        ('identify again', 'what changed: faster dynamics'),
    ),
    'hysteresis': (
        Stage(replace(MODEL, hysteresis=replace(H, weights=1.1 * H.weights))),
        ('identify again', 'what changed: hysteresis: loop width +10.0'),
    ),
}


@pytest.mark.parametrize('change', CHANGES)
def test_the_sentence_names_what_changed_of_a_running_stage(lab, change):
    stage, wanted = CHANGES[change]
    said = says(lab, stage, change, wanted)
    others = {'gain', 'dynamics', 'hysteresis'} - {change}
    assert not any(name in said.partition('what changed')[2] for name in others), said


def test_a_drift_of_the_gain_is_followed_on_request_and_named(lab):
    assert lab.set('model', 'observe_drift', True) == (True, '')
    # three standard deviations of the drift make it named
    said = says(lab, Stage(drift=1e-2), 'drift', ('corrected: ', 'drift of the gain +'))
    size = float(said.partition('drift of the gain')[2].split()[0])
    assert 'identify again' not in said and size == pytest.approx(1.0, abs=0.4)
    assert lab.set('model', 'observe_drift', False) == (True, '')
