# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Each reason where it is true, and where it must not come."""

from dataclasses import replace

import numpy as np
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident.identification.errors import predictions_of
from piezo_ident.identification.prepare import Excerpt, runs_of, scaling_of
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.step1_delay import DelayResult, StepDelay
from piezo_ident.identification.warnings import (
    only_jumps,
    warn_of_delay,
    warn_of_shape,
    warnings_of,
)
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record
import pytest

FS = 1000.0
T = np.arange(2000) / FS
SINE = 0.5 - 0.5 * np.cos(2.0 * np.pi * T)


def excerpt(u):
    return Excerpt(u, u, np.ones(u.size, dtype=bool))


def test_levels_with_gaps_leave_the_hysteresis_open_and_a_fine_staircase_does_not():
    for count, is_open in ((3, True), (6, True), (25, False)):
        levels = np.linspace(0.0, 1.0, count)
        stairs = np.repeat(np.concatenate([levels, levels[::-1]]), 40)
        said = only_jumps([excerpt(stairs)])
        assert bool(said) == is_open
        if is_open:
            assert f'{1.0 / (count - 1):.0%} of its range' in said
    assert not only_jumps([excerpt(SINE)])


def test_steps_that_were_not_there_do_not_fail_to_rise():
    flat = StepDelay(None, float('inf'), 4, 1e-3, 5e-3, np.arange(3), np.zeros(3))
    risen = replace(flat, samples=3)
    scan = DelayResult(4, 0.5, 'scan', scan=4)
    [no_steps] = warn_of_delay(scan)
    [low] = warn_of_delay(replace(scan, step=flat))
    assert 'no steps' in no_steps
    assert 'rises above' in low
    assert warn_of_delay(replace(scan, step=risen)) == []
    [free] = warn_of_delay(DelayResult(5, 3.0, 'free run', flat))
    assert '5 samples' in free
    # a free run behind H needs no noise and no steps
    for source in ('steps', 'given', 'none'):
        assert warn_of_delay(replace(scan, source=source)) == []


def shape(v, y, y_hat):
    piece = Piece(v, y, FS)
    scaling = scaling_of([piece])
    [run] = runs_of([Record((piece,))], FS, scaling)
    [prediction] = predictions_of(replace(PAPER, sample_rate=FS, scaling=scaling), [run])
    return warn_of_shape([replace(prediction, y_hat=y_hat)], scaling)


def loop(v, width):
    """Return a play of some width, as H has it."""
    return play_columns(v, np.array([width]), v[:1] - 0.5 * width)[0] + 0.5 * width


def test_what_h_cannot_hold_is_told_by_its_size():
    v = 10.0 * np.interp(T, [0.0, 0.5, 1.5, 2.0], [0.0, 1.0, -1.0, 0.0])
    wing = 1e-9 * np.abs(loop(v, 6.0))
    even, ends = shape(v, wing, 0.0 * v)
    assert '% of the displacement is even' in even
    assert int(even.partition('%')[0]) > 80
    assert 'um apart' in ends
    # a model that has the same loop is not blamed for it
    assert len(shape(v, wing, wing)) == 1


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_what_h_holds_is_not_blamed(noise):
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * 2.0 * T)
    y = (
        v
        + loop(v, 3.0)
        + 0.05 * v**2
        + 10.0 * noise * np.random.default_rng(0).standard_normal(T.size)
    )
    assert shape(v, 1e-9 * y, 0.0 * v) == []
    # a drift opens loops, and not towards both ends
    assert shape(v, 1e-9 * (y + 5.0 * T), 0.0 * v) == []
    assert shape(v, -1e-9 * y, 0.0 * v) == []


@pytest.fixture(scope='module')
def linear():
    """Return a stage without hysteresis, and its identification."""
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * 4.0 * T)
    y = 1e-7 * v + 1e-8 * np.random.default_rng(0).standard_normal(v.size)
    record = pi.Record.from_arrays(v, y, sample_rate=FS)
    return record, pi.identify(record, Settings(thresholds=4))


def test_a_line_with_noise_is_explained(linear):
    record, result = linear
    assert not any('explains' in said for said in result.warnings)
    # without a floor it is no better than a line, which explains nearly all
    [said] = [
        said
        for said in warnings_of(replace(result, noise_floor=None), [record], list(record))
        if 'explains' in said
    ]
    assert 'little more than the line' in said
    poor = replace(result, errors=tuple(replace(row, percent=30.0) for row in result.errors))
    assert any('explains little of' in said for said in warnings_of(poor, [record], list(record)))


def test_axes_that_move_too_are_named_and_the_monitor_of_a_resting_one_is_not(linear):
    record, result = linear
    [piece] = record
    noise = 1e-2 * np.random.default_rng(1).standard_normal(piece.n)
    others = {'v_c': np.full(piece.n, 2.0), 'y_b': piece.v, 'heat': piece.v}
    for v_b, is_said in ((noise, False), (50.0 * noise, True), (piece.v[::-1], True)):
        pieces = [replace(piece, channels={'v_b': v_b, **others})]
        said = [x for x in warnings_of(result, [record], pieces) if 'axes' in x]
        assert [x.startswith('v_b moved, too') for x in said] == [True] * is_said


def test_a_record_of_many_sweeps_is_not_told_to_sweep_more(linear):
    record, result = linear
    rows = (replace(row, percent=9.0 if row.data == 'held out' else 1.0) for row in result.errors)
    poor = replace(result, errors=tuple(rows))
    [piece] = record
    for pieces, is_said in (([piece], False), ([piece.cut(0, 260)], True)):
        [said] = [x for x in warnings_of(poor, [record], pieces) if 'times the fitted error' in x]
        assert ('drive it more often' in said) == is_said


def test_two_delays_that_were_not_taken_are_not_said_to_be_followed(linear):
    record, result = linear
    step = StepDelay(3, 0.3, 4, 1e-3, 5e-3, np.arange(3), np.zeros(3))
    for source, followed in (('steps', 'steps were'), ('scan', 'fit was'), ('none', 'neither')):
        delay = DelayResult(3, 0.5, source, step, None, 7)
        said = warnings_of(replace(result, delay=delay), [record], list(record))
        assert any('3 samples, the ARX fit says 7' in x and followed in x for x in said)
