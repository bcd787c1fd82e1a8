# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A descent ends at the least cost, and at each end that its schedule describes."""

from dataclasses import replace
import math

from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.damped import DampingSchedule, descend
import pytest

SCHEDULE = DampingSchedule(first=1e-2, least=1e-3, worse=4.0, better=10.0, slow=1e-6)


def descended(start, schedule=SCHEDULE, step=None, iterations=50):
    """Descend to the root of exp(x) - 2; return the end and the dampings of all steps."""
    dampings = []

    def newton(x, slope, damping):
        dampings.append(damping)
        return x - (math.exp(x) - 2.0) / (slope * (1.0 + damping)) if step is None else step(x)

    end = descend(
        start, lambda x: (math.exp(x) - 2.0) ** 2, math.exp, newton, schedule, iterations
    )
    return end, dampings


def test_the_least_cost_is_found_and_the_damping_falls_to_its_least():
    end, dampings = descended(2.0)
    assert end == pytest.approx(math.log(2.0), abs=1e-9)
    assert dampings[:3] == [1e-2, 1e-3, 1e-3]
    assert descended(2.0, iterations=1)[0] > end
    assert descended(2.0, iterations=0) == (2.0, [])


def test_a_failed_step_is_tried_with_more_damping():
    # the first step overshoots, by far
    end, dampings = descended(-3.0)
    assert dampings[:3] == [1e-2, 4e-2, 16e-2]
    assert end == pytest.approx(math.log(2.0), abs=1e-9)


@pytest.mark.parametrize('ends', [{'tries': 3}, {'most': 0.3}])
def test_a_descent_ends_after_its_tries_and_at_its_largest_damping(ends):
    def fails(x):
        raise ModelError('no model there')

    for step in (fails, lambda x: x):
        end, dampings = descended(2.0, replace(SCHEDULE, **ends), step)
        assert end == 2.0 and dampings == [1e-2, 4e-2, 16e-2]


@pytest.mark.parametrize('slow', [{'slow': 1.0}, {'enough': 1e3}])
def test_a_descent_ends_after_its_slow_steps(slow):
    assert len(descended(2.0, replace(SCHEDULE, **slow))[1]) == 1
    assert len(descended(2.0, replace(SCHEDULE, slow_steps=3, **slow))[1]) == 3


def test_no_step_is_taken_if_none_is_worth_it_or_the_start_has_no_cost():
    assert descended(2.0, step=lambda x: None) == (2.0, [1e-2])
    assert descend(1.0, lambda x: math.inf, None, None, SCHEDULE, 9) == 1.0
