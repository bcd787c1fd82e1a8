# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Further channels beside a misfit of the hysteresis: coupled ones are found, others are not."""

import numpy as np
from piezo_ident.record.record import Piece
from piezo_ident.residual.beyond_drive import channel_tests, without_channels, without_drive
from piezo_ident.residual.lines import find_lines
from piezo_ident.residual.stretches import all_stretches, ResidualPart
import pytest
from residual_stages import drives, foreign, RATE
from scipy.signal import lfilter

STROKE = 75e-6
DRIVES = drives()


def part_of(drive: str, added, channels: dict[str, np.ndarray]) -> ResidualPart:
    v = DRIVES[drive]
    y, y_hat = foreign(v, np.random.default_rng(2))
    e = y + added - y_hat
    piece = Piece(v, STROKE * (y + added), RATE, channels=channels)
    return ResidualPart('r', piece, STROKE * e)


def stages(drive: str, *, added=0.0, **channels: np.ndarray):
    part = part_of(drive, added, channels)
    return {test.channel: test for test in channel_tests([part])}


def others(n: int) -> dict[str, np.ndarray]:
    """Signals that no drive made."""
    rng = np.random.default_rng(3)
    t = np.arange(n) / RATE
    levels = np.repeat(rng.uniform(0, 10, n // 400 + 1), 400)[:n]
    return {
        'raster': np.abs((7.3 * t) % 1 * 2 - 1),
        'sine': np.sin(2 * np.pi * 3.1 * t),
        'levels': lfilter([0.1], [1, -0.9], levels),
        'noise': rng.standard_normal(n),
        'temperature': 22 + np.cumsum(rng.standard_normal(n)) / n,
    }


@pytest.mark.parametrize('drive', DRIVES)
def test_unrelated_channels_and_copies_of_the_drive_mean_nothing(drive):
    v = DRIVES[drive]
    rng = np.random.default_rng(4)
    copies = {
        'monitor': 0.1 * v + 1e-3 * rng.standard_normal(v.size),
        'filtered': lfilter([0.02], [1, -0.98], v),
        'sensor': foreign(v, rng)[0],
        'rest': np.ones(v.size),
    }
    found = stages(drive, **copies, **others(v.size))
    assert [test.channel for test in found.values() if test.significant] == []
    assert not any(found[name].added for name in copies)


@pytest.mark.parametrize('drive', DRIVES)
def test_another_axis_is_found_under_a_misfit(drive):
    size = 7e-4
    other = others(DRIVES[drive].size)['raster']
    moved = lfilter([0.3], [1, -0.7], other)
    moved = size * (moved - moved.mean()) / moved.std()
    test = stages(drive, added=moved, other=other)['other']
    assert test.significant
    assert np.std(test.added[0]) == pytest.approx(size * STROKE, rel=0.35)


def test_lines_of_another_axis_are_no_hum():
    t = np.arange(DRIVES['sines'].size) / RATE
    other = np.sin(2 * np.pi * 61.3 * t)
    part = part_of('sines', 3e-3 * lfilter([0.3], [1, -0.7], other), {'other': other})
    assert find_lines([part], all_stretches([part])).lines
    (left,) = without_channels([part], channel_tests([part]))
    assert find_lines([left], all_stretches([left])).lines == ()


def test_what_voltage_and_displacement_of_an_axis_both_tell_is_taken_out_once():
    n = DRIVES['sines'].size
    other = np.sin(2 * np.pi * 61.3 * np.arange(n) / RATE)
    added = 3e-3 * other
    both = part_of('sines', added, {'v_b': 5.0 * other, 'y_b': 1e-6 * other})
    tests = channel_tests([both])
    assert [test.significant for test in tests] == [True, True]
    # a displacement is no cause
    assert [test.tells for test in tests] == [True, False]
    (left,) = without_channels([both], tests)
    # taken out twice, as much as there was is left
    alone = part_of('sines', 0.0, {})
    assert np.std(left.e - alone.e) < 0.1 * STROKE * np.std(added)


def test_functions_of_the_drive_and_their_lags_are_taken_out():
    v = np.random.default_rng(5).standard_normal(2000)
    lag = np.exp(-2 * np.pi * 10.0 / RATE)
    slow = lfilter([1 - lag], [1, -lag], v - v[0]) + v[0]
    use = np.ones(v.size, bool)
    for e in (v, v**2, v**3, np.diff(v, prepend=v[0]), np.diff(v, 2, prepend=[v[0]] * 2), slow):
        assert np.std(without_drive(e, v, RATE, use)) < 5e-3 * np.std(e)
    other = np.random.default_rng(6).standard_normal(v.size)
    assert np.std(without_drive(other, v, RATE, use)) > 0.9


def test_too_little_data():
    piece = Piece(np.arange(100.0), np.arange(100.0), RATE, channels={'x': np.arange(100.0)})
    (test,) = channel_tests([ResidualPart('r', piece, np.ones(100))])
    assert not test.significant
    assert test.added == ()
    assert not test.tells
