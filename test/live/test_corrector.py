# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Prediction and displacement joined for an observer, whichever comes first."""

from dataclasses import replace
import itertools

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.live.corrector import Corrector
from piezo_ident.live.monitor import Matcher
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.estimate import observe
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece, Record
import pytest

MODEL = replace(PAPER, identification={'errors': {'held_out': 0.01}})
N = 12_000
T = np.arange(N) / FS
V = 5.0 - 4.0 * np.cos(2 * np.pi * 5 * T)
Y = MODEL.simulate(V) + 0.4e-6 + 2e-9 * np.random.default_rng(1).standard_normal(N)


class Line:
    """What the node does with the two streams."""

    def __init__(self, model=MODEL, v=V, **options):
        self.v = v
        self.predictor, self.matcher = Predictor(), Matcher()
        self.corrector = Corrector(**options)
        self.predictor.set_model(model)
        self.corrector.set_model(model)
        self.got = []

    def play(self, y=Y, *, silent=()):
        """Play both streams block by block; yield the first sample of each before it comes."""
        for k in range(0, N, 100):
            yield k
            self.voltage(slice(k, k + 100))
            if k not in silent:
                self.displacement(slice(k, k + 100), y)

    def voltage(self, cut):
        self.drove(Samples(T[cut], self.v[cut]))

    def drove(self, samples):
        known = self.predictor.memory_known
        prediction = self.predictor.process(samples)
        if prediction is not None:
            self.got += self.corrector.predicted(prediction, samples, known)
            self._pairs(self.matcher.predicted(prediction))

    def displacement(self, cut, y=Y):
        self.moved(Samples(T[cut], y[cut], '', 'displacement'))

    def moved(self, samples):
        self._pairs(self.matcher.measured(samples))

    def _pairs(self, pairs):
        for pair in pairs:
            self.got += self.corrector.measured(pair.t, pair.y)

    @property
    def rows(self):
        t = np.concatenate([one.samples.t for one in self.got])
        return t, np.concatenate([one.samples.values for one in self.got])


@pytest.mark.parametrize('seed', range(4))
def test_neither_the_order_of_arrival_nor_cuts_matter(seed):
    rng = np.random.default_rng(seed)
    # blocks of at least two samples, as one tells no rate
    ends = [[0, *np.sort(rng.choice(np.arange(2, N, 2), 60, replace=False)), N] for _ in range(2)]
    cuts = [[slice(a, b) for a, b in itertools.pairwise(e)] for e in ends]
    line, (voltage, displacement) = Line(), cuts
    while voltage or displacement:
        # one of them up to 0.3 s behind the other
        lead = (
            voltage[0].start / FS - displacement[0].start / FS if voltage and displacement else 0
        )
        first = rng.random() < 0.5 if abs(lead) < 0.3 else lead < 0
        if voltage and (first or not displacement):
            line.voltage(voltage.pop(0))
        else:
            line.displacement(displacement.pop(0))
    t, y = line.rows
    expected = observe(MODEL, Piece(V, Y, FS)).estimate
    assert t.size == N
    assert_allclose(y, expected, rtol=0, atol=1e-12 * 75e-6)
    assert np.abs(y - Y)[2000:].max() < 2e-8 + 5e-8


def test_without_displacement_it_waits_half_a_second_and_goes_on():
    line = Line()
    list(line.play(silent=range(N)))
    # the last wait for nothing
    assert len(line.got) == N // 100
    free = MODEL.simulate(V)
    assert np.array_equal(line.rows[1], free)


def test_a_sensor_that_falls_silent_and_comes_back_is_used_again():
    line = Line()
    list(line.play(silent=range(2000, 9000)))
    t, y = line.rows
    reading = Y.copy()
    reading[2000:9000] = np.nan
    expected = observe(MODEL, Piece(V, reading, FS)).estimate
    assert t.size == N
    assert_allclose(y, expected, rtol=0, atol=1e-12 * 75e-6)


