# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Blocks as they come to a record: the same as by way of a bag, and every fault said."""

from dataclasses import replace

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.live.capture import Capture, refuse_incomplete
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.blocks import cut_blocks, Samples
from piezo_ident.record.join import APPLIED
from piezo_ident.record.record import Piece, Record, Segment
import pytest

RATE = 20_000.0
N = 20_000
SEGMENTS = (
    Segment('step', 0, 5000),
    Segment('noise', 5000, 12_000),
    Segment('triangle', 12_000, 20_000),
)


@pytest.fixture(scope='module')
def record():
    rng = np.random.default_rng(4)
    v = 5.0 + np.cumsum(rng.normal(0.0, 0.01, N))
    y = 7.5e-6 * np.concatenate([v[:3], v[:-3]]) + rng.normal(0.0, 1e-9, N)
    return Record((Piece(v, y, RATE, segments=SEGMENTS, channels={'temperature': v / 3}),), 'r')


def blocks_of(record, size=100):
    """All blocks in the order of a running graph: voltage, applied voltage, displacement."""
    (piece,) = record
    t = piece.t
    for start, stop, label in cut_blocks(piece.n, piece.segments, size):
        cut = slice(start, stop)
        yield 'voltage', Samples(t[cut], piece.v[cut], label, 'voltage')
        yield APPLIED, Samples(t[cut], piece.v[cut], label, 'voltage')
        for name, x in piece.channels.items():
            yield f'x_{name}', Samples(t[cut], x[cut], label, f'x_{name}')
        yield 'displacement', Samples(t[cut], piece.y[cut], label, 'displacement')


def capture_of(blocks, **kwargs):
    capture = Capture(**kwargs)
    for arrival, (key, samples) in enumerate(blocks):
        capture.add(key, samples, arrival * 1_000_000)
    return capture


def faults(record):
    return {fault.name: fault for fault in record.faults}


def assert_equal(one, other):
    assert len(one.pieces) == len(other.pieces)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.v, b.v)
        np.testing.assert_array_equal(a.y, b.y)
        np.testing.assert_array_equal(a.t, b.t)
        assert a.sample_rate == b.sample_rate and a.segments == b.segments
        assert set(a.channels) == set(b.channels)
        for name in a.channels:
            np.testing.assert_array_equal(a.channels[name], b.channels[name])


@pytest.mark.parametrize('size', [100, 37, 5000])
def test_record_is_that_of_a_bag_bit_for_bit(record, tmp_path, size):
    write_bag(record, tmp_path / 'bag', block_size=size)
    captured = capture_of(blocks_of(record, size)).record()
    assert_equal(captured, read_bag(tmp_path / 'bag'))
    assert_equal(captured, record)
    assert captured.faults == ()


def without(blocks, *drop):
    """Leave out the k-th block of a topic."""
    seen = {}
    for key, samples in blocks:
        k = seen[key] = seen.get(key, -1) + 1
        if (key, k) not in drop:
            yield key, samples


def test_lost_blocks_split_the_record_and_are_counted(record):
    capture = capture_of(without(blocks_of(record), ('voltage', 20), ('displacement', 80)))
    assert capture.lost == {'voltage': 100, 'displacement': 100, APPLIED: 0, 'x_temperature': 0}
    assert capture.problems == (
        '100 samples of voltage are missing',
        '100 samples of displacement are missing',
    )
    made = capture.record()
    assert [p.n for p in made] == [2000, 5900, 11_900]
    assert faults(made)['gap'].count == 2
    lost = [f for f in made.faults if f.name == 'unmatched' and 'in displacement' in f.where]
    assert [f.count for f in lost] == [100]


def test_a_voltage_that_is_never_applied_is_refused(record):
    blocks = (
        (k, Samples(s.t, s.values + (k == APPLIED), s.segment, s.quantity))
        for k, s in blocks_of(record)
    )
    with pytest.raises(DataError, match=r'applied .*to 1 V'):
        capture_of(blocks).record()


def test_repeated_blocks_are_dropped_and_said(record):
    def twice():
        for i, (key, s) in enumerate(blocks_of(record)):
            yield key, s
            if 100 <= i < 120:
                yield key, s

    capture = capture_of(twice())
    assert '500 samples of voltage came twice or out of turn' in capture.problems
    made = capture.record()
    assert_equal(made, record)
    assert faults(made)['repeated_rows'].count > 0


def ramped(record, begin, count):
    """Insert a ramp of the driver, behind which it follows the rest of the command again."""
    for k, (key, s) in enumerate(blocks_of(record)):
        if k == begin:
            t = s.t[0] + np.arange(count) / RATE
            yield APPLIED, Samples(t, np.linspace(s.values[0], 0.0, count), 'ramp:silence')
            # time passes
            yield from [('displacement', Samples(np.empty(0), np.empty(0)))] * 50
        yield key, s


