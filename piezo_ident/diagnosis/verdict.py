# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Judge the decision: the findings, their certainty, and the questions that the data leave open.

The set of effects that was taken is named.  The verdict is a class if the set has rivals, or
look-alikes that were no candidates.  If the set leaves more than `LITTLE` of the error, and at
least `SMALLEST_EFFECT`, it explains a part.  If no set was taken, the H of `refits.walk` is the
finding if it gains `SMALLEST_EFFECT`.  Effects that explain nearly as much may hide in this H.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.diagnosis.criteria import CLASS_SIZE, PASSES, SMALLEST_EFFECT, SWALLOWED, TAKES
from piezo_ident.diagnosis.decision import Candidates, change_g, Decision, FittedSet
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.next_experiment import look_alikes, separating_experiment
from piezo_ident.diagnosis.results import (
    Candidate,
    Class,
    DiagnosisSettings,
    OtherGain,
    REFITTED,
    RETUNED,
    Unexplained,
    UNNAMED,
    Untestable,
)
from piezo_ident.diagnosis.search import Round
from piezo_ident.effects import catalogue, find_effect


@dataclass(frozen=True, eq=False)
class Findings:
    """
    Judgement in numbers and names.

    Attributes
    ----------
    verdict : str
    effects, gains : tuple of str, tuple of float
        Effects that were added, in order, and the mean square that each explains.
    group : Class or None
    explainable : float
        Error to explain, a mean square (`Decision.whole`).  With effects of tests of their own, at
        least the error of the best H without them.
    share, left : float
        Share of the explainable error that everything added explains, and the error left beyond
        the noise, rms in % of stroke.
    gain : OtherGain or None
        The other gain, if it explains the error as well as a refit of H.
    set_in : bool
        Whether an effect has set in since the identification.
    """

    verdict: str
    effects: tuple[str, ...]
    gains: tuple[float, ...]
    group: Class | None
    explainable: float
    share: float
    left: float
    gain: OtherGain | None = None
    set_in: bool = False

    def unexplained(self, description: str) -> Unexplained:
        """Describe the error that is left, less the noise."""
        share = 1.0 - self.share if self.effects or self.left else 0.0
        return Unexplained(share, self.left, description)


def judge(
    candidates: Candidates,
    decision: Decision,
    last: FittedSet,
    shown: tuple[str, ...],
    before: float,
    untried: Collection[str],
) -> Findings:
    """
    Judge a decision, with the last step of the walk of H.

    The effects `shown` have significant tests of their own; without them the mean square error of
    the best H is `before`.  The effects `untried` were not among the candidates.
    """
    rows, best = candidates.rows, decision.best
    rest, whole = candidates.left(last), decision.whole
    if best is not None:
        rest = min(rest, candidates.left(best))
    gains = list[float]()
    if shown:
        # share the gain of effects with their own tests equally, beside the best H
        taken = before - candidates.without().fitted.mean_square
        gains += [max(taken, 0.0) / len(shown)] * len(shown)
        whole = max(whole, before - candidates.noise)
    share = float(np.clip(1.0 - rest / whole, 0.0, 1.0))
    if best is not None or shown:
        own = () if best is None else (a.name for a in best.fitted.state.effects)
        effects = (*shown, *(name for name in own if best and name in best.effects))
        group = _class(decision.names, untried, effects)
        verdict = 'class' if group else 'named'
        if candidates.is_part(rest, whole):
            verdict = 'partly_explained'
        gains += [] if best is None else _gains(candidates, best, effects, whole)
        # the H refitted beside the effects explains a part, too
        times = (whole - rest) / max(sum(gains), 1e-300)
        told = tuple(times * gain for gain in gains)
        left, set_in = candidates.percent(rest), decision.set_in
        return Findings(verdict, effects, told, group, whole, share, left, set_in=set_in)
    after = max(float(last.fitted.errors.sum()) / rows.n - candidates.noise, 0.0)
    left = rows.percent(after)
    as_given = candidates.given
    gained = as_given - candidates.least_share - after
    if last.way != 'given' and gained >= rows.square(SMALLEST_EFFECT):
        gain = None
        if last.way == 'gain':
            gain = OtherGain(last.gain, float(np.clip(gained / as_given, 0.0, 1.0)))
        group = None if gain else _hidden(candidates)
        return Findings('refitted', (), (), group, whole, 0.0, left, gain)
    is_small = after < rows.square(SMALLEST_EFFECT) + 2.0 * candidates.least_share
    return Findings('none' if is_small else 'unexplained', (), (), None, whole, 0.0, left)


def _gains(
    candidates: Candidates, best: FittedSet, effects: Sequence[str], whole: float
) -> Iterator[float]:
    """Yield the mean square that each effect of the best set explains beside the others."""
    for name in effects:
        if name in best.effects:
            rest = tuple(x for x in best.effects if x != name)
            # a single effect has no other effects beside it
            other = candidates.best(rest, best.effects) if rest else None
            level = whole if other is None else candidates.left(other)
            yield max(level - candidates.left(best), 0.0)


def _class(names: Sequence[str], untried: Collection[str], effects: Sequence[str]) -> Class | None:
    """Return the class of rivals, and of look-alikes that were no candidates."""
    of = names[:1] or effects[:1]
    like = [name for one in of for name in look_alikes(one) if name in untried]
    if not names and not like:
        return None
    names = tuple(dict.fromkeys([*(names or of), *like]))[:CLASS_SIZE]
    experiment = f'record {separating_experiment(names)}'
    if like:
        experiment = f'diagnose again with {" and ".join(like)} among the candidates; {experiment}'
    return Class(names, experiment)


