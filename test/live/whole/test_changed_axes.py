# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes that changed: one creeps from earlier motion, one moves 3 % more."""

from dataclasses import replace
import functools

from axes_scanner import answer, AXES, creeping, ERRORS, grown, path, RATE, scanner
from live_axes import chains, noise, tracked
import numpy as np
from numpy.testing import assert_allclose
import piezo_ident as pi
from piezo_ident.live.comparison import AxisComparison
from piezo_ident.live.corrector import Corrector
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.estimate import observe
from piezo_ident.model.multi_axis import alone, with_own
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
import pytest

N = 12_000
T = np.arange(N) / RATE


def scan(frequencies=(5.0, 0.7)):
    """Return voltages of both axes, from 0 V, a row each."""
    return np.stack([5.0 - 5.0 * np.cos(2 * np.pi * f * T) for f in frequencies])


class Live:
    """What the model node does with the streams of both axes."""

    def __init__(self, model, **options):
        self.predictor = Predictor(AXES)
        self.predictor.set_model(model)
        self.got = {(axis, what): [] for axis in AXES for what in ('estimate', 'residual')}
        self.each = [self._axis(axis, options) for axis in AXES]
        for k, one in enumerate(self.each):
            recalled = functools.partial(self.predictor.caught_up, axis=k)
            one.set_model(alone(model)[AXES[k]], recalled)

    def _axis(self, axis, options):
        def publish(what, samples):
            self.got[axis, what].append(samples)

        return AxisComparison(
            2.0, Corrector(**options), publish, lambda told: None, lambda: True, print
        )

    def play(self, v, y, size=50, late=3):
        """Play both streams, the displacement some blocks late; return the estimates."""
        blocks = [slice(k, k + size) for k in range(0, N, size)]
        for k in range(len(blocks) + late):
            acts = [(self._drove, k, v), (self._moved, k - late, y)]
            for act, at, rows in acts if late else acts[::-1]:
                if 0 <= at < len(blocks):
                    act(blocks[at], rows)
        return np.stack([self._whole(axis, 'estimate') for axis in AXES])

    def _drove(self, cut, v):
        known = self.predictor.memory_known
        prediction = self.predictor.process(Samples(T[cut], v[:, cut]))
        for i, one in enumerate(self.each):
            y_hat = replace(prediction, values=prediction.values[i])
            voltage = Samples(T[cut], v[i, cut])
            one.predicted(y_hat, voltage, known, self.predictor.felt[i])

    def _moved(self, cut, y):
        for i, one in enumerate(self.each):
            one.measured(Samples(T[cut], y[i, cut], '', 'displacement'))

    def _whole(self, axis, what):
        return np.concatenate([x.values for x in self.got[axis, what]])

    @property
    def told(self):
        return [one.corrector.told for one in self.each]


def noisy(y):
    return y + noise(y.shape)


