# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Lower a cost by Gauss-Newton steps with damping.

A step that fails is tried again with more damping: D. W. Marquardt, J. Soc. Indust. Appl. Math.
11(2), 1963, pp. 431-441, doi:10.1137/0111030.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import math
from typing import TypeVar

from piezo_ident.common.errors import ModelError

T = TypeVar('T')
L = TypeVar('L')


@dataclass(frozen=True)
class DampingSchedule:
    """
    Damping of the steps, as a share of the energy of each column, and the end of a descent.

    The damping begins at `first`.  A failed step multiplies it by `worse`.  A good step divides it
    by `better`, but keeps it above `least`.

    A descent ends after `tries` failed steps in turn, and when the damping reaches `most`.  It
    also ends after `slow_steps` slow steps in turn.  A slow step lowers the cost by less than the
    share `slow` of it, or by less than `enough`.
    """

    first: float
    least: float
    worse: float
    better: float
    tries: int = 100
    most: float = math.inf
    slow: float = 0.0
    enough: float = 0.0
    slow_steps: int = 1


def descend(
    point: T,
    cost: Callable[[T], float],
    linearise: Callable[[T], L],
    step: Callable[[T, L, float], T | None],
    schedule: DampingSchedule,
    iterations: int,
    tick: Callable[[], None] = lambda: None,
) -> T:
    """
    Lower the cost of a point by damped steps.

    `linearise` computes the equations of a point; `step` moves the point by them and a damping.  A
    step fails if it does not lower the cost, or raises ModelError.  A step of None ends the
    descent.  A point of infinite cost stays.  `tick` is called once an iteration; it may raise.
    """
    now, damping, slow = cost(point), schedule.first, 0
    for _ in range(iterations if math.isfinite(now) else 0):
        tick()
        equations, before = linearise(point), now
        for _ in range(schedule.tries):
            with suppress(ModelError):
                trial = step(point, equations, damping)
                if trial is None:
                    return point
                now = cost(trial)
                if now < before:
                    break
            damping *= schedule.worse
            if damping >= schedule.most:
                return point
        else:
            return point
        point = trial
        damping = max(damping / schedule.better, schedule.least)
        slow = slow + 1 if before - now < max(schedule.slow * before, schedule.enough) else 0
        if slow == schedule.slow_steps:
            break
    return point
