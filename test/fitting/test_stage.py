# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The numbers of a stage, and their derivatives against finite differences."""

from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.stage import LEAST_SLOPE, memory_of, PARTS, Stage
from piezo_ident.fitting.stretch import remembered, Stretch
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.operators.play import play_columns
import pytest

RATE = 1000.0
R = np.arange(1, 8) / 8.0


def stage_of(name='plays', creep=True):
    """Return a stage with everything in it, away from its bounds."""
    rng = np.random.default_rng(3)
    law = HysteresisLaw(name, R)
    G = Dynamics([-1.2, 0.6], [0.3, 0.2, -0.1]).normalised()
    one = Stage.linear(law, G, 2, np.full((2, PARTS), 0.5))
    c = np.where(law.lower == 0.0, rng.uniform(0.05, 0.1, law.size), 0.0)
    c[-2:] = 0.05, 0.6
    one = replace(one, coefficients=c, offsets=np.array([0.01, -0.02]))
    if creep:
        one = replace(
            one.with_creep(np.array([0.02, 0.2]), stretches()), creep=np.array([0.01, 0.02])
        )
        one = replace(one, lags=np.array([[0.3, -0.2], [0.1, 0.4]]))
    return one


def stretches():
    rng = np.random.default_rng(1)
    found = []
    for i in range(2):
        u = np.cumsum(rng.standard_normal(600))
        u = (u - u.min()) / np.ptp(u)
        whole = np.ones(u.size, dtype=bool)
        block = np.arange(u.size) // 100 + 6 * i
        found.append(Stretch(u, rng.standard_normal(u.size), whole, block, RATE, i, i))
    return found


@pytest.mark.parametrize('name', ['plays', 'square', 'preisach'])
def test_each_column_is_the_derivative_by_its_value(name):
    one = stage_of(name)
    values = one.values
    for s in stretches():
        columns = list(one.columns(s, one.signals(s)))
        assert len(columns) == values.size
        for j, column in enumerate(columns):
            # G is scaled to gain one in `moved`, and the prediction stays
            step = 1e-6 * np.eye(values.size)[j]
            both = [one.moved(values + sign * step) for sign in (1.0, -1.0)]
            high, low = (m.signals(s)[2] + m.added(s) for m in both)
            expected = (high - low) / 2e-6
            found = np.zeros(s.u.size) if column is None else column
            # by a start: a play may be caught a sample sooner
            tolerance = 2e-2 if j >= values.size - one.starts.size else 2e-6
            np.testing.assert_allclose(found, expected, atol=tolerance * max(1, abs(found).max()))


def test_values_make_the_same_stage_again_and_an_unstable_G_is_refused():
    one = stage_of('preisach')
    again = one.moved(one.values)
    for s in stretches():
        np.testing.assert_allclose(again.signals(s)[2], one.signals(s)[2], atol=1e-12)
    np.testing.assert_allclose(again.values, one.values, atol=1e-12)
    one = stage_of()
    values = one.values
    at = one.law.size + one.creep.size
    values[at : at + 2] = -2.0, 1.5
    with pytest.raises(ModelError):
        one.moved(values)


@pytest.mark.parametrize('name', ['plays', 'square', 'preisach'])
def test_H_rises_behind_every_turning_point_whatever_the_values(name):
    rng = np.random.default_rng(0)
    one = replace(stage_of(name, creep=False), dynamics=Dynamics.unit())
    for _ in range(50):
        moved = one.moved(rng.standard_normal(one.values.size) * 3.0)
        low = rng.uniform(0.0, 0.9)
        u = np.concatenate([[low], low + np.linspace(0.0, 1e-4, 5)])
        w = moved.hysteresis(u, memory_of(low, 1.0, rng.uniform(0, 1, PARTS), R))
        assert np.diff(w[1:]).min() >= 0.9 * LEAST_SLOPE * 2.5e-5


def test_a_wider_law_and_creep_begin_where_the_stage_was():
    one = stage_of(creep=False)
    wide = one.with_law(HysteresisLaw('preisach', R)).with_creep(np.array([0.1]), stretches())
    for s in stretches():
        np.testing.assert_allclose(wide.signals(s)[2], one.signals(s)[2], atol=1e-12)


def test_a_window_begins_with_what_the_plays_remember_of_its_record():
    one, [whole, _] = stage_of(), stretches()
    columns = play_columns(whole.u, R, one.memory(whole))
    for start in (1, 50, 333):
        before = remembered(whole.u[: start + 1])
        assert before.size < 40
        window = replace(whole, u=whole.u[start:], before=before)
        np.testing.assert_allclose(one.memory(window), columns[:, start], atol=1e-12)


def test_a_record_at_rest_begins_as_a_simulation_does():
    one, [rests, moves] = stage_of(creep=False), stretches()
    guesses = np.array([np.zeros(PARTS), np.full(PARTS, 0.5)])
    one = replace(one, guesses=guesses, starts=guesses)
    one = one.with_creep(np.array([0.1]), [rests, moves])
    moved = one.moved(one.values + 0.3)
    assert not moved.starts[0].any() and not moved.lags[0].any()
    assert moved.starts[1].all() and moved.lags[1].all()


def test_a_density_of_all_places_is_smooth_and_one_of_some_is_not():
    law = HysteresisLaw('preisach', R)
    flat, steep = np.zeros(law.size), np.zeros(law.size)
    flat[R.size : R.size + 4], steep[R.size] = 0.25, 1.0
    sizes = [np.linalg.norm(law.roughness(2.0, 0.5) @ c) for c in (flat, steep)]
    assert sizes[0] < 0.5 * sizes[1]
    # the same density in plays is cheaper still: they hold at every place
    plays = np.zeros(law.size)
    plays[: R.size] = flat @ law._parameters[:, : R.size]
    assert np.linalg.norm(law.roughness(2.0, 0.5) @ plays) < sizes[0]
