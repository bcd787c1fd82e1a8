# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Streams that lost nothing are joined without a table of partners: with the same result."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from piezo_ident.record import join as joining
from piezo_ident.record.blocks import Samples
from piezo_ident.record.join import join
from piezo_ident.record.stream import BlockStream
import pytest

RATE = 1000.0
LABELS = ('step', 'noise', '')


def stream(runs, size, late=0, scale=1.0):
    """Return a stream of runs of the clock from zero, each of so many samples, in blocks."""
    made = BlockStream()
    for k, n in enumerate(runs):
        for i in range(0, n, size):
            rows = np.arange(i, min(i + size, n))
            label = LABELS[min(2 * i // max(runs), 2)]
            made.append(
                Samples(rows / RATE, scale * (rows + 1000.0 * k), label),
                1_000_000 * (10_000 * k + int(rows[-1])) + late,
            )
    return made


# runs of fewer than 300 samples look like a clash of two samples to the table
runs = st.lists(st.integers(310, 330), min_size=1, max_size=3)


@given(runs, st.data())
def test_it_is_what_the_table_of_partners_gives(lengths, data):
    def other(low=0):
        shorter = [data.draw(st.integers(max(low, n - 5), n)) for n in lengths]
        return stream(shorter, data.draw(st.integers(1, 40)), 300, -1.0)

    streams = {'voltage': stream(lengths, data.draw(st.integers(1, 40))), 'displacement': other(1)}
    beside = {'applied_voltage': other(1)}
    quick = join(streams, beside)
    # without the way for streams in step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joining, '_in_step', lambda *_: None)
        slow = join(streams, beside)
    assert joining._in_step(streams['voltage'].times, streams, beside)
    np.testing.assert_array_equal(quick.t, slow.t)
    assert list(quick.columns) == list(slow.columns)
    for name, column in slow.columns.items():
        np.testing.assert_array_equal(quick.columns[name], column)
    assert quick.segments == slow.segments
    assert sum(f.count for f in quick.faults) == sum(f.count for f in slow.faults)


def test_what_was_lost_in_the_middle_goes_by_the_table():
    whole, torn = stream([300], 100), BlockStream()
    for k in (0, 2):
        rows = np.arange(100 * k, 100 * (k + 1))
        torn.append(Samples(rows / RATE, -1.0 * rows, 'noise'), k)
    assert joining._in_step(whole.times, {'v': whole, 'y': torn}, {}) is None
    joined = join({'v': whole, 'y': torn})
    np.testing.assert_array_equal(joined.columns['v'], -joined.columns['y'])
    assert joined.t.size == 200 and joined.faults[0].count == 100


def test_runs_that_came_at_another_time_are_no_partners():
    # the second run of one is the first of the other: only the arrivals tell
    one, other = stream([50, 50], 10), BlockStream()
    for k in range(5):
        rows = np.arange(10 * k, 10 * (k + 1))
        other.append(Samples(rows / RATE, rows + 1000.0, 'step'), 1_000_000 * (10_020 + k))
    for k in range(5):
        rows = np.arange(10 * k, 10 * (k + 1))
        other.append(Samples(rows / RATE, rows + 2000.0, 'step'), 1_000_000 * (20_000 + k))
    assert joining._in_step(one.times, {'v': one, 'y': other}, {}) is None


def test_joined_columns_are_shared_with_the_record_and_not_with_the_stream():
    one, other = stream([100], 10), stream([100], 10, scale=2.0)
    joined = join({'v': one, 'y': other})
    assert not joined.columns['v'].flags.writeable
    rows = np.arange(100, 110)
    one.append(Samples(rows / RATE, rows * 1.0, 'step'), 5)
    assert joined.columns['v'].size == 100 and one.n == 110