def test_a_ramp_in_silence_is_told_and_is_no_repetition(record):
    capture = capture_of(ramped(record, 200, 300))
    assert capture.problems == ('300 samples of applied_voltage are a ramp to rest in silence',)
    (fault,) = capture.record().faults
    assert (fault.name, fault.count) == ('ramp:silence', 300)
    assert fault.where == 'in applied_voltage, at 0.25 s'
    # behind the last command, or before another program, it differs from nothing
    others = [*ramped(record, 200 * 5, 300), *blocks_of(record)]
    end = [*blocks_of(record), others[200]]
    for blocks in (end, [*end, *blocks_of(record)]):
        capture = capture_of(blocks)
        assert capture.problems == ()
        assert not {'ramp:silence', 'hold:gap'} & faults(capture.record()).keys()


def test_a_voltage_that_was_held_is_told(record):
    def held():
        for k, (key, s) in enumerate(blocks_of(record)):
            if 400 <= k < 412 and key == 'displacement':
                continue
            yield key, replace(s, segment='hold:gap') if 400 <= k < 412 and key == APPLIED else s

    found = faults(capture_of(held()).record())
    assert (found['hold:gap'].count, found['gap'].count) == (300, 1)


def test_two_publishers_are_no_rows_to_be_sorted(record):
    # two streams of one clock, one of them half a block ahead
    blocks = list(blocks_of(record))
    mixed = [blocks[i ^ 4] if i < 40 else blocks[i] for i in range(len(blocks))]
    with pytest.raises(DataError, match=r'\d s .* \d\S* s; .* voltage') as caught:
        capture_of(mixed).record()
    assert 'rows' not in str(caught.value)


def test_a_restart_begins_another_piece(record):
    capture = capture_of([*blocks_of(record), *blocks_of(record)])
    made = capture.record()
    assert [p.n for p in made] == [N, N]
    assert faults(made)['restart'].count == 1
    assert capture.segments == {'step': 10_000, 'noise': 14_000, 'triangle': 16_000}


def test_beyond_the_limit_the_oldest_run_is_forgotten(record):
    capture = capture_of([*blocks_of(record)] * 3, limit=2.5)
    assert capture.seconds == pytest.approx(2.0)
    made = capture.record()
    assert [p.n for p in made] == [N, N]
    fault = faults(made)['capture_limit']
    assert fault.where == 'the oldest 1 s' and '2.5 s are kept' in fault.action
    assert 'unmatched' not in faults(made)


def test_a_run_without_end_keeps_its_newest_part(record):
    capture = capture_of(blocks_of(record), limit=0.5)
    assert 0.4 < capture.seconds <= 0.5
    (piece,) = capture.record()
    np.testing.assert_array_equal(piece.v, record.pieces[0].v[-piece.n :])
    assert piece.segments[-1].label == 'triangle'


def test_a_block_longer_than_the_limit_is_kept_until_the_next():
    capture = Capture(limit=0.5)
    for k in range(3):
        t = np.arange(1000 * k, 1000 * (k + 1)) / 1000.0
        capture.add('voltage', Samples(t, t, 'hold'), k)
        assert capture.n == 1000


def test_nothing_and_half_of_it_are_refused(record):
    with pytest.raises(DataError, match=r'voltage .*excitation'):
        Capture().record()
    only = [b for b in blocks_of(record) if b[0] == 'voltage']
    with pytest.raises(DataError, match=r'displacement .*stage'):
        capture_of(only).record()


def test_unreadable_messages_are_said(record):
    capture = capture_of(blocks_of(record))
    capture.unreadable('voltage', 'layout [] is not ours')
    capture.unreadable('voltage', 'layout [] is not ours')
    assert capture.problems == ('2 messages on voltage are no blocks (layout [] is not ours)',)
    assert faults(capture.record())['unreadable_block'].count == 2


def test_a_snapshot_does_not_see_what_comes_later(record):
    blocks = list(blocks_of(record))
    capture = capture_of(blocks[:400])
    snapshot = capture.snapshot()
    for i, (key, samples) in enumerate(blocks[400:]):
        capture.add(key, samples, (400 + i) * 1_000_000)
    assert snapshot.record().n == 10_000
    assert_equal(capture.record(), record)
    capture.clear()
    assert capture.n == 0 and snapshot.record().n == 10_000


def test_what_came_after_a_mark_can_be_had_alone(record):
    blocks = list(blocks_of(record))
    capture = capture_of(blocks)
    mark = capture.mark()
    assert capture.seconds_since(mark) == 0.0
    for key, samples in blocks:
        capture.add(key, samples, 10**12)
    assert capture.seconds_since(mark) == pytest.approx(1.0)
    assert_equal(capture.snapshot(mark).record(), record)
    assert capture.snapshot().record().n == 2 * N
    # a topic that was not there at the mark is new altogether
    assert capture.seconds_since({}, 'displacement') == pytest.approx(2.0)


