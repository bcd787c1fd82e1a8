# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""How far a sender is ahead: what counts as an answer, and whose."""

import math

from hypothesis import given
from hypothesis import strategies as st
from piezo_ident.live.flow import FlowControl, MEMORY


def sent(flow: FlowControl, n: int, begin: int = 0) -> None:
    for k in range(begin, begin + n):
        flow.sent(k, k + 0.75)


def test_only_who_answers_is_waited_for():
    flow = FlowControl('a')
    assert flow.ahead == 0
    sent(flow, 4)
    assert flow.ahead == 4 and flow.slowest == 'a'
    flow.heard('a', 3.75)
    assert flow.ahead == 0 and flow.answering == ('a',)
    sent(flow, 4, 4)
    flow.heard('a', 7.75)
    flow.heard('b', 5.75)
    assert flow.ahead == 2 and flow.slowest == 'b'
    assert flow.answering == ('a', 'b') and flow.last_time('b') == 5.75


def test_who_leaves_is_waited_for_no_more():
    flow = FlowControl()
    sent(flow, 3)
    assert flow.ahead == 0 and flow.slowest == ''
    flow.heard('a', 0.75)
    assert flow.ahead == 2 and flow.slowest == 'a'
    flow.leave('a')
    assert flow.ahead == 0 and flow.answering == ()


def test_who_is_expected_is_waited_for_at_once():
    flow = FlowControl()
    sent(flow, 3)
    flow.expect('a')
    sent(flow, 2, 3)
    assert flow.ahead == 2
    flow.heard('a', 4.75)
    flow.expect('a')
    assert flow.ahead == 0


def test_part_of_a_block_is_no_answer_to_it():
    flow = FlowControl('a')
    sent(flow, 3)
    flow.heard('a', 1.5)
    assert flow.ahead == 2
    flow.heard('a', 1.75)
    assert flow.ahead == 1


def test_what_was_never_sent_is_no_answer():
    flow = FlowControl('a')
    sent(flow, 3)
    for t in (9.0, 1.9, -1.0, math.nan, math.inf):
        flow.heard('a', t)
    assert flow.ahead == 3 and math.isnan(flow.last_time('a')) and flow.answering == ()


def test_a_block_twice_is_answered_at_once():
    flow = FlowControl('a')
    sent(flow, 2)
    sent(flow, 1, 1)
    flow.heard('a', 1.5)
    assert flow.ahead == 2
    flow.heard('a', 1.75)
    assert flow.ahead == 0


def test_where_the_clock_starts_over_the_earlier_block_is_meant():
    flow = FlowControl('a')
    sent(flow, 3)
    sent(flow, 3)
    flow.heard('a', 1.75)
    assert flow.ahead == 4
    # the end of the first run was not heard of
    flow.heard('a', 0.75)
    assert flow.ahead == 2
    flow.heard('a', 2.75)
    assert flow.ahead == 0


def test_a_late_comer_is_not_charged_with_what_it_never_got():
    flow = FlowControl('a')
    for k in range(3 * MEMORY):
        sent(flow, 1, k)
        flow.heard('a', k + 0.75)
    flow.heard('b', 3 * MEMORY - 2 + 0.75)
    assert flow.ahead == 1 and flow.slowest == 'b'


@given(st.lists(st.integers(0, 40), max_size=60), st.integers(1, 90))
def test_a_sender_that_heeds_it_is_never_further_ahead(delays, limit):
    flow, done, n = FlowControl('a'), 0, 0
    for delay in delays:
        while flow.ahead < limit:
            sent(flow, 1, n)
            n += 1
        done = max(done, min(n, n - delay))
        if done:
            flow.heard('a', done - 1 + 0.75)
        assert flow.ahead == n - done <= limit
