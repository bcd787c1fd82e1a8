# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a block is to the stream that is followed, and whose it is."""

import math

import numpy as np
from piezo_ident.live.sample_clock import BlockClock, Kind, SampleClock
from piezo_ident.record.blocks import Samples
import pytest

FS = 20000.0
RNG = np.random.default_rng(0)


@pytest.fixture
def clock():
    return SampleClock(FS, 0.5)


def block(tick, n=100, value=None):
    values = RNG.random(n) if value is None else np.full(n, value)
    return Samples(np.arange(tick, tick + n) / FS, values, 'x')


def kinds(clock, blocks):
    return [clock.judge(b).kind.value for b in blocks]


def test_a_stream_in_order(clock):
    assert kinds(clock, [block(0), block(100, 7), block(107), block(207, 1)]) == [
        'start',
        'next',
        'next',
        'next',
    ]
    assert clock.head == 208


def test_ticks_are_told_after_days(clock):
    k = 20000 * 86400 * 5
    assert kinds(clock, [block(k), block(k + 100)]) == ['start', 'next']


def test_gap_repeat_swap_restart(clock):
    a, b, c, d, e = (block(100 * k) for k in range(5))
    assert kinds(clock, [a, b, b, c]) == ['start', 'next', 'repeat', 'next']
    assert kinds(clock, [e]) == ['gap']
    # it fits into the gap, but its time is over
    assert kinds(clock, [d]) == ['late']
    assert kinds(clock, [block(500), block(0)]) == ['next', 'start']
    verdict = clock.judge(block(300))
    assert (verdict.kind, verdict.missing) == (Kind.GAP, 200)
    assert 't = 0.015 s' in verdict.reason


def test_two_late_blocks_in_a_row(clock):
    order = [block(0), block(300), block(100), block(200), block(400)]
    assert kinds(clock, order) == ['start', 'gap', 'late', 'late', 'next']


def test_the_same_stream_once_more_is_no_repetition(clock):
    stream = [block(100 * k, value=0.0) for k in range(6)]
    assert kinds(clock, stream) == ['start'] + ['next'] * 5
    # the first block might be a repetition; the second one shows that it was not
    assert kinds(clock, stream) == ['repeat', 'start'] + ['next'] * 4


def test_a_long_gap_is_a_new_stream(clock):
    verdicts = [clock.judge(b) for b in (block(0), block(10100))]
    assert (verdicts[1].kind, verdicts[1].missing) == (Kind.GAP, 10000)
    verdict = clock.judge(block(20201))
    assert (verdict.kind, verdict.missing) == (Kind.START, 10001)


def test_a_small_jump_back_is_no_restart(clock):
    blocks = [block(100 * k) for k in range(30)]
    assert kinds(clock, blocks)[-1] == 'next'
    assert kinds(clock, [block(2500), block(2100)]) == ['late', 'late']
    assert kinds(clock, [block(1000), block(1100)]) == ['start', 'next']


def test_a_silence_and_an_end(clock):
    clock.judge(block(0))
    clock.pause()
    assert clock.head is None
    assert kinds(clock, [block(100)]) == ['start']
    clock.end()
    assert kinds(clock, [block(500)]) == ['start']


@pytest.mark.parametrize(
    ('t', 'reason'),
    [
        (np.arange(100) / 10000.0, 'sampled at 10000 Hz, expected are 20000 Hz'),
        (np.arange(100) / FS + 1e-5, 'not ticks of 20000 Hz in a row'),
        (np.array([0.0, 1.0, 2.0, 4.0]) / FS, 'not ticks'),
        (np.array([1.0, 0.0]) / FS, 'not ticks'),
        (np.array([0.0, math.nan]), 'not finite'),
        (np.array([1e300]), 'not finite'),
        (np.empty(0), 'empty'),
    ],
)
def test_stamps_off_the_clock(clock, t, reason):
    clock.judge(block(0))
    verdict = clock.judge(Samples(t, np.zeros(t.size), 'x'))
    assert verdict.kind is Kind.MALFORMED
    assert reason in verdict.reason
    # nothing of it stays
    assert kinds(clock, [block(100)]) == ['next']


def two():
    return [b'A', b'B']


