# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage that has moved shortly before a record still creeps when it begins."""

from dataclasses import replace

from diagnosis_examples import CREEP, NOISE, played, refined_model, with_effects
import numpy as np
from piezo_ident import diagnose, DiagnosisSettings
from piezo_ident.diagnosis.rows import make_rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, State
from piezo_ident.record.record import Record
from programs import SLOW, slow_model
import pytest

STILL = 'still crept from motion'
#: what motion before a record may be taken for
FEW = DiagnosisSettings(effects=('creep', 'thermal_drift', 'gain_drift'))
#: five seconds near the upper end
MOVED = 10.0 * np.sin(np.linspace(0.0, np.pi, round(5 * SLOW))) ** 0.25


def crept(seconds: float) -> Record:
    """Return what is measured so many seconds after an earlier motion."""
    earlier = np.concatenate([MOVED, np.zeros(round(seconds * SLOW))])
    return played(refined_model(), 'crept', earlier)


@pytest.fixture(scope='module')
def moved() -> Record:
    return crept(0.2)


@pytest.fixture(scope='module')
def found(moved):
    return diagnose(slow_model(), moved)


def unseen(model) -> float:
    """Return the error of motion that begins at rest, % of stroke."""
    t = np.arange(round(6 * SLOW)) / SLOW
    v = 5.0 * (1.0 - np.cos(2.0 * np.pi * 0.5 * t)) * (t < 4.0)
    truth = refined_model().simulate(v)
    e = truth - model.simulate(v)
    return 100.0 * float(np.std(e) / np.ptp(truth))


def test_what_creeps_on_is_a_sum_of_decays(moved):
    """The true creep, started from rest, leaves ``sum_i d_i exp(-t / tau_i)``."""
    times = tuple(CREEP['time_constant'])
    simulator = Simulator(slow_model(), make_rows(slow_model(), [moved]))
    state = State(slow_model().hysteresis, np.zeros(1), (Added('creep', (CREEP,)),))
    e = simulator.rows.x - simulator.run(state)
    assert np.std(e) > 20 * NOISE / 75e-6
    state = replace(state, fading=times, earlier=np.zeros((1, 2)))
    columns = simulator.added_columns(state)
    assert columns.shape == (e.size, 3)
    known = np.linalg.lstsq(columns, e, rcond=None)[0]
    state = state.with_only_added(known)
    # the stage was near its upper end, each element in part
    assert np.all(state.earlier[0] > 0.0) and np.all(state.earlier[0] < CREEP['gain'])
    left = simulator.rows.x - simulator.run(state)
    assert np.std(left) < 2 * NOISE / 75e-6
    # at the full rate it is the same
    rows = simulator.rows.of(simulator.full(state))
    np.testing.assert_allclose(rows, simulator.run(state), atol=1e-12)


def test_creep_is_found_as_if_the_stage_had_rested_and_it_is_said_that_it_had_not(found):
    assert [e.name for e in found.effects] == ['creep'] and found.verdict == 'named'
    assert found.after.overall < 0.02
    assert unseen(found.model) < 0.03 < 0.1 * unseen(slow_model())
    (told,) = [w for w in found.warnings if STILL in w]
    assert 0.2 < float(told.split('up to ')[1].split(' %')[0]) < 2.2


def test_a_model_that_creeps_lacks_nothing(moved):
    result = diagnose(refined_model(), moved)
    assert (result.verdict, result.effects) == ('none', ()) and result.before.overall < 0.01
    assert any(STILL in w for w in result.warnings)


def test_a_sensor_set_to_zero_since_makes_no_difference(moved, found):
    (piece,) = moved.pieces
    zero = Record((replace(piece, y=piece.y + 30e-6),), 'zero')
    again = diagnose(slow_model(), zero, FEW)
    assert [e.name for e in again.effects] == ['creep']
    assert again.after.overall < 0.02 and unseen(again.model) < 0.03


def test_a_drift_that_no_creep_leaves_is_a_drift():
    """A stage at the lowest voltage sinks after earlier motion; this one rises, and by more."""
    drift = {'amplitude': 0.02, 'time_constant': 2.0}
    record = played(with_effects(creep=CREEP, thermal_drift=drift), 'drift')
    result = diagnose(slow_model(), record, FEW)
    assert [e.name for e in result.effects] == ['creep', 'thermal_drift']
    assert not any(STILL in w for w in result.warnings)
    assert unseen(result.model) < 0.03


def test_decays_count_from_where_the_record_does(moved):
    """Of a record that starts anywhere they would be of any size by then."""
    (piece,) = moved.pieces
    rows = make_rows(slow_model(), [Record((piece.cut(round(4.2 * SLOW), piece.n),), 'cut')])
    assert not rows.keep[0][0]
    decay = rows.of([rows.fading(0, (0.02,))[0]])
    assert decay[0] > 0.9 and np.all(np.diff(decay) <= 0.0)
    assert rows.fading(0, (0.02,)).max() == 1.0


def test_a_state_from_rest_does_not_creep_on():
    state = State(slow_model().hysteresis, np.zeros(2), (Added('creep', (CREEP,)),))
    state = replace(state, fading=(0.1, 1.0), earlier=np.ones((2, 2)))
    assert state.only_adds.size == 6 and state.with_only_added(state.only_adds).earlier.all()
    assert state.from_rest().only_adds.size == 2 and not state.from_rest().fading


def test_a_stage_that_rested_creeps_from_rest():
    result = diagnose(slow_model(), crept(20.0), FEW)
    assert [e.name for e in result.effects] == ['creep']
    assert not any(STILL in w for w in result.warnings)
    assert unseen(result.model) < 0.03
