# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes that changed: one creeps from earlier motion, one moves 3 % more."""

from dataclasses import replace
import functools

from axes_scanner import answer, AXES, creeping, ERRORS, grown, moving, path, RATE, scanner
import numpy as np
from numpy.testing import assert_allclose
import piezo_ident as pi
from piezo_ident.live.comparison import AxisComparison
from piezo_ident.live.corrector import Corrector
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.live_learning import LiveLearning
from piezo_ident.live.predictor import Predictor
from piezo_ident.live.tracker import Tracker
from piezo_ident.model.multi_axis import alone, with_own
from piezo_ident.model.observer import observe
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
import pytest

N = 12_000
LIMITS = GuardSettings(0.0, 10.0, 40e3, 200.0, 0.0, RATE)
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


def noisy(y, seed=1):
    return y + 1.5e-9 * np.random.default_rng(seed).standard_normal(y.shape)


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
    for k, axis in enumerate(AXES):
        felt = free[k] - own[axis].simulate(v[k])
        assert np.ptp(felt) > 5e-3 * np.ptp(free[k])
        expected = observe(own[axis], Piece(v[k], y[k] - felt, RATE), **options).estimate + felt
        for estimate in estimates:
            assert_allclose(estimate[k], expected, rtol=0, atol=1e-12 * 50e-6)


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


def tracked(follow, size=50, seconds=10.0, earlier=10.0):
    """Track a scan of both axes; return the tracker, voltages, and errors [% of the span]."""
    tracker = Tracker(creeping(), LIMITS, 60, follow, AXES)
    run, t = moving(grown(creeping(), 'y_b'), earlier), np.arange(round(seconds * RATE)) / RATE
    noise = noisy(np.zeros((2, t.size)))
    waves = np.stack([np.cos(2 * np.pi * f * t) for f in (3.0, 0.7)])
    wanted, parts = np.array([[20e-6], [15e-6]]) * (1.0 - 0.8 * waves), []
    for k in range(0, t.size, size):
        drive = tracker.process(wanted[:, k : k + size], k == 0)
        y = run.process(drive.v, drive.t)
        for i, row in enumerate(y + noise[:, k : k + size]):
            tracker.measured(Samples(drive.t, row), i)
        parts.append((drive.v, y - drive.wanted))
    v, error = (np.hstack(rows) for rows in zip(*parts, strict=True))
    return tracker, v, 100.0 * error / np.ptp(wanted, axis=1)[:, None]


def test_each_axis_follows_its_reference_amid_creep_and_with_another_gain():
    tracker, v, error = tracked('gain')
    left, alone = (np.sqrt(np.mean(e[:, 5000:] ** 2, axis=1)) for e in (error, tracked('off')[2]))
    assert alone[0] > 0.5 and alone[1] > 1.0
    assert left.max() < 0.1
    gains = [one.corrector.told['gain/value'] for one in tracker.followers]
    assert gains == pytest.approx([0.0, 0.03], abs=1e-3)
    assert v.min() >= LIMITS.low and v.max() <= LIMITS.high
    assert np.abs(np.diff(v, axis=1)).max() <= LIMITS.step * (1 + 1e-9)
    while not tracker.is_at_rest:
        tracker.idle(100)


def test_how_the_streams_are_cut_does_not_matter_to_what_follows():
    one, other = (tracked('gain', size, seconds=3.0) for size in (10, 37))
    assert_allclose(one[1], other[1], rtol=0, atol=1e-9)


def repeated(stage, wanted, most=6):
    """Repeat a motion of both axes; return the learning, the voltages, and the last motion."""
    learning, sent = LiveLearning(scanner(), wanted, LIMITS, AXES), []
    while not learning.is_done and len(learning.errors) < most:
        tracker = Tracker(scanner(), LIMITS, 60, axes=AXES)
        t, v = tracker.play(learning.voltage)
        y = stage.process(v, t)
        for k, row in enumerate(noisy(y, len(sent))):
            learning.measured(Samples(t, row), 0, k)
        assert learning.is_complete
        moved = y[:, -wanted.shape[1] :] - wanted
        learning.take()
        sent.append(v)
        stage.process(*reversed(tracker.idle(3000)))
    return learning, np.hstack(sent), moved


def test_a_motion_of_all_axes_is_learnt_with_the_paths_made_up_for():
    t = np.arange(2000) / RATE
    waves = np.stack([np.cos(2 * np.pi * f * t) for f in (3.0, 2.0)])
    wanted = np.array([[20e-6], [15e-6]]) * (1.0 - 0.8 * waves)
    # the stage of the model is met at once, paths included
    learning, _, _ = repeated(moving(scanner()), wanted, 1)
    assert learning.errors[0] < 0.02
    # one that creeps and moves more is not
    learning, v, moved = repeated(moving(grown(creeping(), 'y_b')), wanted)
    assert learning.errors[0] > 1.0 and min(learning.errors) < 0.1
    assert (np.std(moved, axis=1) < 1e-3 * np.ptp(wanted, axis=1)).all()
    assert v.min() >= LIMITS.low and v.max() <= LIMITS.high
    assert np.abs(np.diff(v, axis=1)).max() <= LIMITS.step * (1 + 1e-9)


def test_an_axis_that_nobody_moves_is_no_obstacle_to_learning():
    t = np.arange(2000) / RATE
    wanted = np.stack([20e-6 * (1.0 - 0.8 * np.cos(2 * np.pi * 3.0 * t)), np.zeros(t.size)])
    # at its lowest voltage it cannot make up for what the first axis moves of it
    learning, v, _ = repeated(moving(grown(scanner(), 'y')), wanted)
    assert v[1].max() < 0.02
    first = [r.error for r in learning.each['y'].repetitions]
    assert first[0] > 1.0 and min(first) < 0.05


def test_a_sensor_at_fault_ends_learning_with_the_name_of_its_axis():
    t = np.arange(1000) / RATE
    wanted = np.stack([15e-6 * (1.0 - 0.8 * np.cos(2 * np.pi * 3.0 * t))] * 2)
    learning = LiveLearning(scanner(), wanted, LIMITS, AXES)
    for broken in (True, False):
        at = np.arange(learning.voltage.shape[1]) / RATE
        y = answer(scanner(), learning.voltage)
        for k, row in enumerate(y):
            learning.measured(Samples(at, np.zeros(at.size) if broken and k else row), 0, k)
        assert learning.is_complete
        if broken:
            with pytest.raises(pi.DataError, match='y_b: learning: the displacement stands'):
                learning.take()
        else:
            # it goes on with what was sound
            learning.take()
            assert learning.errors[0] < 0.02
        assert not learning.is_complete
