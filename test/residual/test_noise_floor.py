# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The noise floor: rest and repeats are found, and noise is separated from creep and misfit."""

from itertools import pairwise

import numpy as np
from numpy.testing import assert_array_equal
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Piece
from piezo_ident.residual.noise_floor import residual_noise_floor
from piezo_ident.residual.stretches import block_means, find_repeats, ResidualPart, stretches_of
import pytest
from residual_data import creep, misfit, part_of, pink, RATE, V
from scipy.signal import lfilter


def test_stretches_of_a_program_are_found_and_repeats_without_labels():
    found = [(s.kind, s.period) for s in stretches_of(part_of(np.zeros(V.size)))]
    # rest, 1 Hz, 50 Hz (40 samples at 2 kHz), noise; four holds start with their first sample
    assert found[:4] == [('rest', 0), ('repeat', 2000), ('repeat', 40), ('motion', 0)]
    assert found[4:8] == [('rest', 0)] * 4
    unlabelled = stretches_of(part_of(np.zeros(V.size), labelled=False))
    assert {2000, 40} <= {s.period for s in unlabelled}
    assert all(one.stop <= two.start for one, two in pairwise(unlabelled))


def test_a_measured_voltage_still_rests_and_repeats():
    rng = np.random.default_rng(0)
    part = part_of(np.zeros(V.size))
    piece = Piece(
        V + 1e-3 * rng.standard_normal(V.size), part.piece.y, RATE, 0, part.piece.segments
    )
    found = stretches_of(ResidualPart('r', piece, part.e))
    assert {s.period for s in found if s.kind == 'repeat'} == {2000, 40}
    assert sum(s.kind == 'rest' for s in found) == 5


def test_a_period_that_is_no_whole_number_repeats_after_several():
    # 120 Hz at 20 kHz: 166.7 samples, exactly 500 for three periods
    v = np.sin(2 * np.pi * 120 * np.arange(6000) / 20_000)
    ((start, stop, period),) = find_repeats(v)
    assert (start, period) == (0, 500)
    assert stop == 6000


def test_repeats_of_two_periods_meet_and_do_not_overlap():
    tooth = np.concatenate([np.arange(20.0), np.arange(20.0, 0.0, -1.0)])
    v = np.concatenate([np.tile(tooth, 10), np.tile(np.append(tooth, np.zeros(20)), 10)])
    found = find_repeats(v)
    # the first tooth of the later repeat still belongs to the repeat before it
    assert [(start, stop) for start, stop, _ in found] == [(0, 441), (441, 1000)]
    for start, stop, period in found:
        assert_array_equal(v[start + period : stop], v[start : stop - period])
    # a wave of 0.2 % makes three teeth the period, which also fits the teeth without the wave
    v = np.tile(tooth, 40)
    v[400:] += 0.038 * np.cos(2 * np.pi * np.arange(1200) / 120)
    assert find_repeats(v) == [(0, 440, 40), (440, 1600, 120)]


def test_nothing_repeats_where_nothing_comes_back():
    t = np.arange(20_000) / 2000
    chirp, noise = (
        np.sin(2 * np.pi * (1 + t) * t),
        np.random.default_rng(1).standard_normal(20_000),
    )
    for v in (np.linspace(0, 1, 5000), np.zeros(100), np.ones(5), chirp, noise):
        assert find_repeats(v) == []


@pytest.mark.parametrize('with_misfit', [False, True])
def test_white_noise_is_measured_through_misfit_and_creep(with_misfit):
    rng = np.random.default_rng(2)
    noise = 2e-9 * rng.standard_normal(V.size)
    part = part_of(noise + with_misfit * (misfit(V) + creep(V, RATE)))
    floor = residual_noise_floor([part], stretches_of(part))
    assert 'repeated periods' in floor.source
    assert floor.rms == pytest.approx(2e-9, rel=0.05)
    # of 64 samples there are 31 means in the one period that is not dropped
    for m, rel in ((4, 0.1), (16, 0.2), (64, 0.35)):
        assert floor.at(m) == pytest.approx(2e-9 / np.sqrt(m), rel=rel)


def test_coloured_noise_after_averaging():
    rng = np.random.default_rng(3)
    noise = 2e-9 * pink(V.size, rng)
    part = part_of(noise + misfit(V))
    floor = residual_noise_floor([part], stretches_of(part))
    # what is slower than a period looks like drift: the floor may be lower, not higher
    for m in (1, 16, 64):
        truth = np.std(block_means(noise, m))
        assert 0.5 * truth < floor.at(m) < 1.1 * truth


