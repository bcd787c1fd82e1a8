# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Each reason where it is true, and where it must not come."""

from dataclasses import replace
import re

import numpy as np
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident.identification.errors import predictions_of
from piezo_ident.identification.prepare import Excerpt, excerpts_of, runs_of, scaling_of
from piezo_ident.identification.results import ErrorRow
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.step1_delay import DelayResult, StepDelay
from piezo_ident.identification.warnings import (
    only_jumps,
    warn_of_delay,
    warn_of_range,
    warn_of_shape,
    warn_of_thresholds,
    warn_of_triangle,
    warn_of_zeros,
    warnings_of,
)
from piezo_ident.model.scaling import Scaling
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record, Segment
import pytest
from scipy.optimize import OptimizeResult

FS = 1000.0
T = np.arange(2000) / FS
SINE = 0.5 - 0.5 * np.cos(2.0 * np.pi * T)
#: 10 V and 10 um
SCALING = Scaling(0.0, 10.0, 0.0, 1e-5, (0.0, 10.0))


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
    assert re.search(r'\d um .* \d\S* um ', ends)
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
        [said] = [x for x in warnings_of(poor, [record], pieces) if 'held-out error' in x]
        assert bool(re.search(r'range \S+ times', said)) == is_said


def test_two_delays_that_were_not_taken_are_not_said_to_be_followed(linear):
    record, result = linear
    step = StepDelay(3, 0.3, 4, 1e-3, 5e-3, np.arange(3), np.zeros(3))
    for source, followed in (('steps', 'steps were'), ('scan', 'fit was'), ('none', 'neither')):
        delay = DelayResult(3, 0.5, source, step, None, 7)
        said = warnings_of(replace(result, delay=delay), [record], list(record))
        assert any('3 samples, the ARX fit says 7' in x and followed in x for x in said)


def slopes(result, measured):
    dynamics = replace(result.dynamics, slope_measured=measured, slope_model=0.8)
    return replace(result, dynamics=dynamics)


def flown(result, loss, optimum=2.0, **more):
    """Return a result of which the swarm left a sum of squares."""
    losses = {'swarm_loss': loss, 'optimum_loss': optimum, **more}
    return replace(result, hysteresis=replace(result.hysteresis, swarm=OptimizeResult(), **losses))


def erring(result, chosen, **held):
    """Return a result with an error on the data that chose it, and on segments held out."""
    rows = [ErrorRow('r', 'triangle', chosen, chosen, 99.0, 100, 'selection')]
    rows += [ErrorRow('r', label, x, x, 99.0, 100, 'held out') for label, x in held.items()]
    return replace(result, errors=tuple(rows))


#: what is changed of a result, what its reason names, and the sizes in it, '' where it is not so
OF_FIT = {
    'gain above': (lambda r: slopes(r, 0.85), 'slope of H', r' 0\.85, .* 0\.8 '),
    'gain below': (lambda r: slopes(r, 0.75), 'slope of H', r' 0\.75, .* 0\.8 '),
    'gain near': (lambda r: slopes(r, 0.83), 'slope of H', ''),
    'no gain': (lambda r: slopes(r, np.nan), 'slope of H', ''),
    'swarm': (lambda r: flown(r, 2.5), 'swarm', ' 25 %(?!.*polish)'),
    'swarm, polished': (lambda r: flown(r, 2.5, polished=True), 'swarm', ' 25 %.*polish'),
    'swarm, near': (lambda r: flown(r, 2.01), 'swarm', ''),
    'swarm, no loss': (lambda r: flown(r, 0.0, optimum=0.0), 'swarm', ''),
    'no swarm': (lambda r: flown(r, 2.5, swarm_loss=None), 'swarm', ''),
    'rest': (lambda r: erring(r, 0.2, idle=0.5, ramp=0.3), 'joint', r' 0\.5 % .* 0\.2 % '),
    'ramp': (lambda r: erring(r, 0.2, ramp=0.41), 'joint', r' 0\.41 % .* 0\.2 % '),
    'rest, near': (lambda r: erring(r, 0.2, idle=0.39), 'joint', ''),
    'driven': (lambda r: erring(r, 0.2, noise=0.5, idle=0.1), 'joint', ''),
    'no selection': (lambda r: erring(r, np.nan, idle=0.5), 'joint', ''),
    'rounding': (lambda r: erring(r, 1e-13, idle=1e-11), 'joint', ''),
}


