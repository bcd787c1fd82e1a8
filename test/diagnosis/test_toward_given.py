# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A refit that knows one kind of motion alone, and the H that it was given."""

from dataclasses import replace

from diagnosis_examples import measured, played, refined_model
import numpy as np
from piezo_ident.common.errors import Cancelled
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.base_refit import _is_loose, refit_of, refits
from piezo_ident.diagnosis.cross_validation import held_out_residual, solve
from piezo_ident.diagnosis.diagnose import diagnose
from piezo_ident.diagnosis.refined_model import _at_given_gain, _model
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.diagnosis.rows import centred, make_rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, State
from piezo_ident.diagnosis.toward_given import loops, toward_given
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.record import Record
from programs import SLOW, slow_model
import pytest

CREEP = Added('creep', ({'gain': [0.01], 'time_constant': [0.5]},))
LINE = {'frequency': 50.0, 'harmonic': [1.0], 'amplitude': [1e-4], 'phase': [0.0]}
HUM = Added('periodic_disturbance', (LINE,))


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


def test_an_effect_of_the_voltage_has_bent_the_given_h(refit):
    simulator, given, fitted = refit

    def weight(effect):
        beside = replace(fitted, state=fitted.state.with_effect(effect))
        return toward_given(simulator, given, beside).pull.A.max()

    e = centred(simulator.rows.x - simulator.run(given), simulator.rows.of_record)
    left = fitted.errors.sum() / (e @ e)
    assert left < 0.5
    assert weight(CREEP) == pytest.approx(left * weight(HUM), rel=1e-9)


def test_an_h_to_which_a_refit_adds_little_stays():
    v = without_labels().pieces[0].v
    limit = Added('slew_limit', ({'limit': 0.5 * float(np.abs(np.diff(v)).max()) * SLOW},))
    stage = replace(slow_model(), effects=(EffectSetting(limit.name, limit.values[0]),))
    y = stage.simulate(v) + 2e-9 * np.random.default_rng(5).standard_normal(v.size)
    record = Record.from_arrays(v, y, sample_rate=SLOW)
    simulator = Simulator(slow_model(), make_rows(slow_model(), [record]))
    given = State(slow_model().hysteresis, np.zeros(1))
    retuned = replace(given.with_effect(limit), retuning=(0.0,) * 4)
    fitted = refit_of(simulator, retuned, 'plays')
    near = toward_given(simulator, given, fitted)
    assert near.state.law is None and near.state.retuning == ()
    assert near.state.hysteresis is given.hysteresis
    assert near.state.effects[0].name == 'slew_limit'
    # with an H that is none of the data's it does not
    other = replace(given.hysteresis, weights=given.hysteresis.weights[::-1].copy())
    assert toward_given(simulator, replace(given, hysteresis=other), fitted).state.law is not None


def test_a_mode_is_bent_less_for_one_sine(monkeypatch):
    pole = 0.99 * np.exp(2j * np.pi * 0.03)
    a = np.array([-2.0 * pole.real, abs(pole) ** 2])
    model = replace(slow_model(), dynamics=Dynamics(a, np.array([1.0 + a.sum()])))
    (piece,) = without_labels().pieces
    t, last = np.arange(piece.n) / SLOW, np.linspace(0.0, 1.0, piece.n) > 0.8
    sine = last * np.sin(2.0 * np.pi * 0.01 * SLOW * t)
    v = np.clip(piece.v + sine, *model.scaling.range)
    # what another H makes of the sine, three times as fast, is where the mode rings
    error = 0.02 * last * np.cos(2.0 * np.pi * 0.03 * SLOW * t - 1.0) * model.scaling.Y
    record = Record.from_arrays(v, model.simulate(v) + error, sample_rate=SLOW)
    simulator = Simulator(model, make_rows(model, [record]))
    given = State(model.hysteresis, np.zeros(1), retuning=(0.0,) * 4)
    fitted = refit_of(simulator, given, 'plays')
    near = toward_given(simulator, given, fitted)

    def rings(state):
        c = np.array(state.retuning)
        return c @ simulator.retuning_squares @ c

    monkeypatch.setattr(criteria, 'NOISE_OF_G', 0.0)
    toward_h = toward_given(simulator, given, fitted)
    assert rings(near.state) < 0.6 * min(rings(fitted.state), rings(toward_h.state))


def test_lags_that_make_up_for_one_another_are_loose(refit):
    simulator, given, fitted = refit
    assert not _is_loose(simulator, given, fitted)
    lags = [[1.0, 30.0, -20.0, 0.0], [2.0, -30.0, 20.0, 0.0]]
    h = replace(fitted.state.hysteresis, relaxations=lags)
    loose = replace(fitted, state=replace(fitted.state, hysteresis=h))
    assert _is_loose(simulator, given, loose)
    # kinds of motion tell by themselves
    kinds = Simulator(slow_model(), make_rows(slow_model(), [measured()]))
    assert not _is_loose(kinds, given, loose)


def test_lags_that_are_there_are_found_without_labels():
    lags = [[1.0, 0.1, -0.06, 0.05], [4.0, -0.08, 0.12, -0.05]]
    h = replace(slow_model().hysteresis, relaxations=lags)
    truth = replace(refined_model(), hysteresis=h)
    (piece,) = played(truth, 'lags').pieces
    record = Record((replace(piece, segments=()),), 'lags')
    result = diagnose(slow_model(), record, DiagnosisSettings(effects=('creep',)))
    assert result.law == 'duhem'
    # the given model errs by 1.8 %, a refit without lags by 0.29 %
    assert result.after.overall < 0.02
    t = np.arange(6 * SLOW) / SLOW
    v = np.interp(t, [0, 1, 1.5, 2, 3, 4, 6], [0, 10, 4, 7, 3, 9, 0])
    y = truth.simulate(v)
    assert np.std(result.model.simulate(v) - y) < 2e-4 * np.ptp(y)


def test_a_gain_that_wanders_is_elsewhere_as_far_as_given(refit):
    simulator, _, fitted = refit
    given = replace(fitted.state, offsets=np.zeros(1))
    # H takes a quarter less, and the gain makes up for that on the whole
    theta = 0.75 * given.coefficients
    wanders = Added('gain_drift', ({'time': [0.0, 10.0], 'gain': [0.2, 0.5]},))
    state = given.with_coefficients(given.law, theta).with_effect(wanders)
    [added] = _at_given_gain(simulator, given, state).effects
    assert added.values[0]['gain'] == pytest.approx([1.0 / 3.0], rel=1e-6)


def test_a_drift_that_is_left_out_takes_its_mean_along(refit):
    simulator, _, fitted = refit
    # over at once, so an offset makes up for it
    drift = Added('thermal_drift', ({'amplitude': -1.0, 'time_constant': 1e-3},))
    state = replace(fitted.state.with_effect(drift), offsets=np.ones(1))
    findings = Findings('named', 1.0, ('thermal_drift',), None, 0.0)
    scaling = simulator.model.scaling
    refined = _model(simulator, state, findings, scaling.range, ())
    assert refined.scaling.y0 == pytest.approx(scaling.y0, abs=1e-3 * abs(scaling.Y))