def test_rests_serve_where_nothing_repeats():
    rng = np.random.default_rng(4)
    v = np.repeat(rng.uniform(0, 10, 8), 4000)
    e = creep(v, RATE) + 2e-9 * rng.standard_normal(v.size)
    part = ResidualPart('r', Piece(v, 7e-6 * v + e, RATE), e)
    floor = residual_noise_floor([part], stretches_of(part))
    assert 'rests' in floor.source
    assert floor.rms == pytest.approx(2e-9, rel=0.1)
    assert floor.at(16) == pytest.approx(0.5e-9, rel=0.35)


@pytest.mark.parametrize('decay', [0.05, 0.5, np.inf])
@pytest.mark.parametrize('kind', ['white', 'pink'])
@pytest.mark.parametrize('n, size', [(12_000, 2e-8), (1_200, 2e-7)])
def test_a_stage_that_rings_at_its_rests_is_no_noise(decay, kind, n, size):
    rng, rate = np.random.default_rng(8), 20_000.0
    noise = 2e-9 * (rng.standard_normal(n) if kind == 'white' else pink(n, rng))
    t = np.arange(n) / rate
    ringing = size * np.cos(2 * np.pi * 731.3 * t) * np.exp(-t / decay)
    piece = Piece(np.zeros(n), noise, rate)
    part = ResidualPart('r', piece, noise + ringing)
    floor = residual_noise_floor([part], stretches_of(part))
    assert 'rests' in floor.source
    assert 0.67 < floor.rms / np.std(noise) < 1.5


def test_floor_is_unknown_without_either():
    rng = np.random.default_rng(5)
    v = np.cumsum(rng.standard_normal(5000))
    slow = lfilter([0.5], [1.0, -0.5], rng.standard_normal(5000))
    part = ResidualPart('r', Piece(v, v, RATE), slow)
    floor = residual_noise_floor([part], stretches_of(part))
    assert floor.rms is None
    assert floor.at(4) is None
    assert floor.source.startswith('floor unknown')


def test_a_residual_that_is_white_throughout_is_noise():
    rng = np.random.default_rng(5)
    v, e = np.cumsum(rng.standard_normal(5000)), 2e-9 * rng.standard_normal(5000)
    sound = rng.random(5000) > 0.1
    e[~sound] = 1.0
    part = ResidualPart('r', Piece(v, v, RATE), e, sound)
    floor = residual_noise_floor([part], stretches_of(part))
    assert floor.rms == pytest.approx(2e-9, rel=0.05)
    assert floor.at(4) == pytest.approx(1e-9, rel=0.05)


def test_a_rest_tells_the_step_that_led_into_it():
    v = np.append(0.0, np.full(999, 5.0))
    (rest,) = stretches_of(ResidualPart('r', Piece(v, v, RATE), np.zeros(1000)))
    assert (rest.kind, rest.start, rest.stop, rest.step) == ('rest', 1, 1000, 5.0)


def test_a_repeat_behind_a_long_rest_is_found():
    # the period is sought in a million samples
    v = np.append(np.zeros(2**20), np.sin(2 * np.pi * np.arange(2**20) / 2**14))
    ((start, stop, period),) = find_repeats(v)
    assert (stop, period) == (2**21, 2**14)
    assert abs(start - 2**20) <= 8


def test_a_lost_sample_lies_on_a_line():
    piece = Piece(np.arange(3.0), np.arange(3.0), RATE)
    part = ResidualPart('r', piece, [0.0, 9.0, 2.0], [True, False, True])
    assert_array_equal(part.e, [0.0, 1.0, 2.0])
    assert_array_equal(part.y_hat, [0.0, 0.0, 0.0])


def test_bridged_samples_are_cut_out():
    e = np.zeros(V.size)
    sound = np.ones(V.size, bool)
    e[3000:3100], sound[3000:3100] = 1e-3, False
    part = ResidualPart('r', part_of(np.zeros(V.size)).piece, e, sound)
    assert all(not (s.start < 3100 and s.stop > 3000) for s in stretches_of(part))


def test_wrong_lengths_and_divergence_are_refused():
    piece = part_of(np.zeros(V.size)).piece
    with pytest.raises(DataError, match=r'r: .*\(3,\).* 20000'):
        ResidualPart('r', piece, np.zeros(3))
    e = np.zeros(V.size)
    e[5] = np.nan
    with pytest.raises(DataError, match='diverge'):
        ResidualPart('r', piece, e)
