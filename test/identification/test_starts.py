# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Starts away from the lowest voltage: found with the plays, on a stage that has none."""

from dataclasses import replace
import itertools

import numpy as np
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.starts import fit_starts
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Record
import pytest

N = 24


def relays(u, density=lambda a, b: np.exp(-(a - b) / 0.3)):
    """Return a plane of relays that switch gradually over a cell (Preisach), from u = 0."""
    i, j = np.tril_indices(N)
    weight = density((i + 0.5) / N, (j + 0.5) / N)
    state, out = np.zeros(i.size), np.empty(u.size)
    for k, x in enumerate(u * N):
        up, down = np.clip(x - i, 0.0, 1.0), np.clip(x - j, 0.0, 1.0)
        state = np.maximum(up, np.minimum(state, down))
        out[k] = weight @ state
    return 0.5 * u + 0.5 * out / weight.sum()


def corners(levels, samples):
    pairs = itertools.pairwise(levels)
    return np.concatenate([np.linspace(a, b, samples, endpoint=False) for a, b in pairs])


BEFORE = corners([0.0, 0.65, 0.5], 200)
GROWING = corners([0.5, 0.6, 0.4, 0.7, 0.3, 0.85, 0.15, 1.0, 0.0, 0.5], 700)


def test_start_is_found_on_a_plane_of_relays():
    y = relays(np.concatenate([BEFORE, GROWING]))[BEFORE.size :]
    use = np.ones(y.size, dtype=bool)
    [rule] = fit_starts([Excerpt(GROWING, y, use)], [True])
    r = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    # came from 0 up to 0.65 and down to 0.5: plays up to 0.15 are pushed down, the others hang
    truth = np.minimum(0.5, 0.65 - r)
    np.testing.assert_allclose(rule(r), truth, atol=0.04)
    # a lag of the stage is known to the caller, and must not be taken for memory
    later = np.concatenate([np.full(5, y[0]), y[:-5]])
    [moved] = fit_starts([Excerpt(GROWING, later, use)], [True], 5.0)
    np.testing.assert_allclose(moved(r), rule(r), atol=0.01)


def test_start_of_a_stage_that_came_from_beyond_the_voltage_is_found():
    u = corners([0.0, 0.5, 0.45, 0.55, 0.5, 0.0, 0.33, 0.0, 0.67, 0.0, 1.0, 0.0], 700)
    r = np.linspace(0.025, 0.975, 39)
    truth = -np.minimum(r, 0.1)
    x = 0.5 * u + 0.05 * np.exp(-r / 0.3) @ play_columns(u, r, truth)
    x += 1e-4 * np.random.default_rng(0).standard_normal(u.size)
    # no memory describes how such a stage creeps in the beginning
    x -= 0.01 * np.exp(-np.arange(u.size) / 700.0)
    [rule] = fit_starts([Excerpt(u, x, np.ones(u.size, dtype=bool))], [True])
    # from the memory of a stage that came down the fit ends 0.26 away
    np.testing.assert_allclose(rule(r), truth, atol=0.1)


def test_start_of_a_play_that_never_moves_stays_within_what_is_possible():
    u = corners([0.5, 0.55, 0.45, 0.5], 400)
    [rule] = fit_starts([Excerpt(u, 0.7 * u, np.ones(u.size, dtype=bool))], [True])
    r = np.linspace(0.01, 1.0, 50)
    found = rule(r)
    assert np.all(found <= 0.5)
    assert np.all(found >= 0.5 - r - 1e-12)
    # a line of memory: nowhere steeper than one
    assert np.all(np.diff(found) <= 1e-12)
    assert np.all(np.diff(found) >= -np.diff(r) - 1e-12)


def test_known_starts_are_left_alone():
    e = Excerpt(GROWING, GROWING, np.ones(GROWING.size, dtype=bool))
    assert fit_starts([e], [False]) == [None]


TEXT = """
limits: [-20, 130]
rest: 0
slew: 500
seed: 1
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 55, size: 15, hold: 0.03, count: 10}
  - {signal: settle, bias: 55, amplitude: 7.2, cycles: 12, frequency: 20}
  - {signal: noise, bias: 55, amplitude: 6, cutoff: 1500, duration: 1.0}
  - {signal: triangle, slope: 400}
"""


@pytest.mark.parametrize('rest', [-20, 0])
def test_labelled_programme_from_zero_volts_is_worth_as_much(rest):
    stage = SimulatedStage.load('paper').ideal
    scaling = replace(stage.model.scaling, v0=-20.0, V=150.0, range=(-20.0, 130.0))
    stage = replace(stage, model=replace(stage.model, scaling=scaling))
    record = stage.play(parse_program(TEXT.replace('rest: 0', f'rest: {rest}')).build(20_000.0))
    model = identify(record, Settings(thresholds=10, order=(10, 10))).model
    v = 55.0 - 75.0 * np.cos(2.0 * np.pi * 5.0 * np.arange(8000) / 20_000.0)
    unseen = Record.from_arrays(v, stage.model.simulate(v), sample_rate=20_000.0)
    assert free_run(model, unseen).errors.percent_without_offset < 0.3
