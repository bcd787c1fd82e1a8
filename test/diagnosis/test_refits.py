# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Refits of H drawn to the given H, and of G beside an effect that moves its mode."""

from dataclasses import replace
from types import SimpleNamespace

from diagnosis_examples import measured, played, refined_model
import numpy as np
from piezo_ident.common.errors import Cancelled, ModelError
from piezo_ident.diagnosis import refits as refits_module
from piezo_ident.diagnosis.decision import FittedSet
from piezo_ident.diagnosis.diagnose import diagnose
from piezo_ident.diagnosis.equations import held_out_residual, solve
from piezo_ident.diagnosis.refined_model import _at_given_gain, _model
from piezo_ident.diagnosis.refits import loops, refits, toward_given, with_numerator
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.diagnosis.rows import centred, make_rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, State
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.record.record import Record
from programs import SLOW, slow_model
import pytest

CREEP = Added('creep', ({'gain': [0.01], 'time_constant': [0.5]},))


def without_labels() -> Record:
    (piece,) = measured().pieces
    return Record((replace(piece, segments=()),), 'unlabelled')


@pytest.fixture(scope='module')
def refit():
    """Return simulator, the state as given, and a refit of an H that is none of the data's."""
    simulator = Simulator(slow_model(), make_rows(slow_model(), [without_labels()]))
    h = slow_model().hysteresis
    given = State(replace(h, weights=h.weights[::-1].copy()), np.zeros(1))
    return simulator, given, refits(simulator, given)[0]


def distance(given: State, state: State) -> float:
    """Return by how much two H differ under loops, their means aside."""
    u = loops(0.0, 1.0)
    return float(np.std(state.hysteresis(u) - given.hysteresis(u)))


def test_a_refit_of_one_kind_of_motion_stays_nearer_to_the_given_h(refit):
    simulator, given, fitted = refit
    near = toward_given(simulator, given, fitted)
    rows = simulator.rows
    as_given = np.mean(centred(rows.x - simulator.run(given), rows.of_record) ** 2)
    assert distance(given, near.state) < 0.9 * distance(given, fitted.state)
    assert fitted.mean_square < near.mean_square < as_given


def test_it_can_be_cancelled(refit):
    def cancel():
        raise Cancelled('toward the given H')

    with pytest.raises(Cancelled):
        toward_given(*refit, cancel)


def test_the_given_h_is_never_held_out(refit):
    simulator, given, fitted = refit
    near, rows = toward_given(simulator, given, fitted), simulator.rows
    left = near.held_out_residual(rows, rows.group)
    out = (rows.group == 3)[rows.block]
    M, pull = near.J, near.pull
    A, b = M[~out].T @ M[~out] + pull.A, M[~out].T @ near.e[~out] + pull.b
    theta = solve(A, b, near.prior[near.free])
    np.testing.assert_allclose(left[out], (near.e - M @ theta)[out], atol=1e-9)
    # and without it the data alone tell the rest
    alone = held_out_residual(rows, M, near.e, near.prior[near.free], rows.group)
    assert np.sum(alone**2) < np.sum(left**2)


def test_several_kinds_of_motion_tell_h_by_themselves(refit):
    _, given, _ = refit
    simulator = Simulator(slow_model(), make_rows(slow_model(), [measured()]))
    fitted = refits(simulator, given)[0]
    assert simulator.rows.kinds
    assert toward_given(simulator, given, fitted) is fitted


def test_data_of_a_part_of_the_range_tell_h_there_by_themselves():
    (piece,) = without_labels().pieces
    half = replace(piece, v=0.5 * piece.v)
    half = replace(half, y=slow_model().predict_piece(half))
    simulator = Simulator(slow_model(), make_rows(slow_model(), [Record((half,), 'half')]))
    given = State(slow_model().hysteresis, np.zeros(1))
    fitted = refits(simulator, given)[0]
    assert toward_given(simulator, given, fitted) is fitted


@pytest.mark.parametrize('labelled', [True, False])
def test_lags_are_taken_where_labels_tell_that_they_hold_for_other_motion(labelled):
    lags = [[1.0, 0.1, -0.06, 0.05], [4.0, -0.08, 0.12, -0.05]]
    h = replace(slow_model().hysteresis, relaxations=lags)
    truth = replace(refined_model(), hysteresis=h)
    record = played(truth, 'lags')
    if not labelled:
        (piece,) = record.pieces
        record = Record((replace(piece, segments=()),), 'lags')
    result = diagnose(slow_model(), record, DiagnosisSettings(effects=('creep',)))
    assert result.law == ('duhem' if labelled else 'plays')
    assert [e.name for e in result.effects] == ['creep']
    assert result.after.overall < 0.2 * result.before.overall
    t = np.arange(6 * SLOW) / SLOW
    v = np.interp(t, [0, 1, 1.5, 2, 3, 4, 6], [0, 10, 4, 7, 3, 9, 0])
    y = truth.simulate(v)
    before, after = (np.std(m.simulate(v) - y) for m in (slow_model(), result.model))
    assert after < 0.25 * before


def test_a_gain_that_wanders_is_elsewhere_as_far_as_given(refit):
    simulator, _, fitted = refit
    given = replace(fitted.state, offsets=np.zeros(1))
    # H takes a quarter less, and the gain makes up for that on the whole
    theta = 0.75 * given.coefficients
    wanders = Added('gain_drift', ({'time': [0.0, 10.0], 'gain': [0.2, 0.5]},))
    state = given.with_coefficients(given.law, theta).with_effect(wanders)
    [added] = _at_given_gain(simulator, given, state).effects
    assert added.values[0]['gain'] == pytest.approx([1.0 / 3.0], rel=1e-6)


def test_a_drift_that_is_left_out_leaves_the_zero_where_it_was(refit):
    simulator, _, fitted = refit
    # an offset makes up for it, and the next record need not drift like this one
    drift = Added('thermal_drift', ({'amplitude': -1.0, 'time_constant': 1e-3},))
    state = replace(fitted.state.with_effect(drift), offsets=np.ones(1))
    findings = Findings('named', ('thermal_drift',), (1.0,), None, 1.0, 1.0, 0.0)
    scaling = simulator.model.scaling
    refined = _model(simulator, state, findings, scaling.range, ())
    v = without_labels().pieces[0].v
    means = [float(m.simulate(v).mean()) for m in (simulator.model, refined)]
    assert means[0] == pytest.approx(means[1], abs=1e-3 * abs(scaling.Y))


def test_a_failed_fit_of_the_numerator_keeps_the_step(monkeypatch):
    tried = []

    def fails(simulator, a, state):
        tried.append(np.array(a))
        raise ModelError('no such filter')

    monkeypatch.setattr(refits_module, '_with_other_numerator', fails)
    spring = Added('loop_hysteresis', ({'frequency': 300.0, 'damping': 0.03},))
    fitted = SimpleNamespace(state=SimpleNamespace(effects=(CREEP, spring)), mean_square=1.0)
    step = FittedSet((), 'plays', fitted)
    model = slow_model()
    assert with_numerator(SimpleNamespace(model=model), step) is step
    # G as given, and the mode of the spring alone
    assert np.array_equal(tried[0], model.dynamics.a)
    pole = np.roots([1.0, *tried[1]])[0]
    assert abs(np.log(pole)) * model.sample_rate == pytest.approx(2.0 * np.pi * 300.0)
    assert len(tried) == 2
