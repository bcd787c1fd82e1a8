# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What is concluded: effects beside a refitted H, one that set in since, or a refit of H alone.

A wide H imitates what follows the path of the command.  But the H of the identification is known:
where such an effect has set in since, that H and the effect do what a refit of H does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.base_refit import refit_of, with_refit
from piezo_ident.diagnosis.cross_validation import fitted_gain
from piezo_ident.diagnosis.forward_selection import ForwardSelection, TESTED, WIDE_LAW
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.search import gains_of, Selected, takes
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.toward_given import toward_given
from piezo_ident.diagnosis.verdict import Findings, judge
from piezo_ident.effects import find_effect
from piezo_ident.model.metrics import expected_error


@dataclass(frozen=True, eq=False)
class Conclusion:
    """
    What was found, and the fit that the refined model comes from.

    Attributes
    ----------
    findings : Findings
    selected : Selected
    before : Fitted
        What the effects were added to: H refitted, or the model as given.
    explainable : float
        Mean square that shares are of.
    last : Fitted
    """

    findings: Findings
    selected: Selected
    before: Fitted
    explainable: float
    last: Fitted


def conclude(
    simulator: Simulator,
    given: State,
    search: ForwardSelection,
    base: Fitted,
    selected: Selected,
    squares: tuple[float, float],
    misfit: float,
    tick: Callable[[], None],
) -> Conclusion:
    """
    Return what is concluded from the effects `selected` beside a refitted H, the `base`.

    `squares` are the mean squares of the noise of a row and of a sample, `misfit` what a wider H
    takes, rms in % of stroke.
    """
    noise, single = squares
    findings, last = judge(simulator.rows, base, selected, noise), selected.fitted
    # hum and another axis are there whatever H is
    if all(name in TESTED for name in findings.effects) and len(findings.effects) < 2:
        known = replace(given, effects=last.state.effects)
        is_large = _is_large(simulator, known, last, noise, single)
        if is_large:
            set_in = _set_in(simulator, given, known, search, selected, noise, tick)
            if set_in is not None:
                return set_in
        if not findings.effects:
            findings = with_refit(
                simulator, given, findings, selected, noise, misfit, is_large=is_large
            )
    if not findings.keeps_given:
        last = toward_given(simulator, given, last, tick)
    return Conclusion(findings, selected, base, max(base.mean_square - noise, 1e-300), last)


def _is_large(
    simulator: Simulator, known: State, refit: Fitted, noise: float, single: float
) -> bool:
    """Return whether a refit of H takes the larger part of what the known model misses."""
    rows = simulator.rows
    gain = float(np.mean((rows.x - simulator.run(known)) ** 2)) - refit.mean_square
    # noise moved the weights when they were identified, too
    is_large = rows.percent(gain - single) >= criteria.REFIT_FINDING
    return is_large and gain >= refit.mean_square - noise


def _set_in(
    simulator: Simulator,
    given: State,
    known: State,
    search: ForwardSelection,
    selected: Selected,
    noise: float,
    tick: Callable[[], None],
) -> Conclusion | None:
    """
    Return the effect that does, beside the H as given, what a refit of H does.

    `known` is the model as `given` with what tests of their own have shown.
    Without kinds of motion to hold out, the noncongruence that H missed of the loops when it was
    identified looks like that effect.
    """
    rows, law = simulator.rows, selected.fitted.state.law
    # a branch passed once has no second half, as for any effect
    if law is None or rows.passes < criteria.PASSES:
        return None
    # that one of these has changed since may look like another one
    if any(find_effect(setting.name).rate_independent for setting in simulator.model.effects):
        return None
    before = fit_jointly(simulator, known, base_at(simulator, known))
    this = search.of_path(before)
    level, least = before.mean_square, max(noise, selected.fitted.mean_square)
    whole = level - least
    if not this.contenders or not takes(
        rows, this, level, least, whole, criteria.REFIT_FINDING, first=True
    ):
        return None
    best, gains = this.contenders[0], gains_of(rows, this)
    follow = [name for name in gains if find_effect(name).rate_independent]
    alike = [name for name in follow if gains[name] >= criteria.SET_IN * whole]
    alike.sort(key=lambda name: -gains[name])
    if best.name not in alike or _may_be_a_gain(simulator, before, gains, whole):
        return None
    if alike == [WIDE_LAW] and (
        not rows.kinds
        or this.gain < criteria.NONCONGRUENT * whole
        or rows.percent(level) < criteria.BEYOND_MATERIAL * (expected_error(simulator.model) or 0)
    ):
        return None
    first, shown = before, selected.taken
    if shown:
        first = fit_jointly(simulator, given, base_at(simulator, given))
        shown = (replace(shown[0], before=first, contenders=(before,), best={}),)
    found = replace(
        selected, rounds=(*selected.rounds, this), taken=(*shown, this), fitted=best, linear=()
    )
    # no law is so sure that another one that would do, were it alone, is not the cause
    findings = judge(rows, first, found, least, alike)
    # lags along the path may grow where no other kind of motion holds them
    both = refit_of(simulator, best.state, law.name if rows.kinds else 'preisach')
    both = toward_given(simulator, given, both, tick, set_in=True)
    last = both if both.transfer.sum() < best.transfer.sum() else best
    left = rows.percent(max(last.mean_square - noise, 0.0))
    findings = replace(findings, left=left, of_refit=whole)
    return Conclusion(findings, found, first, first.mean_square - least, last)


def _may_be_a_gain(
    simulator: Simulator, before: Fitted, gains: dict[str, float], whole: float
) -> bool:
    """
    Return whether another gain, one that wanders, or creep does nearly as much as the best.

    Without kinds of motion to hold out they must do much less.
    """
    rows, x = simulator.rows, simulator.run(before.state)
    others = [gain for name, gain in gains.items() if not find_effect(name).rate_independent]
    others.append(fitted_gain(rows, x, rows.x - x)[1] / rows.n)
    best = max(gain for name, gain in gains.items() if find_effect(name).rate_independent)
    floor = rows.square(criteria.INDISTINCT)
    left, other = (max(whole - gain, 0.0) + floor for gain in (best, max(others)))
    return other <= (criteria.AHEAD if rows.kinds else criteria.FORM_RATIO) * left
