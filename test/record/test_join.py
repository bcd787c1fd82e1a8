# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Streams meet on their time stamps, whatever was lost, and whichever of two ways is taken."""

import time

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record import join as joining
from piezo_ident.record.blocks import Samples
from piezo_ident.record.join import join
from piezo_ident.record.stream import BlockStream
import pytest

RATE = 1000.0
LABELS = ('step', 'noise', '')
SIZE = 50


def stream(runs, size=SIZE, late=0, scale=1.0, lost=()):
    """Return a stream of runs of the clock from zero, each of so many samples, in blocks."""
    made = BlockStream()
    for k, n in enumerate(runs):
        for i in range(0, n, size):
            rows = np.arange(i, min(i + size, n))
            label = LABELS[min(2 * i // max(runs), 2)]
            if (k, i // size) not in lost:
                made.append(
                    Samples(rows / RATE, scale * (rows + 1000.0 * k), label),
                    1_000_000 * (10_000 * k + int(rows[-1])) + late,
                )
    return made


# a whole run that is lost, or its first block, is no run that all went through
RUNS = st.lists(st.integers(701, 750), min_size=1, max_size=3)
LOST = st.sets(st.tuples(st.integers(0, 2), st.integers(1, 20)), max_size=4)


@settings(deadline=None)
@given(RUNS, LOST, LOST, st.data())
def test_both_ways_give_what_all_streams_have(runs, lost_v, lost_y, data):
    shorter = [data.draw(st.integers(n - 5, n)) for n in runs]
    streams = {
        'voltage': stream(runs, lost=lost_v),
        'displacement': stream(shorter, late=300, scale=-1.0, lost=lost_y),
    }
    beside = {'applied_voltage': stream(shorter, data.draw(st.integers(1, 40)), 200)}
    quick = join(streams, beside)
    times = {name: s.times for name, s in {**streams, **beside}.items()}
    assert joining._in_step({**streams, **beside}, times)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joining, '_in_step', lambda *_: None)
        slow = join(streams, beside)
    expected = [
        k * 1000.0 + i
        for k, n in enumerate(shorter)
        for i in range(n)
        if not {(k, i // SIZE)} & (lost_v | lost_y)
    ]
    # the table cannot tell apart one time that either stream lacks in another run
    both_lack = lost_v and (lost_y or shorter != runs)
    for joined in (quick,) if both_lack else (quick, slow):
        np.testing.assert_array_equal(joined.columns['voltage'], expected)
        np.testing.assert_array_equal(joined.columns['displacement'], np.negative(expected))
        np.testing.assert_array_equal(joined.columns['applied_voltage'], expected)
        np.testing.assert_array_equal(joined.t, np.array(expected) % 1000.0 / RATE)
        assert quick.segments == joined.segments
        assert sum(f.count for f in quick.faults) == sum(f.count for f in joined.faults)


def test_runs_that_came_at_another_time_are_no_partners():
    # the second run of one is the first of the other: only the arrivals tell
    one, other = stream([400, 400]), BlockStream()
    for value, begin in ((1000.0, 10_080), (2000.0, 20_080)):
        for k in range(8):
            rows = np.arange(SIZE * k, SIZE * (k + 1))
            arrival = 1_000_000 * (begin + SIZE * k)
            other.append(Samples(rows / RATE, rows + value, 'step'), arrival)
    joined = join({'v': one, 'y': other})
    for column in joined.columns.values():
        np.testing.assert_array_equal(column, 1000.0 + np.arange(400))


def test_a_slower_stream_takes_time_by_its_samples_alone():
    t = np.arange(200_000) / 20_000.0
    streams = {'voltage': BlockStream(), 'displacement': BlockStream()}
    streams['voltage'].append(Samples(t, t), 0)
    streams['displacement'].append(Samples(t[::2], 2 * t[::2]), 1)
    begin = time.process_time()
    joined = join(streams)
    # every second stamp is shared; comparing all that follows at each takes ten times as long
    assert time.process_time() - begin < 6.0
    np.testing.assert_array_equal(joined.t, t[::2])
    np.testing.assert_array_equal(joined.columns['displacement'], 2 * t[::2])


def test_streams_that_begin_and_end_apart_are_joined_without_a_copy():
    one, other = stream([1000], 10), stream([800], 10, scale=2.0)
    one.drop(100)
    joined = join({'v': one, 'y': other})
    assert not joined.columns['v'].flags.writeable
    for column in joined.columns.values():
        assert column.size == 700 and column.base is not None


@pytest.mark.parametrize('clock', [1.0, 1.01])
def test_a_short_time_together_is_told_from_another_clock(clock):
    # the voltage ends soon after the displacement begins
    t, streams = np.arange(60_000) / 1000.0, {}
    for name, times in (('voltage', t[:32_000]), ('displacement', clock * t[30_000:])):
        streams[name] = BlockStream()
        streams[name].append(Samples(times, times), 0)
    if clock == 1.0:
        np.testing.assert_array_equal(join(streams).t, t[30_000:32_000])
    else:
        with pytest.raises(DataError, match=r'voltage and displacement .*13 of 1683'):
            join(streams)


def test_a_channel_belongs_to_the_row_that_stays_of_a_block_that_came_twice():
    rows = np.arange(SIZE)

    def of(arrivals, values):
        made = BlockStream()
        for k, arrived in arrivals:
            made.append(Samples((k * SIZE + rows) / RATE, values + k), arrived)
        return made

    voltage = of([(0, 0), (1, 100), (1, 200), (2, 300)], rows)
    # the displacement came soon, the applied voltage after the block that came again
    displacement = of([(0, 10), (1, 110), (2, 310)], -rows)
    applied = of([(0, 20), (1, 190), (2, 320)], rows)
    joined = join({'voltage': voltage, 'displacement': displacement}, {'applied_voltage': applied})
    np.testing.assert_array_equal(joined.columns['applied_voltage'], joined.columns['voltage'])
    assert [fault.name for fault in joined.faults] == ['repeated_rows']
