# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""What a block is to the stream that is followed."""

import math

import numpy as np
from piezo_ident.live.pacing import BlockClock, LogClock, SLIP
from piezo_ident.live.sample_clock import Follower, Kind
from piezo_ident.record.blocks import Samples
import pytest

FS = 20000.0
RNG = np.random.default_rng(0)


def block(tick, n=100, value=None):
    values = RNG.random(n) if value is None else np.full(n, value)
    return Samples(np.arange(tick, tick + n) / FS, values, 'x')


def kinds(follower, blocks, **more):
    return [follower.judge(b, **more).kind.value for b in blocks]


def test_a_stream_in_order():
    follower = Follower(FS, 0.5)
    assert kinds(follower, [block(0), block(100, 7), block(107), block(207, 1)]) == [
        'start',
        'next',
        'next',
        'next',
    ]
    assert follower.head == 208


def test_ticks_are_told_after_days():
    follower = Follower(FS, 0.5)
    k = 20000 * 86400 * 5
    assert kinds(follower, [block(k), block(k + 100)]) == ['start', 'next']


def test_gap_repeat_swap_restart():
    follower = Follower(FS, 0.5)
    a, b, c, d, e = (block(100 * k) for k in range(5))
    assert kinds(follower, [a, b, b, c]) == ['start', 'next', 'repeat', 'next']
    assert kinds(follower, [e]) == ['gap']
    # it fits into the gap, but its time is over
    assert kinds(follower, [d]) == ['late']
    assert kinds(follower, [block(500), block(0)]) == ['next', 'start']
    verdict = follower.judge(block(300))
    assert (verdict.kind, verdict.missing) == (Kind.GAP, 200)
    assert 't = 0.015 s' in verdict.reason


def test_two_late_blocks_in_a_row():
    follower = Follower(FS, 0.5)
    order = [block(0), block(300), block(100), block(200), block(400)]
    assert kinds(follower, order) == ['start', 'gap', 'late', 'late', 'next']


def test_the_same_stream_once_more_is_no_repetition():
    follower = Follower(FS, 0.5)
    stream = [block(100 * k, value=0.0) for k in range(6)]
    assert kinds(follower, stream) == ['start'] + ['next'] * 5
    # the first block might be a repetition; the second one shows that it was not
    assert kinds(follower, stream) == ['repeat', 'start'] + ['next'] * 4


def test_a_long_gap_is_a_new_stream():
    follower = Follower(FS, 0.5)
    verdicts = [follower.judge(b) for b in (block(0), block(10100))]
    assert (verdicts[1].kind, verdicts[1].missing) == (Kind.GAP, 10000)
    verdict = follower.judge(block(20201))
    assert (verdict.kind, verdict.missing) == (Kind.START, 10001)


def test_after_silence_anything_is_new():
    follower = Follower(FS, 0.5)
    follower.judge(block(0))
    follower.lose()
    assert follower.head is None
    assert kinds(follower, [block(100)]) == ['start']


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
def test_stamps_off_the_clock(t, reason):
    follower = Follower(FS, 0.5)
    follower.judge(block(0))
    verdict = follower.judge(Samples(t, np.zeros(t.size), 'x'))
    assert verdict.kind is Kind.MALFORMED
    assert reason in verdict.reason
    # nothing of it stays
    assert kinds(follower, [block(100)]) == ['next']


@pytest.mark.parametrize('numbered', [True, False])
@pytest.mark.parametrize('offset', [0, 100, 5000, 400000])
def test_the_first_of_two_publishers_is_followed(numbered, offset):
    follower = Follower(FS, 0.5)
    follower.judge(block(4000), 41 if numbered else None, 2)
    for k in range(1, 30):
        mine, other = (k + 41, k + 7) if numbered else (None, None)
        assert follower.judge(block(4000 + 100 * k), mine, 2).kind is Kind.NEXT
        if not (offset == 100 and not numbered):
            verdict = follower.judge(block(4000 + 100 * k + offset), other, 2)
            assert verdict.kind is Kind.SECOND
    follower.lose()
    assert follower.judge(block(0), 99, 2).kind is Kind.START


def test_the_followed_publisher_may_start_over_and_lose_blocks_beside_another():
    follower = Follower(FS, 0.5)
    follower.judge(block(500), 5, 2)
    assert follower.judge(block(0), 6, 2).kind is Kind.START
    assert follower.judge(block(300), 9, 2).kind is Kind.GAP
    # a message that held no block has a number all the same
    follower.skip(10)
    assert follower.judge(block(400), 11, 2).kind is Kind.NEXT


def test_a_clock_does_not_drift_but_slips_after_a_long_delay():
    clock = BlockClock(FS, 100.0)
    assert clock.due(20000 * 3600) == 3700.0
    clock.note(100, 100, clock.due(100) + 0.001)
    assert (clock.late, clock.slipped) == (0, 0.0)
    clock.note(200, 100, clock.due(200) + 0.006)
    assert (clock.late, clock.slipped) == (1, 0.0)
    due = clock.due(400)
    clock.note(300, 100, clock.due(300) + SLIP + 0.1)
    assert clock.slipped == pytest.approx(SLIP + 0.1)
    assert clock.due(400) == pytest.approx(due + SLIP + 0.1)
    assert clock.worst == pytest.approx(SLIP + 0.1)
    assert BlockClock(0.0, 5.0).due(10**9) == 5.0


class Machine:
    """A machine whose clock can be set."""

    def __init__(self):
        self.steady, self.ahead = 5 * 10**9, 1_700_000_000 * 10**9

    def wall(self):
        return self.steady + self.ahead

    def clock(self):
        return LogClock(self.wall, lambda: self.steady)


@pytest.mark.parametrize('step', [-3_600.0, -1.0, -0.02, 0.02, 1.0, 86_400.0])
def test_log_times_go_on_evenly_when_the_clock_is_set(step):
    machine = Machine()
    clock, stamps, waiting = machine.clock(), [], []
    for k in range(100):
        # a block every 5 ms, taken every 20 ms; the clock is set between two of them
        machine.steady += 5_000_000
        if k in (41, 70):
            machine.ahead += int(step * 1e9)
        waiting.append(machine.wall())
        if k % 4 == 3:
            clock.look()
            stamps += [clock.stamp(arrival) for arrival in waiting]
            waiting = []
    assert np.all(np.diff(stamps) == 5_000_000)
    assert clock.set_by == 2 * int(step * 1e9)


def test_log_times_are_those_of_arrival_while_nobody_sets_the_clock():
    machine = Machine()
    clock = machine.clock()
    # a clock that is slowed down is followed by the steady one too; what is left is no step
    machine.ahead += 400_000
    clock.look()
    assert clock.stamp(machine.wall()) == machine.wall() and clock.set_by == 0
