# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Blocks of samples as they travel."""

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.blocks import cut_blocks, decode, Dimension, encode, Samples, time_problem
from piezo_ident.record.record import Segment
import pytest


def test_layout_of_a_block():
    data, dims = encode(Samples(np.array([0.0, 0.1]), np.array([5.0, 6.0]), 'hold:4V', 'voltage'))
    assert data.tolist() == [0.0, 5.0, 0.1, 6.0]
    assert dims == (Dimension('sample:hold:4V', 2, 4), Dimension('t,voltage', 2, 2))
    back = decode(data, dims)
    assert (back.segment, back.quantity) == ('hold:4V', 'voltage')
    assert back.t.tolist() == [0.0, 0.1]
    assert decode(np.r_[9.0, data], dims, data_offset=1).values.tolist() == [5.0, 6.0]


@pytest.mark.parametrize(
    ('dims', 'reason'),
    [
        ((), r'layout \[\]'),
        ((Dimension('sample:', 2, 4),), r"layout \['sample:'\]"),
        ((Dimension('sample:', 3, 6), Dimension('t,voltage', 2, 2)), 'announces 3 x 2'),
        ((Dimension('sample:', 2, 4), Dimension('t,voltage', 3, 3)), 'layout 2 x 3'),
        ((Dimension('sample:', 2, 2), Dimension('t,voltage', 2, 2)), 'strides 2, 2'),
        ((Dimension('sample:', -1, -2), Dimension('t,voltage', 2, 2)), 'layout -1 x 2'),
        ((Dimension('row', 2, 4), Dimension('t,voltage', 2, 2)), "first dimension is 'row'"),
    ],
)
def test_layouts_that_do_not_fit(dims, reason):
    with pytest.raises(DataError, match=reason):
        decode(np.zeros(4), dims)


@pytest.mark.parametrize('rate', [20_000.0, 44_100.0, 16_384.5])
def test_ticks_times_the_period_meet_ticks_over_the_rate(rate):
    k = np.arange(100) + 12_345
    blocks = [decode(*encode(Samples(t, 1.0 * k))) for t in (k / rate, k * (1.0 / rate))]
    np.testing.assert_array_equal(blocks[0].t, k / rate)
    is_whole = rate == round(rate)
    assert np.array_equal(blocks[1].t, k / rate) == is_whole
    # what lies between ticks, or is no number, stays
    for t in ((k + 0.01) / rate, np.where(k == 12_400, np.nan, k / rate), 1e9 + k / rate):
        np.testing.assert_array_equal(decode(*encode(Samples(t, 1.0 * k))).t, t)


def test_no_block_spans_two_segments():
    segments = (Segment('noise', 130, 400), Segment('sine:50Hz', 400, 1050))
    got = list(cut_blocks(1050, segments))
    assert got[:4] == [(0, 100, ''), (100, 130, ''), (130, 230, 'noise'), (230, 330, 'noise')]
    assert got[-1] == (1000, 1050, 'sine:50Hz')
    assert [b[0] for b in got[1:]] == [b[1] for b in got[:-1]]


TICKS = np.arange(100) / 20e3


@pytest.mark.parametrize('t', [TICKS, TICKS[:1], 1.7e9 + TICKS, TICKS - 1.0, 0.01 * TICKS])
def test_times_of_samples_in_a_row(t):
    assert time_problem(t) == ''


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    ('t', 'reason'),
    [
        (TICKS[:0], 'empty'),
        *((np.where(TICKS == TICKS[50], x, TICKS), 'not finite') for x in (np.nan, np.inf)),
        *((t, 'not finite') for t in (np.full(1, 1e300), np.full(100, 1e300))),
        (np.array([-1e308, 1e308]), 'not finite'),
        (np.where(TICKS == TICKS[50], 1e300, TICKS), 'in a row'),
        *((t, 'in a row') for t in (TICKS[::-1], np.zeros(100), np.delete(TICKS, 50))),
        (1e-9 * np.arange(100), 'in a row'),
    ],
)
def test_times_that_are_none(t, reason):
    assert reason in time_problem(t)
    # and none of them breaks what reads them
    decode(*encode(Samples(t, np.zeros(t.size))))