def percents(error, model, first=N // 2):
    """Return the rms error of each axis over the second half [% of span]."""
    spans = np.array([abs(model.axes[a].scaling.Y) for a in AXES])
    return 100.0 * np.sqrt(np.mean(error[:, first:] ** 2, axis=1)) / spans


def test_each_axis_is_corrected_by_what_changed_of_it():
    model, v = creeping(), scan()
    truth = answer(grown(model, 'y_b'), v, earlier=10.0)
    live = Live(model, gain=True)
    estimate = live.play(v, noisy(truth))
    free = percents(answer(model, v) - truth, model)
    left = percents(estimate - truth, model)
    assert free[0] > 0.3 and free[1] > 1.0
    # what the first axis feels of the second is 3 % larger, too: 0.03 % of its span
    assert left[0] < 0.04 and left[1] < 0.02
    first, second = live.told
    assert second['gain/value'] == pytest.approx(0.03, abs=5e-4)
    assert abs(first['gain/value']) < 1e-3
    assert abs(first['creep/value'] + first['offset/value']) > 0.3e-6


@pytest.mark.parametrize('options', [{}, {'gain': True}])
def test_an_estimate_is_that_of_the_axis_alone_and_what_it_feels(options):
    model, v = creeping(), scan()
    y = noisy(answer(grown(model, 'y_b'), v, earlier=10.0))
    # displacement a few blocks late, or before its voltage
    plays = ((50, 3), (77, 3), (50, 0))
    estimates = [Live(model, **options).play(v, y, size, late) for size, late in plays]
    free, own = answer(model, v), alone(model)
    channels = {'v_b': v[1], 'y_b': y[1]}
    record = pi.Record.from_arrays(T, v[0], y[0], channels=channels)
    offline = pi.free_run(model, record)
    for k, axis in enumerate(AXES):
        felt = free[k] - own[axis].simulate(v[k])
        assert np.ptp(felt) > 5e-3 * np.ptp(free[k])
        expected = observe(own[axis], Piece(v[k], y[k] - felt, RATE), **options).estimate + felt
        for estimate in estimates:
            assert_allclose(estimate[k], expected, rtol=0, atol=1e-12 * 50e-6)
        if not options:
            seen = np.concatenate(offline[axis].estimate)
            assert_allclose(seen, expected, rtol=0, atol=1e-12 * 50e-6)


def test_a_gain_is_told_of_the_axis_and_not_of_what_it_feels():
    # a fifth of the motion of the second axis, which moves as the first one does
    axes = scanner().axes
    model = pi.MultiAxisModel(
        {
            'y': replace(path(axes['y'], 'motion_b', 0.2), identification=ERRORS),
            'y_b': replace(axes['y_b'], effects=(), identification=ERRORS),
        }
    )
    v = scan((5.0, 5.0))
    y = noisy(answer(grown(model, 'y'), v))
    for name, options in (('learnt/gain', {'adapt': 'gain'}), ('gain/value', {'gain': True})):
        live = Live(model, **options)
        live.play(v, y)
        first, second = (told[name] for told in live.told)
        assert first == pytest.approx(0.03, abs=1e-3) and abs(second) < 1e-3
    assert 'gain +3.0' in live.each[0].corrector.changed and not live.each[1].corrector.changed


def test_what_each_axis_learns_is_one_model_with_the_same_paths(tmp_path):
    model, v = creeping(), scan()
    stage = grown(model, 'y_b')
    live = Live(model, adapt='hysteresis')
    estimate = live.play(v, noisy(answer(stage, v)))
    truth = answer(stage, v)
    left = percents(estimate - truth, model, N - 2000)
    assert left[0] < 0.05 and left[1] < 0.05
    assert live.told[1]['learnt/gain'] == pytest.approx(0.03, abs=2e-3)
    assert abs(live.told[0]['learnt/gain']) < 2e-3

    own = {axis: one.corrector.learnt for axis, one in zip(AXES, live.each, strict=True)}
    with_own(model, own).save(tmp_path / 'learnt.yaml')
    learnt = pi.load(tmp_path / 'learnt.yaml')
    for axis in AXES:
        paths = [
            [e.parameters for e in x.axes[axis].effects if e.name == 'cross_coupling']
            for x in (model, learnt)
        ]
        assert paths[0] == paths[1]
        assert learnt.axes[axis].identification['adaptation'][0]['adapt'] == 'hysteresis'
    assert [e.name for e in learnt.axes['y'].effects] == ['creep', 'cross_coupling']
    # from rest again, with the motion of the second axis 3 % larger on its path, too
    other = scan((3.0, 4.0))
    missed = answer(learnt, other) - answer(stage, other)
    assert (percents(missed, model) < 0.05).all()


def test_each_axis_follows_its_reference_amid_creep_and_with_another_gain():
    kind = chains()
    (tracker, v, error), (_, _, free) = (
        tracked(kind, kind.wanted(10_000), follow, earlier=10.0) for follow in ('gain', 'off')
    )
    left, alone = (np.sqrt(np.mean(e[:, 5000:] ** 2, axis=1)) for e in (error, free))
    assert alone[0] > 0.5 and alone[1] > 1.0
    assert left.max() < 0.1
    gains = [one.corrector.told['gain/value'] for one in tracker.followers]
    assert gains == pytest.approx([0.0, 0.03], abs=1e-3)
    assert kind.within_limits(v)
    while not tracker.is_at_rest:
        tracker.idle(100)