def test_a_mark_holds_when_the_oldest_is_forgotten(record):
    blocks = list(blocks_of(record))
    capture = capture_of(blocks, limit=2.5)
    mark = capture.mark()
    for k, (key, samples) in enumerate([*blocks] * 2):
        capture.add(key, samples, 10**12 + k)
    assert capture.seconds == pytest.approx(2.0)
    assert capture.seconds_since(mark) == pytest.approx(2.0)
    assert capture.snapshot(mark).record().n == 2 * N
    for key, samples in blocks:
        capture.add(key, samples, 2 * 10**12)
    assert capture.seconds_since(mark) == pytest.approx(2.0)


def test_too_much_missing_in_a_segment_is_refused(record):
    few = without(blocks_of(record), ('voltage', 20))
    refuse_incomplete(capture_of(few).record())
    many = without(blocks_of(record), *(('displacement', k) for k in range(60, 90)))
    with pytest.raises(DataError, match=r'0\.15 s .* 0\.35 s .* noise'):
        refuse_incomplete(capture_of(many).record())
    # between two segments nobody knows which of them it was
    edge = without(blocks_of(record), *(('displacement', k) for k in range(45, 55)))
    with pytest.raises(DataError, match=r'0\.05 s .* 0\.275 s .* step'):
        refuse_incomplete(capture_of(edge).record())


def test_a_stage_that_applies_something_else_is_said(record):
    middle = float(np.median(record.pieces[0].v))
    blocks = [
        (key, replace(b, values=np.minimum(b.values, middle)) if key == APPLIED else b)
        for key, b in blocks_of(record)
    ]
    with pytest.raises(DataError, match=r'commanded, at 0.*limits'):
        refuse_incomplete(capture_of(blocks).record())


def test_what_is_missing_at_the_ends_shows_beside_the_voltage(record):
    late = without(blocks_of(record), *(('displacement', k) for k in range(30)))
    snapshot = capture_of(late).snapshot()
    refuse_incomplete(snapshot.record())
    assert snapshot.sent() == pytest.approx({'step': 0.25, 'noise': 0.35, 'triangle': 0.4})
    with pytest.raises(DataError, match=r'0\.15 s .* 0\.25 s .* step'):
        refuse_incomplete(snapshot.record(), snapshot.sent())


def test_what_is_kept_is_bounded_whatever_the_times_say(monkeypatch):
    monkeypatch.setattr('piezo_ident.live.capture.MOST_BLOCKS', 100)
    monkeypatch.setattr('piezo_ident.live.capture.MOST_SAMPLES', 1000)
    monkeypatch.setattr('piezo_ident.live.capture.MOST_LABELS', 20)
    lone, dense, empty = Capture(), Capture(), Capture()
    for k in range(500):
        # single samples have no period, so that no time adds up
        lone.add('voltage', Samples(np.array([k / RATE]), np.zeros(1), f'sine:{k}'), k)
        t = 1e-9 * np.arange(100 * k, 100 * (k + 1))
        dense.add('voltage', Samples(t, np.zeros(100), 'hold'), k)
        empty.add('voltage', Samples(t[:0], t[:0], 'hold'), k)
    assert 80 <= lone.n <= 101
    assert 800 <= dense.n <= 1100
    assert empty.snapshot().streams['voltage'].blocks <= 101
    assert len(lone.segments) == 21 and 'others' in lone.segments
    # the newest part is what is left
    assert lone.last_time('voltage') == 499 / RATE
    assert lone.snapshot().streams['voltage'].times[-1] == 499 / RATE


@pytest.mark.parametrize('time', [np.inf, -np.inf, np.nan])
def test_times_that_are_none_break_nothing(monkeypatch, time):
    monkeypatch.setattr('piezo_ident.live.capture.MOST_BLOCKS', 100)
    capture = Capture()
    for k in range(300):
        t = np.full(100, time) if k % 2 else np.arange(100 * k, 100 * (k + 1)) / RATE
        capture.add('voltage', Samples(t, np.zeros(100), 'hold'), k)
    assert capture.n <= 101 * 100
    assert capture.last_time('voltage') == (100 * 299 - 1) / RATE


def test_samples_that_are_no_numbers_are_counted_and_said():
    capture, values = Capture(), np.zeros(100)
    values[:25] = np.nan
    for k in range(3):
        capture.add('displacement', Samples(np.arange(100 * k, 100 * k + 100) / RATE, values), k)
    assert capture.problems == ('75 samples of displacement are NaN or infinite',)