@pytest.mark.parametrize('numbered', [True, False])
@pytest.mark.parametrize('offset', [0, 20, 100, 5000, 400000])
@pytest.mark.parametrize('ahead', [-34, 3, 4000])
def test_a_live_stream_is_not_taken_by_a_second_publisher(clock, numbered, offset, ahead):
    # alone at first; the other one is there when it sends its first block
    clock.judge(block(4000), 41 if numbered else None, lambda: [b'A'])
    for k in range(1, 30):
        mine, other = (k + 41, k + 42 + ahead) if numbered else (None, None)
        assert clock.judge(block(4000 + 100 * k), mine, two).kind is Kind.NEXT
        if offset == 100 and not numbered:
            continue  # the very next block of the stream: nothing could tell
        foreign = block(4000 + 100 * k + offset)
        assert clock.judge(foreign, other, two).kind is Kind.SECOND
    clock.pause()
    clock.end()
    assert clock.judge(block(0), 9999, two).kind is Kind.START


def test_a_second_publisher_at_the_number_of_the_first_is_known_by_its_own_count(clock):
    clock.judge(block(0), 500, lambda: [b'A'])
    for k in range(1, 60):
        # it sends twice as many blocks, and overtakes
        for j in (2 * k, 2 * k + 1):
            verdict = clock.judge(block(30 + 100 * j), 450 + j, two)
            assert verdict.kind is Kind.SECOND, k
        assert clock.judge(block(100 * k), 500 + k, two).kind is Kind.NEXT


def test_behind_a_silence_only_the_followed_publisher_comes_back(clock):
    clock.judge(block(0), 5, lambda: [b'A'])
    clock.pause()
    for number in (1, 2, 9):
        assert clock.judge(block(100), number, two).kind is Kind.SECOND
    assert clock.judge(block(100), 6, two).kind is Kind.START
    clock.pause()
    assert clock.judge(block(300), 9, lambda: [b'A']).kind is Kind.START
    clock.pause()
    clock.end()
    assert clock.judge(block(0), 3, lambda: [b'B']).kind is Kind.START
    assert clock.judge(block(400), 10, two).kind is Kind.SECOND
    # one that has gone does not come back
    clock.pause()
    assert clock.judge(block(0), 11, lambda: [b'A']).kind is Kind.START
    assert clock.judge(block(400), 10, two).kind is Kind.SECOND


def test_where_the_followed_publisher_has_gone_nobody_goes_on_in_its_stead(clock):
    clock.judge(block(0), 5, lambda: [b'A'])
    assert clock.judge(block(200), 7, lambda: [b'B']).kind is Kind.SECOND
    # its own last block may still come
    assert clock.judge(block(100), 6, lambda: [b'B']).kind is Kind.NEXT


def test_a_loss_beside_a_second_publisher_ends_the_stream(clock):
    clock.judge(block(500), 5, two)
    assert clock.judge(block(0), 6, two).kind is Kind.START
    # a message that held no block has a number all the same
    clock.skip(7)
    assert clock.judge(block(100), 8, two).kind is Kind.NEXT
    assert clock.judge(block(400), 11, two).kind is Kind.SECOND
    # once it is alone again a loss is a gap
    assert clock.judge(block(200), 9, lambda: [b'A']).kind is Kind.NEXT
    assert clock.judge(block(500), 12, lambda: [b'A']).kind is Kind.GAP


@pytest.mark.parametrize('burst', [1, 3])
def test_nobody_drives_where_two_of_one_number_and_time_cannot_be_told_apart(clock, burst):
    taken = []
    for k in range(0, 30, burst):
        for value in (1.0, 2.0):
            for j in range(k, k + burst):
                verdict = clock.judge(block(100 * j, value=value), 41 + j, two)
                taken += [value] if verdict.is_taken else []
    # what came before anybody could know, and nothing torn
    assert taken == [1.0] * burst
    clock.pause()
    clock.end()
    assert clock.judge(block(3000), 71, lambda: [b'A']).kind is Kind.START
    # a number and a time at which another one has been in an earlier stream say nothing
    assert clock.judge(block(3100), 72, lambda: [b'A']).kind is Kind.NEXT


def test_a_clock_that_goes_ahead_by_more_than_a_day_is_another_one():
    clock, t = BlockClock(), np.arange(100) / FS
    steps = [t, t + 0.01, t + 1e9, t + 0.01]
    assert [clock.judge(x)[0].value for x in steps] == ['start', 'gap', 'start', 'start']
    assert (clock.lost, clock.restarts) == (100, 2)


def test_a_stream_of_single_samples_has_a_period():
    clock = BlockClock()
    kinds = [clock.judge(np.array([k / 1000.0]))[0] for k in (0, 1, 2, 5)]
    assert kinds == [Kind.START, Kind.NEXT, Kind.NEXT, Kind.GAP]
    assert clock.period == 1e-3 and clock.lost == 2
