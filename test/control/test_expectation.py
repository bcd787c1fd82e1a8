# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What is expected of a stage, beside what it then does, and what of that stops a drive."""

from dataclasses import replace
import re

import numpy as np
from paper_stage import FS, PAPER, with_mode
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.control.expectation import HOLD, RISE
from piezo_ident.model.stage_model import EffectSetting
import pytest

CREEP = EffectSetting('creep', {'gain': [0.01, 0.01, 0.01], 'time_constant': [0.1, 1.0, 10.0]})
KNOWN = {'errors': {'held_out': 0.02, 'worst': 0.05}}
CREEPS = replace(PAPER, effects=(CREEP,), identification=KNOWN)


def played(stage, drive):
    """Return the displacement of a stage that came from its lowest voltage and waited."""
    way = np.pad(np.linspace(0.0, drive.v[0], round(RISE * FS)), (0, round(HOLD * FS)), 'edge')
    return stage.simulate(np.append(way, drive.v))[way.size + drive.lead :]


def scan(start, size, frequency=5.0, seconds=1.0):
    """Return a raised cosine [m]."""
    t = np.arange(round(seconds * FS)) / FS
    return start + 0.5 * size * (1.0 - np.cos(2.0 * np.pi * frequency * t))


def test_a_record_of_slow_motion_promises_nothing_of_fast_motion():
    v = np.tile(np.concatenate([np.linspace(0, 8, 10_000), np.linspace(8, 0, 10_000)]), 3)
    y = PAPER.simulate(v) + np.random.default_rng(0).normal(0.0, 2e-9, v.size)
    model = pi.identify(pi.Record.from_arrays(v, y, sample_rate=FS)).model
    wanted = scan(10e-6, 30e-6, frequency=50.0)
    drive = pi.invert(model, wanted)
    assert np.std(PAPER.simulate(drive.v)[drive.lead :] - wanted) > 20.0 * drive.expected_rms
    assert any('steps or noise' in text for text in drive.warnings)


@pytest.mark.parametrize(('start', 'size'), [(40e-6, 1e-6), (10e-6, 40e-6), (2e-6, 10e-6)])
def test_where_a_stage_is_that_creeps_is_promised_beside_its_shape(start, size):
    wanted = scan(start, size)
    drive = pi.invert(CREEPS, wanted)
    e = played(CREEPS, drive) - wanted
    assert drive.expected_offset == pytest.approx(e.mean(), rel=0.05, abs=2e-9)
    # no less than the model errs by elsewhere, and what creeps on is in it
    assert drive.expected_rms > max(0.0005 * 75e-6, 0.99 * e.std())
    assert drive.expected_rms < 2.0 * max(0.0005 * 75e-6, e.std())
    # it is told where it is more than the stage errs by anyhow
    assert bool(drive.warnings) == (abs(e[0]) > 0.0005 * 75e-6)
    assert f'{1e9 * abs(e.mean()):.0f}'[0] in repr(drive)


def test_a_stage_that_is_sampled_slowly_has_a_way_to_its_motion():
    slow = replace(CREEPS, sample_rate=2.0)
    drive = pi.invert(slow, 30e-6 + 1e-6 * np.sin(np.arange(40.0)))
    # it begins long before
    assert abs(drive.expected_offset) < 1e-9


def test_a_model_without_creep_does_not_tell_where_a_stage_is():
    drive = pi.invert(replace(PAPER, identification=KNOWN), scan(40e-6, 1e-6))
    assert drive.expected_offset is None and 'no creep' in repr(drive)
    assert drive.expected_rms == pytest.approx(0.0005 * 75e-6)


def test_corners_above_a_mode_are_in_what_is_expected():
    t = np.arange(4000) / FS
    wanted = 10e-6 + 40e-6 * (1.0 - np.abs(2.0 * ((100.0 * t) % 1.0) - 1.0))
    drive = pi.invert(replace(with_mode(700.0), identification=KNOWN), wanted)
    e = played(with_mode(730.0), drive) - wanted
    assert 5.0 * 0.0005 * 75e-6 < e.std() < 1.5 * drive.expected_rms
    (told,) = drive.warnings
    assert re.match(r'\S+ % of the motion lie above 700 Hz', told)


def test_a_motion_that_dips_below_rest_by_less_than_the_stage_errs_by_is_made():
    rest = float(PAPER.simulate([0.0, 0.0])[0])
    known = replace(PAPER, identification=KNOWN)
    dips = scan(rest, 40e-6) - 13e-9
    with pytest.raises(DataError, match=r'raise .* 0\.013 um'):
        pi.invert(PAPER, dips)
    assert not pi.invert(PAPER, dips + 13e-9).clipped.any()
    drive = pi.invert(known, dips)
    assert drive.clipped.any() and ' 0 .. 10 V: by up to 0.013 um' in drive.warnings[0]
    assert np.abs(drive.predicted - drive.wanted).max() < 14e-9
    # more than the stage errs by, or much of a small motion
    for refused, by in ((dips - 50e-9, 0.063), (scan(rest, 0.4e-6) - 13e-9, 0.013)):
        with pytest.raises(DataError, match=f'raise .* {by} um'):
            pi.invert(known, refused)


def test_a_motion_beyond_a_limit_is_told_by_how_much_to_move_it_and_a_jump_is_called_that():
    high = scan(30e-6, 50e-6)
    with pytest.raises(DataError, match=r'lower .* \d\S* um') as refused:
        pi.invert(PAPER, high)
    by = float(re.search(r'lower .* (\S+) um', str(refused.value))[1])
    assert not pi.invert(PAPER, high - 1e-6 * by).clipped.any()
    wanted = np.where(np.arange(4000) < 2000, 20e-6, 60e-6)
    with pytest.raises(DataError, match=r'samples .* jumps .* 600 Hz'):
        pi.invert(with_mode(600.0), wanted)