@pytest.mark.parametrize('missing', [200, 11_000])
def test_a_gap_of_voltage_and_a_restart_keep_it_going(missing):
    line = Line()
    for k in range(0, N, 100):
        if not 500 <= k < 500 + min(missing, 4000):
            line.voltage(slice(k, k + 100))
            line.displacement(slice(k, k + 100))
    line.voltage(slice(0, 100))
    for k in range(0, 4000, 100):
        line.voltage(slice(k + 100, k + 200))
        line.displacement(slice(k, k + 100))
    t, y = line.rows
    assert t.size == N - min(missing, 4000) + 4100
    assert np.isfinite(y).all()
    assert np.abs(y[-2000:] - Y[2100:4100]).max() < 2e-7


def test_a_record_with_a_gap_and_left_out_readings_gives_the_same():
    line, cuts, lost = Line(), (slice(0, 3100), slice(3300, N)), slice(5000, 5040)
    for k in [k for k in range(0, N, 100) if not 3100 <= k < 3300]:
        line.voltage(slice(k, k + 100))
        line.displacement(slice(k, k + 100), np.where(np.arange(N) // 40 == 125, np.nan, Y))
    sound = np.ones(N, dtype=bool)
    sound[lost] = False
    pieces = [Piece(V[c], Y[c], FS, start_time=T[c][0], sound=sound[c]) for c in cuts]
    run = pi.free_run(MODEL, Record(tuple(pieces), 'gap'))
    t, y = line.rows
    assert t.size == N - 200
    assert_allclose(y, np.concatenate(run.estimate), rtol=0, atol=1e-12 * 75e-6)
    assert run.errors_of_estimate.percent < 0.2 * run.errors.percent


CREEP = EffectSetting('creep', {'gain': [0.02, 0.01], 'time_constant': [0.02, 0.5]})


@pytest.mark.parametrize(
    ('model', 'rate'),
    # a static model holds at any rate
    [(replace(MODEL, effects=(CREEP,)), FS), (MODEL.without_dynamics(), 7000.0)],
)
def test_a_record_of_pieces_far_apart_is_estimated_piece_by_piece(model, rate):
    line, rng = Line(model), np.random.default_rng(5)
    pieces = []
    # the second begins in mid-stream, the third at the top
    for start, phase in ((0.0, np.pi), (3.0, 1.0), (10.0, 0.0)):
        t = start + np.arange(2000) / rate
        v = 5.0 + 4.0 * np.cos(2 * np.pi * 9.0 * (t - start) + phase)
        y = model.simulate(v) + start * 1e-7 + 2e-9 * rng.standard_normal(t.size)
        pieces.append(Piece(v, y, rate, start_time=start))
        for k in range(0, t.size, 100):
            cut = slice(k, k + 100)
            line.drove(Samples(t[cut], v[cut]))
            line.moved(Samples(t[cut], y[cut], '', 'displacement'))
    run = pi.free_run(model, Record(tuple(pieces), 'apart'))
    t, y = line.rows
    assert t.size == 6000
    assert_allclose(y, np.concatenate(run.estimate), rtol=0, atol=1e-12 * 75e-6)
    for piece, estimate in zip(pieces, run.estimate, strict=True):
        # each begins anew, with the free run
        free = model.stream().process(piece.v, np.arange(piece.n) / rate)
        assert_allclose(estimate[:100], free[:100], rtol=0, atol=1e-12 * 75e-6)


def test_it_follows_the_gain_on_request_and_tells_so_in_order_of_time():
    line = Line(gain=True, rate=100.0)
    list(line.play())
    _, y = line.rows
    expected = observe(MODEL, Piece(V, Y, FS), gain=True).estimate
    assert_allclose(y, expected, rtol=0, atol=1e-12 * 75e-6)
    told = [row for one in line.got for row in one.corrections]
    assert len(told) == N / FS * 100
    assert told[-1] == line.corrector.told and 0.0 < told[-1]['gain/std'] < 1e-2


H = MODEL.hysteresis


def with_modes(factor):
    """Return the model with the frequencies of its modes multiplied."""
    poles = MODEL.dynamics.poles**factor
    a = np.real(np.poly(poles))
    b = MODEL.dynamics.b * a.sum() / (1.0 + MODEL.dynamics.a.sum())
    return replace(MODEL, dynamics=Dynamics(a[1:], b))


@pytest.mark.parametrize(
    ('stage', 'names'),
    [
        (MODEL, set()),
        (replace(MODEL, hysteresis=H.scaled(1.03)), {'gain +3.0'}),
        (replace(MODEL, hysteresis=replace(H, weights=1.1 * H.weights)), {'loop width +10.0'}),
        (replace(MODEL, hysteresis=replace(H, weights=0.9 * H.weights)), {'loop width -10.0'}),
        (with_modes(0.7), {'slower dynamics'}),
        (with_modes(1.3), {'faster dynamics'}),
        (replace(with_modes(0.7), hysteresis=H.scaled(1.01)), {'gain +1.0', 'slower dynamics'}),
    ],
)
def test_what_changed_of_a_running_stage_is_named_with_its_size(stage, names):
    line, rng = Line(), np.random.default_rng(2)
    # an offset, noise and lost words change none of the names
    y = stage.simulate(V) + 0.4e-6 + 2e-9 * rng.standard_normal(N)
    y[777::900] = 0.0
    list(line.play(y))
    said = line.corrector.changed
    assert all(name in said for name in names)
    assert len(said.split(', ')) == max(len(names), 1) and bool(said) == bool(names)


@pytest.mark.parametrize(
    ('fault', 'says'),
    [
        (lambda y: y, ''),
        (lambda y: 1.03 * y, ''),
        (lambda y: y + 1e-6, 'stepped'),
        (lambda y: 60e-6 - y, 'against the stage'),
        (lambda y: np.full(y.size, y[0]), 'stays the same'),
    ],
)
def test_a_sensor_at_fault_is_told_within_a_fifth_of_a_second_of_motion(fault, says):
    line, y, at = Line(), Y.copy(), 6000
    y[at:] = fault(y[at:])
    told = [line.corrector.doubt for _ in line.play(y)]
    assert not any(told[: at // 100 + 1])
    # 0.2 s of a scan of 5 Hz
    assert all(says in said for said in told[at // 100 + 41 :])
    assert bool(line.corrector.doubt) == bool(says)


@pytest.mark.parametrize('moves', [True, False])
@pytest.mark.parametrize(
    ('fault', 'says'),
    [
        (lambda y: y, ''),
        (lambda y: y + 1e-7, 'stepped'),
        # about the place of the stage, so that nothing steps
        (lambda y: 2.0 * y[0] - y, 'against the stage'),
        (lambda y: np.full(y.size, y[0]), 'stays the same'),
    ],
)
def test_a_sensor_at_fault_is_told_by_a_motion_of_five_percent_of_the_stroke(fault, says, moves):
    at, first = 2000, 3000
    v = 5.0 + 0.25 * moves * (1.0 - np.cos(2 * np.pi * 5 * np.maximum(T - T[first], 0.0)))
    truth, line = MODEL.simulate(v), Line(v=v)
    far = np.abs(truth - truth[first]) / abs(MODEL.scaling.Y)
    assert far.max() == pytest.approx(0.053 * moves, abs=2e-3)
    y = truth + 2e-9 * np.random.default_rng(3).standard_normal(N)
    y[at:] = fault(y[at:])
    told = [line.corrector.doubt for _ in line.play(y)]
    assert not any(told[: at // 100 + 1])
    # at rest a sound sensor, one of the other sign and one that is stuck read the same
    if says != 'stepped':
        assert not any(told[: (first if moves and says else N) // 100])
    if says and (moves or says == 'stepped'):
        # a step shows without any motion
        here = np.argmax(far > 0.05) if moves else at
        assert any(says in said for said in told[: int(here + 0.2 * FS) // 100])


def test_an_error_of_another_kind_is_given_no_name():
    line = Line()
    # a disturbance of another frequency, and a bend of the characteristic
    for more in (1e-7 * np.sin(2 * np.pi * 37 * T), 2e-8 * (V - 5.0) ** 2):
        list(line.play(MODEL.simulate(V) + more))
        assert line.corrector.changed == ''


def test_behind_a_gap_the_memory_is_unknown_before_its_displacement_has_come():
    corrector = Corrector()
    corrector.set_model(MODEL)
    for first, knows in ((0, True), (100, True), (300, False)):
        cut = slice(first, first + 100)
        prediction = Samples(T[cut], Y[cut], '', 'displacement')
        corrector.predicted(prediction, Samples(T[cut], V[cut]), known=True)
        if first < 100:
            corrector.measured(T[cut], Y[cut])
        assert corrector.knows_memory == knows


def test_what_is_learnt_is_in_the_estimate_and_outlives_a_restart():
    line, y = Line(adapt='gain'), 1.03 * MODEL.simulate(V)
    for start in (0, 1):
        line.got.clear()
        list(line.play(y))
        t, estimate = line.rows
        # the second time it is known from the start
        first = 0 if start else 8000
        assert np.abs(estimate - y)[t >= T[first]].max() < 3e-8
        assert line.corrector.told['learnt/gain'] == pytest.approx(0.03, abs=1e-3)
        assert 'learnt gain +3 %' in line.corrector.corrected
    learnt = line.corrector.learnt
    assert learnt.hysteresis.p2 == pytest.approx(1.03 * MODEL.hysteresis.p2, rel=1e-3)
    assert 's of motion' in line.corrector.restore()
    assert line.corrector.learnt.hysteresis.p2 == MODEL.hysteresis.p2
    with pytest.raises(DataError, match='adapt'):
        Corrector().restore()


def test_a_model_that_comes_later_learns_as_one_from_the_start():
    creep = EffectSetting('creep', {'gain': [0.02], 'time_constant': [1.0]})
    model, got = replace(MODEL, effects=(creep,)), []
    y = 1.03 * model.simulate(V)
    for late in (False, True):
        line = Line(model, adapt='hysteresis')
        for k in line.play(y):
            if late and k == 2000:
                caught_up = line.predictor.caught_up
                line.corrector.set_up(100, False, False, 'hysteresis', 5.0, recalled=caught_up)
                line.got.clear()
        got.append((line.rows[1][-2000:], line.corrector.told['learnt/gain']))
    assert_allclose(*(x for x, _ in got), rtol=0, atol=2e-8)
    assert got[1][1] == pytest.approx(0.03, abs=2e-3)


def test_the_time_base_holds_for_days():
    # after 3 years the period of a block of 10 samples is wrong by some 1e-5
    def estimated(begin):
        line = Line()
        for k in range(0, N, 10):
            t = begin + T[k : k + 10]
            line.drove(Samples(t, V[k : k + 10]))
            line.moved(Samples(t, Y[k : k + 10], '', 'displacement'))
        return line.rows[1]

    assert_allclose(estimated(1e8), estimated(0.0), atol=1e-12)


def test_a_static_model_begins_with_a_single_sample():
    static = replace(MODEL, dynamics=Dynamics.unit(), delay=replace(MODEL.delay, samples=0))
    corrector = Corrector(horizon=2)
    corrector.set_model(static)
    corrector.predicted(Samples(T[:1], V[:1]), Samples(T[:1], V[:1]), known=True)
    later = Samples(T[1:100], V[1:100])
    corrector.predicted(later, later, known=True)
    assert corrector.measured(T[:100], Y[:100])
