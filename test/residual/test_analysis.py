# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The whole analysis: dependence, faults met first, and what is too little to look at."""

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.excitation.program import Program
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.record import Piece
from piezo_ident.residual.analysis import analyse
from piezo_ident.residual.stretches import ResidualPart
import pytest
from residual_data import creep, noise, part_of, RATE, T, V


def curves(found, against: str) -> list:
    return [c for c in found.curves if c.against == against]


def test_survey_with_creep_that_the_model_lacks():
    stage = SimulatedStage.load('paper')
    sequence = Program.load('survey').build()
    read = stage.play(sequence, np.random.default_rng(1)).pieces[0]
    y = stage.ideal.play(sequence).pieces[0].y
    piece = Piece(read.v, read.y + creep(read.v, 20_000.0), 20_000.0, 0.0, read.segments)
    found = analyse([ResidualPart('survey', piece, piece.y - y)])
    assert found.lines == ()
    # 1.5 nm of noise behind a converter of 2.29 nm
    assert found.floor.rms == pytest.approx(np.hypot(1.5e-9, 2.289e-9 / np.sqrt(12)), rel=0.03)
    (curve,) = curves(found, 'time since the step')
    # steps of 2.5 V and three relaxations of 0.1 um/V: 0.75 um, and earlier steps still go on
    assert 0.5e-6 < curve.mean[-1] < 1.2e-6


def test_nothing_but_noise_depends_on_nothing():
    found = analyse([part_of(noise())])
    curve = curves(found, 'v')[0]
    # the standard deviations are honest: most points lie within two of zero
    assert np.mean(np.abs(curve.mean) < 2.5 * curve.std) > 0.8


def test_dependence_on_voltage_direction_and_speed():
    direction = np.sign(np.gradient(V))
    up, down = curves(analyse([part_of(noise() + 1e-8 * np.cos(V) + 5e-9 * direction)]), 'v')
    assert (up.branch, down.branch) == ('up', 'down')
    np.testing.assert_allclose(up.mean, 1e-8 * np.cos(up.x) + 5e-9, atol=3e-9)
    np.testing.assert_allclose(down.mean, 1e-8 * np.cos(down.x) - 5e-9, atol=3e-9)
    curve = curves(analyse([part_of(noise() + 1e-11 * np.gradient(V) * RATE)]), 'dv/dt')[0]
    # only the slope over the bins counts: within one the speed varies
    assert np.polyfit(curve.x, curve.mean, 1)[0] == pytest.approx(1e-11, rel=0.05)


@pytest.mark.parametrize(('periods', 'least', 'most'), [(2, 0, 2), (3, 20, 24)])
def test_a_point_of_a_curve_has_three_visits(periods, least, most):
    v = np.tile(np.append(np.arange(200.0), np.arange(200.0, 0.0, -1.0)), periods)
    e = 1e-9 * np.random.default_rng(3).standard_normal(v.size)
    up, down = curves(analyse([ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)]), 'v')
    # each way takes 0.1 s: two stretches of time, which share a bin of the 24
    assert least <= up.x.size <= most
    assert least <= down.x.size <= most


def test_creep_is_straight_over_the_logarithm_of_time():
    v = np.repeat([0.0, 5.0, 10.0, 2.0, 7.0, 3.0], 6000)
    step = np.repeat(np.diff(v[::6000], prepend=0.0), 6000)
    since = np.tile(np.arange(6000) + 1.0, 6) / RATE
    e = 1e-9 * step * np.log10(since * RATE) + noise()[0]
    (curve,) = curves(
        analyse([ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)]), 'time since the step'
    )
    # 1 nm a volt and decade, and the largest step has 8 V
    late = curve.x > 10 / RATE
    slope = np.polyfit(np.log10(curve.x[late]), curve.mean[late], 1)[0]
    assert slope == pytest.approx(8e-9, rel=0.05)


def test_outliers_do_not_reach_the_floor_nor_lines_the_noise():
    rng = np.random.default_rng(1)
    e = noise() + 1e-8 * np.sin(2 * np.pi * 50.03 * T)
    e[rng.choice(V.size - 40, 20, replace=False) + 20] += 1e-5
    kept = e.copy()
    found = analyse([part_of(e)])
    assert found.floor.rms == pytest.approx(2e-9, rel=0.1)
    (line,) = found.lines
    assert line.frequency == pytest.approx(50.03, abs=0.002)
    np.testing.assert_array_equal(e, kept)


def test_without_sound_samples_there_is_nothing_to_look_at():
    part = ResidualPart('r', part_of(noise()).piece, noise(), np.zeros(V.size, bool))
    for parts in ([part], []):
        with pytest.raises(DataError, match='sound'):
            analyse(parts)