def _hidden(candidates: Candidates) -> Class | None:
    """Return effects that do most of the work of another H, as this H may hide one of them."""
    # the same effect may stand there beside a retuned G, too
    found = list(dict.fromkeys(c.effects[0] for c in candidates.like_refit()))
    if len(found) == 1:
        found += [n for n in look_alikes(found[0]) if find_effect(n).rate_independent][:1]
    if len(found) < 2:
        return None
    names = tuple(found[:CLASS_SIZE])
    return Class(names, f'record {separating_experiment(names)}')


# -- the other candidates ------------------------------------------------------------------------


def candidates_of(
    candidates: Candidates, rounds: Sequence[Round], findings: Findings
) -> tuple[Candidate, ...]:
    """List every candidate that was not added, its share when added alone, and a reason."""
    rows, seen = candidates.rows, visible(rounds)
    group = findings.group.names if findings.group else ()
    found = []
    for name, share in _shares(candidates, rounds).items():
        if name in findings.effects or (seen[name] < SWALLOWED and name not in group):
            # an effect that these data cannot show is listed as untestable
            continue
        found.append(Candidate(name, share, _why_not(name, share, findings, rows.passes)))
    found.sort(key=lambda c: -c.share)
    others = [name for name, share in seen.items() if share >= SWALLOWED]
    told = {*findings.effects, *(c.name for c in found)}
    why = 'these data speak against it'
    return (*found, *(Candidate(name, 0.0, why) for name in others if name not in told))


def _shares(candidates: Candidates, rounds: Sequence[Round]) -> dict[str, float]:
    """Compute the share of the error without an effect that each effect explains alone."""
    shares: dict[str, float] = {}
    for one in rounds:
        if one.before.state.effects:
            continue
        for name, gain in one.gains.items():
            level = candidates.without((name,))
            rest = max(one.before.mean_square - gain - candidates.noise, 0.0)
            share = 1.0 - rest / candidates.left(level)
            shares[name] = max(share, shares.get(name, 0.0))
    for best in (c for c in candidates.bests if len(c.effects) == 1):
        level = candidates.without(best.effects)
        shares[best.effects[0]] = 1.0 - candidates.left(best) / candidates.left(level)
    return {name: float(np.clip(share, 0.0, 1.0)) for name, share in shares.items()}


def visible(rounds: Sequence[Round]) -> dict[str, float]:
    """Compute the largest share of the columns of each candidate that the rest cannot imitate."""
    found: dict[str, float] = {}
    for one in rounds:
        for name, share in one.visible.items():
            found[name] = max(share, found.get(name, 0.0))
    return found


def _why_not(name: str, share: float, findings: Findings, passes: float) -> str:
    best = ' and '.join(findings.effects)
    if findings.group and name in findings.group.names:
        if not findings.effects:
            return 'may hide in the hysteresis of the model'
        return f'explains as much as {findings.effects[-1]}: these data do not tell them apart'
    if findings.verdict == 'none':
        return f'there is only {findings.left:.2g} % of stroke to explain'
    if findings.effects:
        return f'{best} explains more'
    explains = f'explains {100.0 * share:.0f} % of what another hysteresis leaves'
    if passes < PASSES:
        return f'{explains}; the range was passed too rarely to test that'
    if share < 1.0 - TAKES:
        return f'{explains}, too little for a cause'
    return f'{explains}: as chance might, or less than the model missed from the beginning'


def smallest_detectable(candidates: Candidates, findings: Findings) -> float | None:
    """
    Return the smallest size of a further effect that would be found, rms in % of stroke.

    The result is None if the voltage passes its range too rarely.
    """
    if candidates.rows.passes < PASSES:
        return None
    return float(max(SMALLEST_EFFECT, np.sqrt(1.0 - TAKES) * findings.left))


def untestable_of(
    rounds: Sequence[Round], settings: DiagnosisSettings, tested: Collection[str]
) -> tuple[Untestable, ...]:
    """List the candidates that these data cannot show, except for those `tested` otherwise."""
    names, seen = settings.effects or tuple(catalogue()), visible(rounds)
    return tuple(
        Untestable(name, find_effect(name).needs or 'data in which it shows')
        for name in names
        if name not in tested and seen.get(name, 0.0) < SWALLOWED
    )


def errors_of_sets(candidates: Candidates) -> Mapping[tuple[str, ...], tuple[float, ...]]:
    """Compute the error of each set of changes on each kind of motion held out, % of stroke."""
    rows, bests = candidates.rows, dict[tuple[str, ...], Fitted]()
    size = np.bincount(rows.group[rows.block])
    for c in sorted(candidates.all, key=candidates.left):
        has = {REFITTED: c.way != 'given', RETUNED: c.retunes}
        # a change of G has no retuned G beside it
        if not (c.retunes and change_g(c.effects)):
            bests.setdefault((*c.effects, *(name for name in UNNAMED if has[name])), c.fitted)
    found = {}
    for changes, one in bests.items():
        blocks, kinds = (np.bincount(rows.group, e) for e in (one.errors, one.transfer))
        squares = np.sqrt(blocks * kinds) / size
        found[changes] = tuple(rows.percent(candidates.beyond_noise(x)) for x in squares)
    return found


def errors_of_laws(candidates: Candidates) -> Mapping[str, float]:
    """Compute the error of each law of H on held-out kinds of excitation, % of stroke."""
    rows = candidates.rows
    return {
        c.fitted.state.law.name: rows.percent(float(c.fitted.transfer.sum()) / rows.n)
        for c in candidates.of(())
        if c.fitted.state.law is not None and not c.retunes
    }
