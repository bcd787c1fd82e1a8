# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Data in which every number is in order, and something is wrong all the same."""

import numpy as np
from piezo_ident.identification.identify import identify
from piezo_ident.record.faults import line_error, misspelt, suspicions
from piezo_ident.record.record import Piece, Record
import pytest


def triangle(noise=3e-9):
    v = np.tile(np.concatenate([np.linspace(0, 10, 4000), np.linspace(10, 0, 4000)]), 4)
    rng = np.random.default_rng(1)
    return v, 1e-6 * v + noise * rng.standard_normal(v.size)


def test_a_good_record_makes_nobody_suspicious():
    v, y = triangle()
    assert suspicions(Record((Piece(v, y, 1000.0),))) == []
    # a coarse converter repeats its codes while the voltage hardly moves
    assert suspicions(Record((Piece(v, np.round(y / 5e-9) * 5e-9, 1000.0),))) == []
    # a stage at rest under a resting voltage
    rest = Piece(np.full(500, 2.0), np.full(500, 2e-6), 1000.0)
    assert suspicions(Record((Piece(v, y, 1000.0), rest))) == []


def test_sensor_at_its_stop():
    v, y = triangle()
    (said,) = suspicions(Record((Piece(v, np.clip(y, 0.5e-6, None), 1000.0),), 'clipped'))
    assert 'stop' in said
    assert '5e-07' in said


def test_swapped_columns():
    v, _y = triangle()
    hold = np.repeat([2.0, 4.0, 6.0, 3.0], 3000)
    drive = np.concatenate([np.zeros(200), v, hold])
    measured = 1e-6 * drive + 3e-9 * np.random.default_rng(2).standard_normal(drive.size)
    # the measured displacement in the column of the voltage, scaled to look like one
    (said,) = suspicions(Record((Piece(1e6 * measured + 0.1 * drive, 1e-6 * drive, 1000.0),)))
    assert 'swapped' in said


def test_line_error_is_that_of_polyfit():
    v, y = triangle(noise=1e-7)
    slope, offset = np.polyfit(v, y, 1)
    expected = 100 * np.sqrt(np.mean((y - slope * v - offset) ** 2)) / np.ptp(y)
    assert line_error([Piece(v, y, 1000.0)]) == pytest.approx(expected, rel=1e-9)


def test_labels_that_are_nearly_right_are_named():
    assert misspelt(['noise', 'triangl', 'Steps:2', 'segment_0', 'sine:50Hz']) == [
        'triangl (did you mean triangle?)',
        'Steps:2 (did you mean step?)',
    ]


def test_a_model_that_explains_nothing_says_so():
    v, _ = triangle()
    y = 1e-6 * np.random.default_rng(3).standard_normal(v.size)
    found = identify(Record((Piece(v, y, 1000.0),)))
    assert any('explains little' in w for w in found.warnings)
