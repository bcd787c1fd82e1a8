# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Refits of H, as a sum of plays and as wider laws, and the effects found beside them.

The hysteresis of a piezo is never a sum of plays.  What goes with a wider law is no effect, and
what follows the path of the command alone may hide in one: see `ForwardSelection.beside`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.cross_validation import fitted_gain, refit_holds
from piezo_ident.diagnosis.forward_selection import ForwardSelection
from piezo_ident.diagnosis.joint_fit import (
    base_at,
    fit_base,
    fit_jointly,
    Fitted,
    is_better,
    may_be_better,
)
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.results import OtherGain
from piezo_ident.diagnosis.retuning import RETUNING
from piezo_ident.diagnosis.rows import centred, Rows
from piezo_ident.diagnosis.search import gains_of, Selected
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State, WANDERS
from piezo_ident.diagnosis.toward_given import loops
from piezo_ident.diagnosis.trial_scores import best_trials
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.effects import catalogue, find_effect
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName, LAWS

#: times the error of the given model that an H of records without kinds of motion may be off it
LOOSE = 2.0


def refits(simulator: Simulator, given: State) -> tuple[Fitted, Fitted]:
    """
    Return H refitted as plays on a fine grid, and as the widest law.

    A voltage that never moves raises IdentificationError.
    """
    if max(float(np.ptp(run.u)) for run in simulator.rows.runs) == 0.0:
        raise IdentificationError('the voltage never moves; record the stage while it is driven')
    return refit_of(simulator, given, 'plays'), refit_of(simulator, given, LAWS[-1])


def base_thresholds(swing: float) -> Array:
    """Return nineteen even thresholds over the swing, and four fine ones near zero."""
    fine = np.array([0.005, 0.012, 0.025, 0.037])
    return swing * np.concatenate([fine, np.arange(1, 20) / 20.0])


def _is_loose(simulator: Simulator, given: State, fitted: Fitted) -> bool:
    """
    Return whether H is off the given one, but for its gain, by `LOOSE` times what that errs by.

    Of data without kinds of motion nothing else tells what it does under other motion: lags along
    the path may grow, and make up for one another on the motion that was fitted alone.
    """
    rows, model = simulator.rows, simulator.model
    if rows.kinds:
        return False
    u = loops(*map(float, model.scaling.u(rows.driven)))
    one, other = (h(u) - float(h(u).mean()) for h in (fitted.state.hysteresis, given.hysteresis))
    # slow creep takes a part of the gain
    off = one - other * float(one @ other) / max(float(other @ other), 1e-300)
    e = centred(rows.x - simulator.run(given), rows.of_record)
    return float(np.mean((model.dynamics.gain * off) ** 2)) > LOOSE**2 * float(np.mean(e * e))


def refit_of(simulator: Simulator, state: State, name: LawName) -> Fitted:
    """Return H refitted as one of a family, effects and G as they are."""
    low, high = simulator.rows.reach
    swing = max(float(np.ptp(run.u)) for run in simulator.rows.runs)
    law = HysteresisLaw(name, base_thresholds(swing), (min(low, 0.0), max(high, 1.0)))
    return fit_jointly(simulator, *fit_base(simulator, state, law))


def effects_beside(
    simulator: Simulator, given: State, search: ForwardSelection, plays: Fitted, wide: Fitted
) -> tuple[Fitted, Selected]:
    """Return the effects found, fitted with the narrowest law that serves, and their base."""
    base, selected = _selected(simulator, given, search, plays, wide)
    fitted = selected.fitted
    if simulator.holds_retuning(fitted.state):
        return base, selected
    state = replace(fitted.state, retuning=())
    return base, replace(selected, fitted=fit_jointly(simulator, state, fitted.base))


def _selected(
    simulator: Simulator, given: State, search: ForwardSelection, plays: Fitted, wide: Fitted
) -> tuple[Fitted, Selected]:
    found = search.run(wide)
    beside, widest = plays, wide
    if found.taken:
        beside, widest = refit_of(simulator, found.fitted.state, 'plays'), found.fitted
    known = found.fitted.state
    start = replace(given, effects=known.effects, fading=known.fading, earlier=known.earlier)
    if simulator.is_fast:
        start = replace(start, retuning=(0.0,) * len(RETUNING))
    as_given = fit_jointly(
        simulator,
        start,
        base_at(simulator, start),
        # whether it leaves little shows before the end
        enough=criteria.OF_LEAST * simulator.rows.square(criteria.SMALLEST_EFFECT),
        # more than plays leave says nothing
        goal=beside.mean_square,
    )
    both = search.beside(beside, widest, as_given, found)
    if both.imitated in both.taken:
        return plays, both
    fitted = both.fitted
    if not found.taken:
        # no effect is needed for G to be a little off
        again = search.retuned(wide)
        fitted = again if is_better(again, wide) else wide
    # without effects the whole weight of the given H holds a refit, and what the widest law takes
    # is no sign of one
    if found.taken and _is_loose(simulator, given, fitted):
        fitted = refit_of(simulator, fitted.state, 'preisach')
    narrow = beside if found.taken else refit_of(simulator, fitted.state, 'plays')
    fitted = _narrowest(simulator, narrow, fitted)
    gain, most = (wide.mean_square - one.mean_square for one in (fitted, both.fitted))
    if found.taken and gain < criteria.ADDED * most:
        # what the effects explain is judged against the widest law without them
        fitted = both.fitted
    return wide, replace(both, fitted=fitted)


