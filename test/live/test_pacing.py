# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""When blocks are due, and when they arrived."""

import numpy as np
from piezo_ident.live.pacing import ArrivalClock, Looks, Pace, Schedule, SLIP
import pytest

FS = 20_000.0


def test_a_schedule_does_not_drift_but_slips_after_a_long_delay():
    schedule = Schedule(FS, 100.0)
    assert schedule.due(20000 * 3600) == 3700.0
    schedule.note(100, 100, schedule.due(100) + 0.001)
    assert (schedule.late, schedule.slipped) == (0, 0.0)
    schedule.note(200, 100, schedule.due(200) + 0.006)
    assert (schedule.late, schedule.slipped) == (1, 0.0)
    due = schedule.due(400)
    schedule.note(300, 100, schedule.due(300) + SLIP + 0.1)
    assert schedule.slipped == pytest.approx(SLIP + 0.1)
    assert schedule.due(400) == pytest.approx(due + SLIP + 0.1)
    assert schedule.worst == pytest.approx(SLIP + 0.1)


def test_what_is_caught_up_with_at_once_is_limited():
    schedule, now, sent = Schedule(4.0, 0.0, slip=SLIP / 4), 0.0, []
    for k in range(400):
        now = max(now, schedule.due(k * 0.005))
        if k == 50:
            now += 0.5
        sent.append(now)
        schedule.note(k * 0.005, 0.0, now)
    assert sum(gap < 1e-4 for gap in np.diff(sent)) <= 50
    assert schedule.slipped == pytest.approx(0.5)


def test_a_change_of_speed():
    schedule = Schedule(1.0, 0.0)
    schedule.change_speed(4.0, 1.0, now=1.0)
    assert schedule.due(2.0) == pytest.approx(1.25)


def test_a_process_that_was_held_up_takes_its_own_pause_for_no_silence(monkeypatch):
    now = [10.0]
    monkeypatch.setattr('time.monotonic', lambda: now[0])
    looks = Looks()

    def look(at: float, since: float) -> bool:
        now[0] = at
        looks.look()
        return looks.is_over(since, 0.5)

    assert not look(10.1, 10.0)
    # held up for a second: what was sent meanwhile is heard before the next look
    assert not look(11.1, 10.0)
    assert not look(11.15, 11.12)
    # looks as they should be: over as soon as the limit has passed
    assert [look(11.15 + 0.05 * k, 11.12) for k in range(8, 11)] == [False, False, True]
    # slow looks, and nothing comes
    assert [look(12.0 + 0.6 * k, 11.9) for k in range(3)] == [False, False, True]


class Machine:
    """A machine whose clock can be set."""

    def __init__(self):
        self.steady, self.ahead = 5 * 10**9, 1_700_000_000 * 10**9

    def wall(self):
        return self.steady + self.ahead

    def clock(self):
        return ArrivalClock(self.wall, lambda: self.steady)


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


def test_a_pace_goes_on_where_it_was_after_a_pause(monkeypatch):
    looks = iter([5.0, 5.0, 5.01, 5.0101, 7.0, 7.01])
    with monkeypatch.context() as patch:
        patch.setattr('time.monotonic', lambda: next(looks))
        pace = Pace(FS, 0.05)
        due = [pace.due() for _ in range(5)]
    assert due == [0, 200, 2, 1000, 200]
