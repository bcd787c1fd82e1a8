# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The safety property of the drive, on generated command sequences.

Whatever arrives, the voltage applied keeps to limits and slew; what that means in full, and the
generator, is in benchmarks/reliability/safety.py, which `make attack` runs 10^5 times.
"""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from piezo_ident.live.guard import GuardSettings
import pytest
from safety import Broken, check, run, sequence

#: 1 V a sample
USUAL = GuardSettings(0.0, 10.0, slew=1000.0, ramp_slew=20.0, rest=0.0, sample_rate=1000.0)


def test_it_holds_in_the_first_sequences():
    met = run(0, 600)
    # the generator reaches all that it is meant to reach
    for kind in ('next', 'start', 'gap', 'repeat', 'late', 'second', 'malformed', 'silence'):
        assert met[kind], kind
    assert met['settings'] and met['samples'] > 20_000


@settings(max_examples=150, deadline=None)
@given(st.integers(3000, 2**60))
def test_it_holds_in_any_other(seed):
    sequence(seed)


@pytest.mark.parametrize(
    ('before', 'v', 'why'),
    [
        (0.0, [1.0, 2.1], 'a step of 1.1 V'),
        (9.5, [10.2, 10.0], 'outside the limits'),
        (0.0, [np.nan], 'not a number'),
        (14.0, [13.5, 12.5], 'outside the limits'),
        (12.0, [11.0, 10.0, 11.0], 'outside the limits'),
    ],
)
def test_the_check_sees_what_is_wrong(before, v, why):
    with pytest.raises(Broken, match=why):
        check(USUAL, before, np.array(v), 'x')


@pytest.mark.parametrize(
    ('before', 'v'), [(0.0, [1.0, 0.0]), (12.5, [11.5, 10.5, 10.0, 9.0]), (-0.5, [0.0, 0.0])]
)
def test_the_check_lets_pass_what_is_right(before, v):
    check(USUAL, before, np.array(v), 'x')
