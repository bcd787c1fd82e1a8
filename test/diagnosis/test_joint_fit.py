# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The joint fit: what a step promises, what multiplies H, and fits from several starts."""

from __future__ import annotations

from dataclasses import replace
import threading
import time

import numpy as np
from piezo_ident.common.errors import Cancelled, IdentificationError, ModelError
from piezo_ident.diagnosis.equations import BaseColumns, FitStep, next_damping, Scale
from piezo_ident.diagnosis.joint_fit import fit_base, fit_jointly, Until
from piezo_ident.diagnosis.refits import base_thresholds
from piezo_ident.diagnosis.rows import make_rows
from piezo_ident.diagnosis.search import fit_states
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, State
from piezo_ident.effects import find_effect
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.record.record import Record
import pytest

RATE = 20_000.0


def crept(gain: float) -> tuple[Simulator, State, BaseColumns]:
    """Return rows of a stage that creeps within 10 ms, and H fitted without that."""
    model = SimulatedStage.load('paper').model
    t = np.arange(60_000) / RATE
    # motion so slow that creep is nearly a gain
    v = 5.0 * (1.0 - np.cos(4.0 * np.pi * t) * np.cos(0.7 * t))
    creep = EffectSetting('creep', {'gain': [gain], 'time_constant': [0.01]})
    y = replace(model, effects=(creep,)).simulate(v)
    record = Record.from_arrays(v, y, sample_rate=RATE)
    simulator = Simulator(model, make_rows(model, [record]))
    law = HysteresisLaw('plays', base_thresholds(1.0))
    state, base = fit_base(simulator, State(model.hysteresis, np.zeros(1)), law)
    values = find_effect('creep').check({'gain': [0.0], 'time_constant': [0.01]})
    return simulator, state.with_effect(Added('creep', (values,))), base


def test_h_and_what_multiplies_it_move_together(monkeypatch):
    simulator, state, base = crept(-0.3)
    together = fit_jointly(simulator, state, base, until=Until(iterations=6))
    monkeypatch.setattr(Scale, 'of', lambda *_: 1.0)
    apart = fit_jointly(simulator, state, base, until=Until(iterations=6))
    squares = [float(np.mean(fitted.e**2)) for fitted in (together, apart)]
    assert squares[0] < 1e-3 * squares[1], squares
    (gain,) = together.state.effects[0].values[0]['gain']
    assert abs(gain + 0.3) < 0.002


def test_what_only_adds_is_no_scale():
    model = SimulatedStage.load('paper').model
    t = np.arange(30_000) / RATE
    # half a period of slow motion, which a drift of its length is like
    v = 4.8 * (1.0 - np.cos(2.0 * np.pi * t / 3.0)) + 0.15 * (1.0 - np.cos(40.0 * t))
    true = {'amplitude': -0.2, 'time_constant': 0.3}
    y = replace(model, effects=(EffectSetting('thermal_drift', true),)).simulate(v)
    simulator = Simulator(model, make_rows(model, [Record.from_arrays(v, y, sample_rate=RATE)]))
    law = HysteresisLaw('plays', base_thresholds(1.0))
    state, base = fit_base(simulator, State(model.hysteresis, np.zeros(1)), law)
    start = find_effect('thermal_drift').check({'amplitude': 0.0, 'time_constant': 1.0})
    fitted = fit_jointly(simulator, state.with_effect(Added('thermal_drift', (start,))), base)
    found = fitted.state.effects[0].values[0]
    assert abs(found['amplitude'] + 0.2) < 0.01, found
    assert abs(found['time_constant'] - 0.3) < 0.02, found


def test_a_step_promises_what_a_linear_model_gains():
    rng = np.random.default_rng(3)
    columns, moving, e = rng.normal(size=(300, 4)), rng.normal(size=(300, 2)), rng.normal(size=300)
    one = BaseColumns(columns, np.empty(0), columns.T @ columns)
    step = FitStep(one, moving, e, np.zeros(6))
    for damping in (0.0, 0.1, 3.0):
        delta = step.solve(np.full(6, -np.inf), np.full(6, np.inf), damping)
        left = e - np.column_stack([columns, moving]) @ delta
        assert step.gain(delta) == pytest.approx(e @ e - left @ left, rel=1e-9)


def test_damping_follows_what_came_true():
    assert next_damping(1.0) < next_damping(0.5) == 1.0 < next_damping(0.1)


STATES = [State(SimulatedStage.load('paper').model.hysteresis, np.full(1, k)) for k in range(5)]


def test_starts_are_fitted_each_by_itself_and_come_back_in_order():
    simulator, _, _ = crept(0.01)
    used = dict[int, int]()

    def fit(own, state, alive):
        number = int(state.offsets[0])
        # nothing else uses it
        assert used.setdefault(id(own), threading.get_ident()) == threading.get_ident()
        alive()
        if number == 1:
            raise ModelError('cannot run')
        if number == 3:
            raise IdentificationError('singular')
        return number

    found = fit_states(simulator, STATES, fit, lambda: None)
    assert [found[k] for k in (0, 2, 4)] == [0, 2, 4]
    # a fit that fails leaves the others alone
    assert found[1] is None and found[3] is None


def test_fits_side_by_side_can_be_cancelled():
    simulator, _, _ = crept(0.01)
    ends = list[str]()

    def fit(own, state, alive):
        try:
            while True:
                alive()
                time.sleep(0.001)
        except Cancelled:
            ends.append('stopped')
            raise

    def tick():
        raise Cancelled('enough')

    with pytest.raises(Cancelled, match='enough'):
        fit_states(simulator, STATES, fit, tick)
    # all have ended by then
    assert len(ends) == len(simulator.copies(len(STATES)))


def test_derivatives_that_an_effect_knows_are_those_of_the_whole():
    simulator, state, _ = crept(0.01)
    values = {
        'gain': 1e-4,
        'exponent': 0.8,
        'levelling': 0.01,
        'cutoff': 700.0,
        'stretch': 2e-3,
        'lead': 5e-5,
        'lead_stretch': 1e-3,
    }
    effect = find_effect('rate_dependent_hysteresis')
    state = state.with_effect(Added(effect.name, (effect.check(values),)))
    simulator.remember(state)
    wanted = [(0, 'gain'), *((1, name) for name in values)]
    slopes = simulator.sloped([*wanted, (None, 'retuning')])
    # creep stands behind H
    assert sorted(slopes) == list(range(1, 8))
    whole = Simulator(simulator.model, simulator.rows)
    for j, (place, name) in enumerate(wanted):
        if place == 0:
            continue
        near = 1e-5 * values[name]
        up, down = (
            whole.run(moved(state, name, values[name] + change)) for change in (near, -near)
        )
        difference = (up - down) / (2.0 * near)
        rest = np.linalg.norm(slopes[j] - difference)
        assert rest < 2e-3 * np.linalg.norm(difference), name


def moved(state: State, name: str, value: float) -> State:
    """Return a state in which a number of the last effect is another one."""
    *others, last = state.effects
    return replace(state, effects=(*others, last.changed(None, name, None, value)))