def _narrowest(simulator: Simulator, plays: Fitted, wide: Fitted) -> Fitted:
    """Return the fit of the narrowest law that no wider one beats."""
    if not may_be_better(wide, plays):
        return plays
    between = refit_of(simulator, wide.state, 'preisach')
    if not any(is_better(wider, plays) for wider in (between, wide)):
        return plays
    return wide if is_better(wide, between) else between


def with_refit(
    simulator: Simulator,
    given: State,
    findings: Findings,
    selected: Selected,
    noise: float,
    misfit: float,
    *,
    is_large: bool,
) -> Findings:
    """
    Return what H alone accounts for, where no effect was found.

    That a refit of it brought what there was to gain is a finding; and what a wider H takes, the
    rms `misfit` [% of stroke], a refit or a retuned G may hide effects.  `noise` is the mean
    square of the noise of a row; a refit `is_large` that takes most of what the model misses.
    """
    rows, refit = simulator.rows, selected.fitted
    e = rows.x - simulator.run(given)
    before = float(np.mean(e * e))
    if is_large:
        unsettled = findings.unsettled(rows.percent(before - noise))
        if not refit_holds(rows, e, refit.transfer):
            # other motion does not bear it out, and yet the given model errs
            return unsettled
        wanders = _wanders(rows, selected, noise)
        other = _gain(simulator, given, refit, noise, wanders=wanders)
        if other is not None and not selected.linear:
            # of another record a gain that wanders says nothing
            of_gain = replace(unsettled, gain=other)
            return of_gain.hiding((WANDERS, *look_alikes(WANDERS)[:1]))
        left = rows.percent(refit.mean_square - noise)
        findings = replace(findings, verdict='refitted', left=left)
    elif misfit < criteria.REFIT_FINDING and not selected.linear:
        return findings
    return findings.hiding(_hidden(simulator, given, selected, findings.verdict == 'refitted'))


def _wanders(rows: Rows, selected: Selected, noise: float) -> bool:
    """Return whether a gain that wanders takes a part of what a refit of H leaves."""
    return any(
        gains_of(rows, one).get(WANDERS, 0.0)
        > criteria.WANDERING * (one.before.mean_square - noise)
        for one in selected.rounds
    )


def _gain(
    simulator: Simulator, given: State, refit: Fitted, noise: float, *, wanders: bool
) -> OtherGain | None:
    """
    Return the gain that takes most of what a refit takes, if one does: no other loop is one.

    It is another loop where the refit predicts other kinds of excitation better than the gain, and
    that does not go on to wander: without labels a gain that drifts looks like one.  Beyond the
    range of the given model its wide plays are unknown, and look like a gain.
    """
    rows, x = simulator.rows, simulator.run(given)
    # a branch passed once has no second half, as for any effect
    if rows.passes < criteria.PASSES or rows.leaves(simulator.model.scaling.range):
        return None
    e = centred(rows.x - x, rows.of_record)
    gain, taken = fitted_gain(rows, x, e)
    missed = float(e @ e)
    whole = missed - float(refit.errors.sum())
    if taken <= criteria.ADDED * whole:
        return None
    is_large = rows.percent((whole - taken) / rows.n) >= criteria.REFIT_FINDING
    with_gain = e - (gain - 1.0) * centred(x, rows.of_record)
    may_be_loop = bool(rows.kinds) and is_large and not wanders
    if may_be_loop and refit_holds(rows, with_gain, refit.transfer):
        return None
    return OtherGain(gain, taken / max(missed - noise * rows.n, taken))


def _hidden(
    simulator: Simulator, given: State, selected: Selected, is_found: bool
) -> tuple[str, ...]:
    """
    Return the effects that G or H may hide, the likeliest first: none, or two and more.

    Those of H gain something beside plays, or, added to the model as it was given, take half of
    what a refit takes.  Where a refit is the finding, `is_found`, the latter come first: what they
    leave is the whole change since the identification, what plays leave is a small part of it.
    """
    refit, imitated = selected.fitted, selected.imitated
    beside = list[str]()
    if imitated is not None:
        before = imitated.before.mean_square
        most = sorted(imitated.contenders, key=lambda c: c.mean_square)
        beside = [c.name for c in most if before - c.mean_square > criteria.LEAST_GAIN * before]
    instead = _instead(simulator, given, refit)
    names = [*instead, *beside] if is_found else [*beside, *instead]
    names = list(dict.fromkeys([*selected.linear, *names]))
    if len(names) == 1:
        names += [n for n in look_alikes(names[0]) if find_effect(n).rate_independent][:1]
    return tuple(names[: criteria.CLASS_SIZE]) if len(names) > 1 else ()


def _instead(simulator: Simulator, given: State, refit: Fitted) -> list[str]:
    """Return the effects, best first, that do half of what a refit does."""
    rows = simulator.rows
    e = centred(rows.x - simulator.run(given), rows.of_record)
    base = base_at(simulator, given)
    count = base.columns.shape[1]
    start = replace(
        refit,
        state=given,
        base=base,
        e=e,
        moving=np.empty((rows.n, 0)),
        free=np.ones(count, bool),
        prior=np.zeros(count),
    )
    effects = [effect for effect in catalogue().values() if effect.rate_independent]
    best = best_trials(simulator, start, effects, ())
    left = {name: scored.error for name, scored in best.items()}
    whole, least = float(e @ e), float(refit.errors.sum())
    found = [name for name, x in left.items() if whole - x > 0.5 * (whole - least)]
    return sorted(found, key=lambda name: left[name])
