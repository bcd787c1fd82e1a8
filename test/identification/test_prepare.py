# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records made ready: one rate, one scaling, held-out blocks, closed loops, the noise floor."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_array_equal
from piezo_ident.common.errors import IdentificationError
from piezo_ident.excitation.signals import triangle
from piezo_ident.identification.prepare import common_rate, END_HELD, runs_of, scaling_of
from piezo_ident.identification.refusals import refuse_closed_loop
from piezo_ident.record.record import Piece, Record, Segment
import pytest


def piece(v, y=None, rate=1000.0, segments=()):
    v = np.asarray(v, dtype=float)
    return Piece(v, 7.5e-6 * v if y is None else y, rate, 0.0, segments)


def record(*pieces, name='mine'):
    return Record(tuple(pieces), name)


RAMP = np.linspace(0, 10, 1001)


def test_rate_with_the_most_travel_wins_and_rates_that_differ_by_rounding_are_one():
    slow, fast = piece(RAMP, rate=1000.0), piece(np.tile(RAMP, 3), rate=20_000.0)
    rate, left = common_rate([record(slow), record(fast)])
    assert rate == 20_000
    assert len(left) == 1
    assert '1000 Hz' in left[0]
    assert common_rate([record(slow)]) == (1000.0, [])
    runs = runs_of([record(slow), record(fast)], rate, scaling_of([fast]))
    assert [run.piece.sample_rate for run in runs] == [20_000.0]
    one, two = piece(RAMP, rate=20_000.0), piece(RAMP, rate=20_000.0 * (1 + 1e-9))
    rate, left = common_rate([record(one), record(two)])
    assert left == []
    assert len(runs_of([record(one, two)], rate, scaling_of([one, two]))) == 2


def test_a_voltage_that_never_moves_and_nothing_to_scale_are_refused():
    with pytest.raises(IdentificationError, match=r'mine: .*voltage'):
        common_rate([record(piece(np.full(100, 3.0)))])
    with pytest.raises(IdentificationError, match='voltage'):
        scaling_of([piece(np.full(9, 2.0), np.arange(9.0))])
    with pytest.raises(IdentificationError, match='displacement'):
        scaling_of([piece(RAMP, np.full(1001, 1e-6))])


@pytest.mark.parametrize('gain', [7.5e-6, -7.5e-6])
def test_scaling_takes_range_stroke_and_sign(gain):
    v = np.linspace(-3, 7, 101)
    s = scaling_of([piece(v, 1e-3 + gain * v)])
    assert (s.v0, s.V, s.range) == (-3.0, 10.0, (-3.0, 7.0))
    assert pytest.approx(10 * gain) == s.Y
    assert s.y0 == pytest.approx(1e-3 - 3 * gain)
    x = s.x(1e-3 + gain * v)
    assert x[0] == pytest.approx(0.0, abs=1e-9)
    assert x[-1] == pytest.approx(1.0, abs=1e-9)


def test_scaling_of_several_pieces_spans_them_all():
    s = scaling_of([piece(RAMP / 2), piece(RAMP)])
    assert s.V == 10.0
    assert pytest.approx(75e-6) == s.Y


def run_of(v, *segments, rate=1000.0):
    made = piece(v, rate=rate, segments=tuple(Segment(*s) for s in segments))
    return runs_of([record(made)], rate, scaling_of([made]))[0]


def test_masks_are_those_of_the_kinds_and_the_end_of_the_noise_is_held_out():
    run = run_of(RAMP, ('step', 0, 100), ('noise:a', 200, 300), ('noise:b', 300, 350))
    assert_array_equal(np.flatnonzero(run.mask('noise')), np.arange(200, 350))
    assert run.mask('step', 'noise').sum() == 250
    assert not run.mask('triangle').any()
    run = run_of(RAMP, ('noise', 100, 600))
    first = 600 - int(END_HELD * 500)
    assert_array_equal(np.flatnonzero(run.held_out()), np.arange(first, 600))


@settings(deadline=None, max_examples=60)
@given(
    peaks=st.lists(st.floats(1, 10), min_size=1, max_size=8),
    before=st.integers(0, 500),
    slope=st.floats(2, 40),
)
def test_held_out_blocks_never_hold_a_turning_point(peaks, before, slope):
    v = np.concatenate([np.zeros(before), triangle(peaks, 0, slope, 1000.0)])
    if v.size - before < 200:
        return
    run = run_of(v, ('triangle', before, v.size))
    held = run.held_out()
    assert not held[:before].any()
    assert held.sum() <= 0.21 * (v.size - before) + 10
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        d = np.diff(v[start:stop])
        assert np.all(d >= 0) or np.all(d <= 0)


def test_a_fifth_of_the_papers_triangle_is_held_out():
    v = triangle((3, 6, 9), 0, 6, 1000.0)
    run = run_of(v, ('triangle', 0, v.size))
    assert 0.1 < run.held_out().mean() < 0.21


def test_start_is_known_only_at_the_lowest_voltage():
    assert run_of(RAMP).known.all()
    v = np.concatenate([np.linspace(5, 10, 500), np.linspace(10, 0, 1000), np.linspace(0, 5, 500)])
    known = run_of(v).known
    assert not known[:1400].any()
    assert known[1500:].all()


def hold(drift, follow):
    """Return 10 s up, 10 s held, 10 s down: the voltage creeps, the position follows it or not."""
    up, n = np.linspace(0, 10, 10_000), 10_000
    creep = drift * np.log10(1 + np.arange(n))
    v = np.concatenate([up, 10 - creep, np.linspace(10 - creep[-1], 0, n)])
    y = np.concatenate([up, 10 - follow * creep, np.linspace(10 - follow * creep[-1], 0, n)])
    return record(piece(v, 7.5e-6 * y + 1e-10 * np.random.default_rng(0).standard_normal(3 * n)))


def test_position_controller_is_noticed():
    with pytest.raises(IdentificationError, match=r'mine: from \S+ to \S+ s .*stroke') as caught:
        refuse_closed_loop(hold(0.1, 0.0))
    assert 'open loop' in str(caught.value)


def test_open_loop_passes():
    refuse_closed_loop(hold(0.1, 1.0))
    refuse_closed_loop(hold(0.0, 1.0))
    # creep at constant voltage is the other way round
    n = 10_000
    v = np.concatenate([RAMP, np.full(n, 10.0)])
    creep = np.concatenate([np.zeros(1001), 0.1 * np.log10(1 + np.arange(n))])
    refuse_closed_loop(record(piece(v, 7.5e-6 * (v + creep))))
    refuse_closed_loop(record(piece(np.zeros(100), np.zeros(100))))


def test_a_sensor_at_its_stop_is_not_blamed_on_a_controller_alone():
    v = np.concatenate([np.linspace(0, 10, 20_000), np.linspace(10, 7, 6_000)])
    with pytest.raises(IdentificationError, match=r'sensor .* 40 um'):
        refuse_closed_loop(record(piece(v, np.minimum(7.5e-6 * v, 40e-6))))
