# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A voltage that was measured: its noise is no motion."""

from dataclasses import replace
import warnings

import numpy as np
import piezo_ident as pi
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
import pytest

FS = 10_000.0
T = np.arange(40_000) / FS
#: rests, a slow triangle, a fast sine and a rest [V]
COMMAND = np.concatenate(
    [
        np.full(10_000, 20.0),
        np.interp(T[:15_000], [0.0, 0.75, 1.5], [20.0, 120.0, 20.0]),
        70.0 - 50.0 * np.cos(2 * np.pi * 120 * T[:10_000]),
        np.full(5_000, 20.0),
    ]
)


def record(v):
    return pi.Record.from_arrays(v, 1e-7 * v, sample_rate=FS, name='monitor')


def noisy(size, seed=0):
    return COMMAND + size * np.random.default_rng(seed).standard_normal(COMMAND.size)


def path(v):
    return np.abs(np.diff(v)).sum()


@pytest.mark.parametrize('size', [2e-3, 0.02, 0.05])
def test_noise_of_a_monitor_is_taken_out_where_the_voltage_is_quiet(size):
    found = with_quiet_voltage(record(noisy(size)))
    (piece,) = found.pieces
    still, slow, fast = slice(0, 10_000), slice(10_000, 25_000), slice(26_000, 34_000)
    assert path(piece.v[still]) < 0.02 * path(noisy(size)[still])
    assert path(piece.v[slow]) == pytest.approx(200.0, abs=20 * size)
    assert np.abs(piece.v - COMMAND).max() < 8 * size
    # only its turns are within the noise
    assert np.mean(piece.v[fast] == noisy(size)[fast]) > 0.7
    (fault,) = (fault for fault in found.faults if fault.name == 'voltage_noise')
    told = float(fault.where.removeprefix('of ').partition(' mV')[0])
    assert told == pytest.approx(1e3 * size, rel=0.1)
    assert with_quiet_voltage(found) is found


@pytest.mark.parametrize(
    'v',
    [
        COMMAND,
        # steps of a converter of 12 bits
        np.round(COMMAND / 0.05) * 0.05,
        # a motion that is random
        70.0 + 10.0 * np.random.default_rng(0).standard_normal(COMMAND.size),
        np.full(COMMAND.size, 5.0),
        COMMAND[:100],
        # a small sine, and a small dither, after a slow motion
        np.concatenate([np.linspace(0, 50, 4000), 50 + 0.02 * np.sin(2 * np.pi * 1000 * T)]),
        COMMAND + 0.005 * np.sin(2 * np.pi * 2000 * T),
    ],
)
def test_a_command_stays_as_it_is(v):
    one = record(v)
    assert with_quiet_voltage(one) is one


def test_a_prediction_from_a_monitor_is_that_from_the_command():
    stage = pi.SimulatedStage.load('effects').model
    lags = [[4.0, 0.3, 0.0, 0.0], [16.0, -0.2, 0.1, 0.0]]
    model = replace(stage, hysteresis=replace(stage.hysteresis, relaxations=lags))
    v = np.concatenate([np.interp(T, [0, 1, 2, 4], [0, 8, 4, 4]), np.linspace(4, 0, 20_000)])
    y = model.simulate(v)
    noise = 2e-3 * np.random.default_rng(1).standard_normal(v.size)
    one = pi.Record.from_arrays(v + noise, y, sample_rate=stage.sample_rate, name='monitor')
    error = pi.free_run(model, one).errors.percent
    raw = 100 * np.sqrt(np.mean((model.simulate(v + noise) - y) ** 2)) / np.ptp(y)
    assert error < 0.1
    assert raw > 10 * error


def test_slow_motion_does_not_lag_behind_in_one_direction():
    v = 70.0 - 50.0 * np.cos(2 * np.pi * T)
    noise = 0.02 * np.random.default_rng(2).standard_normal(v.size)
    (piece,) = with_quiet_voltage(record(v + noise)).pieces
    off, up = piece.v - v, np.sin(2 * np.pi * T) > 0.2
    down = np.sin(2 * np.pi * T) < -0.2
    # three deviations either way for a play alone
    assert abs(off[up].mean() - off[down].mean()) < 0.5 * 0.02


def test_a_small_motion_beside_a_noisy_piece_was_played():
    small = 20.0 + 0.02 * np.sin(2 * np.pi * 50 * T)
    pieces = tuple(record(v).pieces[0] for v in (noisy(0.02), small))
    both = pi.Record(pieces, 'both')
    assert with_quiet_voltage(both) is both


def test_windows_that_rest_or_move_and_are_nothing_between_are_no_noise():
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        # a tenth of the windows rest, and the next one moves
        v = np.concatenate([np.full(1150, 1.0), 5 + np.cumsum(np.sin(np.arange(9400) ** 1.5))])
        one = record(v)
        assert with_quiet_voltage(one) is one


@pytest.mark.parametrize('band', [(2600,), (4000,), range(2600, 4900, 10)])
def test_a_dither_that_was_played_is_no_noise(band):
    phase = np.random.default_rng(0).uniform(0.0, 6.3, len(band))
    dither = sum(np.sin(2 * np.pi * f * T + p) for f, p in zip(band, phase, strict=True))
    v = 70.0 - 50.0 * np.cos(2 * np.pi * T) + 0.01 * dither / dither.std()
    assert with_quiet_voltage(record(v)).faults == ()