def told(texts, words, said):
    """Return whether a reason is given once, with what is said; not at all where that is empty."""
    found = [text for text in texts if re.search(words, text)]
    return len(found) == bool(said) and all(re.search(said, text) for text in found)


@pytest.mark.parametrize('name', OF_FIT)
def test_a_reason_of_the_fit_is_told_where_it_is_so(linear, name):
    record, result = linear
    change, words, said = OF_FIT[name]
    assert told(warnings_of(change(result), [record], list(record)), words, said)


def test_labels_that_mean_nothing_are_named_and_others_are_let_be(linear):
    record, result = linear
    [piece] = record
    near = r' triangl .* triangle\?'
    for label, said in (('triangl', near), ('triangle', ''), ('my part', '')):
        labelled = Record((replace(piece, segments=(Segment(label, 0, 100),)),))
        assert told(warnings_of(result, [labelled], [piece]), 'label', said)


def run_of(v, label=None):
    """Return the run of a voltage whose displacement it is."""
    segments = () if label is None else (Segment(label, 0, v.size),)
    [run] = runs_of([Record((Piece(v, 1e-6 * v, FS, segments=segments),))], FS, SCALING)
    return run


V, EARLY, ALWAYS = 10.0 * SINE, T < 1.0, T >= 0.0


@pytest.mark.parametrize(
    ('fitted', 'use', 'said'),
    [
        (V < 8.0, ALWAYS, r' 0 .. 7\.99 V, .* 8\.01 .. 10 V'),
        (V > 3.0, ALWAYS, r' 3\.01 .. 10 V, .* 0 .. 2\.99 V'),
        (V < 9.95, ALWAYS, ''),
        (V > 0.05, ALWAYS, ''),
        (EARLY, ALWAYS, ''),
        # readings that were lost tell nothing, and are not judged
        (EARLY, ~EARLY | (V < 8.0), r' 0 .. 7\.99 V, .* 0 .. 10 V'),
        (V < 8.0, V < 8.05, ''),
        (EARLY, EARLY, ''),
    ],
)
def test_extrapolation_is_told_of_what_is_held_out_beyond_the_fitted_part(fitted, use, said):
    texts = warn_of_range([replace(run_of(V), use=use)], [fitted], SCALING)
    assert told(texts, 'extrapolation', said)


@pytest.mark.parametrize(
    ('sweeps', 'size', 'count', 'law', 'said'),
    [
        # 60 blocks of which one in five is held out
        (2, 2000, None, 'plays', ''),
        (2, 2000, 7, 'plays', ''),
        (130, 2000, None, 'plays', 'thresholds .* 10'),
        (130, 2000, 7, 'plays', ''),
        # other parts chose the law, and it has thresholds of its own
        (130, 2000, None, 'preisach', ''),
        # a block of one sample shows no turn
        (2, 60, None, 'plays', 'thresholds .* 10'),
    ],
)
def test_thresholds_that_no_triangle_could_choose(sweeps, size, count, law, said):
    v = 10.0 * np.abs((np.arange(size) * sweeps / size + 1.0) % 2.0 - 1.0)
    held = excerpts_of([run_of(v, 'triangle')], 'triangle', held=True)
    assert told(warn_of_thresholds(held, count, law), 'triangle', said)


@pytest.mark.parametrize(
    ('lowest', 'highest', 'said'),
    [(0.0, 0.8, ' 0 .. 8 V'), (0.03, 1.0, r' 0\.3 .. 10 V'), (0.008, 0.992, '')],
)
def test_a_triangle_that_does_not_cover_the_record_is_told(lowest, highest, said):
    assert told(warn_of_triangle(lowest, highest, SCALING), 'triangle', said)


@pytest.mark.parametrize(
    ('offset', 'said'), [(3e-8, r' 0\.03 um'), (-3e-8, r' -0\.03 um'), (1.9e-8, '')]
)
def test_a_zero_that_moved_is_told_by_its_size(offset, said):
    for Y in (SCALING.Y, -SCALING.Y):
        texts = warn_of_zeros({('one', 0.0): offset, ('two', 0.0): 0.0}, replace(SCALING, Y=Y))
        assert told(texts, 'one: .*zero', said)
        assert len(texts) == bool(said)
