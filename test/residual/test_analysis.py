# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The whole analysis: dependence, tables, faults met first, time, and pictures that draw."""

from pathlib import Path
import time

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.excitation.program import Program
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.record import Piece
from piezo_ident.residual import analyse, ResidualPart
import pytest
from residual_data import creep, misfit, part_of, RATE, T, V

CONFIG = Path(__file__).resolve().parents[2] / 'config'


def noise(seed: int = 0) -> np.ndarray:
    return 2e-9 * np.random.default_rng(seed).standard_normal(V.size)


@pytest.fixture(scope='module')
def survey():
    """Return the survey of the stage of the paper, with creep that nobody told the model."""
    stage = SimulatedStage.load(CONFIG / 'stage_paper.yaml')
    sequence = Program.load(CONFIG / 'program_survey.yaml').build()
    read = stage.play(sequence, np.random.default_rng(1)).pieces[0]
    y = stage.ideal.play(sequence).pieces[0].y
    hidden = creep(read.v, 20_000.0)
    piece = Piece(read.v, read.y + hidden, 20_000.0, 0.0, read.segments)
    started = time.process_time()
    found = analyse([ResidualPart('survey', piece, piece.y - y)])
    return found, time.process_time() - started


def test_survey_with_creep(survey):
    found, seconds = survey
    assert found.faults == ()
    assert found.lines.lines == ()
    # 1.5 nm of noise behind a converter of 2.29 nm
    assert found.floor.rms == pytest.approx(np.hypot(1.5e-9, 2.289e-9 / np.sqrt(12)), rel=0.03)
    assert found.explainable > 0.999
    curve = found.curve('time since the step')
    assert curve.share > 0.8
    assert curve.per_decade > 5 * curve.per_decade_std
    # steps of 2.5 V and three relaxations of 0.1 um/V: 0.75 um, and earlier steps still go on
    assert 0.5e-6 < curve.mean[-1] < 1.2e-6
    assert {row.segment for row in found.segments} >= {'sine:first', 'staircase', 'multisine:1'}
    assert [row.frequency for row in found.frequencies] == [1.0, 1.0, 80.0, 80.0]
    # 60 s at 20 kHz; 1.1 s alone on one core
    assert seconds < 4.0


def test_nothing_but_noise_depends_on_nothing():
    found = analyse([part_of(noise())])
    assert found.explainable < 0.03
    assert all(c.share < 0.03 for c in found.curves)
    assert not any(c.related for c in found.correlations)
    curve = found.curve('v', 'up')
    # the standard deviations are honest: most points lie within two of zero
    assert np.mean(np.abs(curve.mean) < 2.5 * curve.std) > 0.8


def test_dependence_on_voltage_and_direction():
    direction = np.sign(np.gradient(V))
    found = analyse([part_of(noise() + 1e-8 * np.cos(V) + 5e-9 * direction)])
    up, down = found.curve('v', 'up'), found.curve('v', 'down')
    assert up.share > 0.8
    np.testing.assert_allclose(up.mean, 1e-8 * np.cos(up.x) + 5e-9, atol=3e-9)
    np.testing.assert_allclose(down.mean, 1e-8 * np.cos(down.x) - 5e-9, atol=3e-9)


def test_dependence_on_speed():
    speed = np.gradient(V) * RATE
    found = analyse([part_of(noise() + 1e-11 * speed)])
    curve = found.curve('dv/dt', 'up')
    assert curve.share > 0.6
    # only the slope over the bins counts: within one the speed varies
    assert np.polyfit(curve.x, curve.mean, 1)[0] == pytest.approx(1e-11, rel=0.05)


def test_creep_is_straight_over_the_logarithm_of_time():
    v = np.repeat([0.0, 5.0, 10.0, 2.0, 7.0, 3.0], 6000)
    step = np.repeat(np.diff(v[::6000], prepend=0.0), 6000)
    since = np.tile(np.arange(6000) + 1.0, 6) / RATE
    e = 1e-9 * step * np.log10(since * RATE) + noise()[0]
    part = ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)
    curve = analyse([part]).curve('time since the step')
    # 1 nm a volt and decade, and the largest step has 8 V
    assert curve.per_decade == pytest.approx(8e-9, rel=0.05)
    assert curve.share > 0.98


def test_tables_are_those_of_a_hand_calculation():
    e = noise() + misfit(V)
    found = analyse([part_of(e)])
    part = found.parts[0]
    stroke = np.ptp(part.piece.y)
    row = next(r for r in found.segments if r.segment == 'sine:1Hz')
    own = e[2000:8000]
    assert row.percent == pytest.approx(100 * np.sqrt(np.mean(own**2)) / stroke)
    assert row.mean == pytest.approx(own.mean())
    assert sum(r.share for r in found.segments) == pytest.approx(1.0)
    assert row.explainable == pytest.approx(1 - found.floor.rms**2 / np.mean(own**2))
    assert found.percent == pytest.approx(100 * np.sqrt(np.mean(e**2)) / stroke)
    sine = next(r for r in found.frequencies if r.frequency == 50.0)
    # the first second of 1.5 is dropped
    late, y = e[10_000:11_000], part.piece.y[10_000:11_000]
    assert sine.percent == pytest.approx(100 * np.sqrt(np.mean(late**2)) / np.ptp(y))
    assert sine.n == 1000


def test_outliers_do_not_reach_the_floor_nor_lines_the_noise():
    rng = np.random.default_rng(1)
    e = noise() + 1e-8 * np.sin(2 * np.pi * 50.03 * T)
    e[rng.choice(V.size - 40, 20, replace=False) + 20] += 1e-5
    found = analyse([part_of(e)])
    assert {f.name for f in found.faults} == {'outliers'}
    assert found.bad[0].sum() >= 18
    assert found.floor.rms == pytest.approx(2e-9, rel=0.1)
    (line,) = found.lines.lines
    assert line.frequency == pytest.approx(50.03, abs=0.002)
    # the hum can be explained, the outliers neither can nor count
    assert found.explainable == pytest.approx(1 - 4e-18 / (4e-18 + 0.5e-16), abs=0.03)


def test_inputs_are_left_alone_and_work_can_be_stopped():
    e = noise()
    part = part_of(e)
    kept = e.copy()
    shares = []
    analyse([part], shares.append)
    np.testing.assert_array_equal(part.e, kept)
    assert shares == sorted(shares)

    def stop(share: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        analyse([part], stop)


def test_without_sound_samples_there_is_nothing_to_look_at():
    part = ResidualPart('r', part_of(noise()).piece, noise(), np.zeros(V.size, bool))
    with pytest.raises(DataError, match='sound'):
        analyse([part])
    with pytest.raises(DataError):
        analyse([])
