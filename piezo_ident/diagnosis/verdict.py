# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The verdict: what was found, how sure that is, and what the data cannot tell.

A name needs nearly all that can be explained, and must be clearly ahead of every other candidate;
otherwise the names that remain are reported as a class, or the residual as partly explained or
unexplained.  Where a refit of H alone brought what there was to gain, that is the finding, and
what may hide in it is a class.

No real effect has quite the form of a textbook law, so of two laws the one that leaves less need
not be the cause: it must leave clearly less, by more than laws deviate, and by more than the
difference scatters over held-out blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.cross_validation import standard_errors
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.next_experiment import CONTAINS, look_alikes, separating_experiment
from piezo_ident.diagnosis.results import (
    Candidate,
    Class,
    DiagnosisSettings,
    OtherGain,
    Unexplained,
    Untestable,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.search import gains_of, Round, Selected
from piezo_ident.diagnosis.state import CREEP, DRIFT, WANDERS
from piezo_ident.effects import catalogue, find_effect


@dataclass(frozen=True, eq=False)
class Findings:
    """
    The judgement in numbers and names.

    Attributes
    ----------
    verdict : str
    share : float
        Of the explainable part, by everything that was added.
    effects : tuple of str
        Added, in order.
    group : Class or None
    left : float
        Beyond the noise, rms in % of stroke.
    keeps_given : bool
        Whether the model stays as it was given, whatever a refit would bring.
    gain : OtherGain or None
        Where another gain does most of what a refit of H does.
    of_refit : float
        Mean square that a refit of H takes, where an effect does that beside the H as given and
        shares are of it; else 0.
    """

    verdict: str
    share: float
    effects: tuple[str, ...]
    group: Class | None
    left: float
    keeps_given: bool = False
    gain: OtherGain | None = None
    of_refit: float = 0.0

    @property
    def may_follow_time(self) -> bool:
        """Whether much is left, and what was found may as well say nothing of another record."""
        own = {find_effect(name).time_driven for name in self.effects}
        names = self.group.names if self.group else ()
        like = any(find_effect(name).time_driven for name in names)
        return self.verdict == 'partly_explained' and like and False in own

    def unsettled(self, left: float) -> Findings:
        """Return that what a refit of H would take need not last, or hold on other motion."""
        return replace(self, verdict='unexplained', left=left, keeps_given=True)

    def hiding(self, names: tuple[str, ...]) -> Findings:
        """Return that H may hide one of several effects."""
        if not names:
            return self
        return replace(self, group=Class(names, f'record {separating_experiment(names)}'))

    def unexplained(self, description: str) -> Unexplained:
        """Return what is left beyond the noise."""
        share = 1.0 - self.share if self.effects or self.left else 0.0
        return Unexplained(share, self.left, description)


# -- which effect is it? -------------------------------------------------------------------------


def judge(
    rows: Rows, base: Fitted, selected: Selected, noise: float, alike: Sequence[str] = ()
) -> Findings:
    """
    Return the verdict on what was added to a base.

    `noise` is the mean square of the noise of a row.  What could have bent G at the identification
    is a rival of the first effect that was added; those that are known to be `alike` are rivals.
    """
    fitted, taken = selected.fitted, selected.taken
    explainable = max(base.mean_square - noise, 0.0)
    left = max(fitted.mean_square - noise, 0.0)
    if not taken:
        size = rows.percent(left)
        # beside much noise little is left that its estimate might not have missed
        doubt = (1.0 + criteria.NOISE_KNOWN) ** 2 - 1.0
        least = rows.square(criteria.SMALLEST_EFFECT) + doubt * noise
        # what is hardly beyond the limit is claimed if it is so by more than it scatters
        each = (noise + least) * np.bincount(rows.block, minlength=fitted.errors.size)
        scatters = standard_errors(fitted.errors - each) < criteria.STANDARD_ERRORS
        small = left < (4.0 if scatters else 1.0) * least
        return Findings('none' if small else 'unexplained', 0.0, (), None, size)
    share = float(np.clip(1.0 - left / max(explainable, 1e-300), 0.0, 1.0))
    effects = tuple(this.contenders[0].name for this in taken)
    rest, group = rows.percent(left), _alike(rows, base, selected, noise, alike)
    if share < criteria.NAMED:
        return Findings('partly_explained', share, effects, group, rest)
    return Findings('class' if group else 'named', share, effects, group, rest)


def _alike(
    rows: Rows, base: Fitted, selected: Selected, noise: float, known: Sequence[str]
) -> Class | None:
    """Return the first of the effects added that others explain as well, with those."""
    law = selected.fitted.state.law
    plays = law is None or law.name == 'plays'
    # two changes of one G, of which no law fits alone, need not be two
    taken = [this.contenders[0].name for this in selected.taken]
    changes = [name for name in taken if find_effect(name).in_dynamics]
    for i, this in enumerate(selected.taken):
        bent = selected.bent.contenders[:1] if selected.bent and i == 0 else ()
        contenders = (*this.contenders, *bent)
        # what the effects after it account for is held against none of them
        rest = max(this.contenders[0].mean_square - selected.fitted.mean_square, 0.0)
        if selected.fitted.state.fading:
            # all were fitted without what crept on from before
            rest = min(rest, sum(later.gain for later in selected.taken[i + 1 :]))
        rest += noise
        whole = (base if i == 0 else this.before).mean_square
        rivals = rivals_of(rows, contenders, rest, whole - rest, plays=plays)
        # of a G that changed none of the laws need be the cause
        like = selected.linear if contenders[0].name in selected.linear else ()
        like = (*changes, *like) if contenders[0].name in changes else like
        like = (*like, *known) if contenders[0].name in known else like
        if contenders[0].name == CREEP and not plays:
            # shares of creep over decades make up for what a drift leaves
            share = gains_of(rows, this).get(DRIFT, 0.0) / (this.before.mean_square - rest)
            like = (*like, DRIFT) if share > criteria.DRIFTS else like
        names = tuple(dict.fromkeys([*(c.name for c in (contenders[0], *rivals)), *like]))
        untried = [name for name in look_alikes(names[0]) if name in selected.left_out]
        if len(names) > 1 or untried:
            return _class((*names, *untried)[: criteria.CLASS_SIZE], untried)
    return None


def _class(names: tuple[str, ...], untried: Sequence[str]) -> Class:
    experiment = f'record {separating_experiment(names)}'
    if untried:
        experiment = (
            f'diagnose again with {" and ".join(untried)} among the candidates; {experiment}'
        )
    return Class(names, experiment)


def rivals_of(
    rows: Rows, contenders: Sequence[Fitted], noise: float, explainable: float, *, plays: bool
) -> tuple[Fitted, ...]:
    """
    Return the contenders that the data do not separate from the first one, which was added.

    `noise` and `explainable` are mean squares: of the noise, and of what there was to explain;
    `plays` says whether the hysteresis is a sum of them.
    """
    best, *others = contenders
    floor, least = (rows.square(size) for size in (criteria.INDISTINCT, criteria.SMALLEST_EFFECT))
    # what another hysteresis leaves may favour one look-alike
    doubtful = not plays and best.mean_square - noise > least
    alike = look_alikes(best.name) if doubtful else ()
    return tuple(
        c
        for c in others
        if _as_good(c, best, noise, explainable, floor)
        or (c.name in alike and _may_be(c, best, noise, explainable))
    )


def _may_be(rival: Fitted, best: Fitted, noise: float, explainable: float) -> bool:
    """Return whether a look-alike with no more parameters would be named, were it alone."""
    left, other = (max(c.mean_square - noise, 0.0) for c in (best, rival))
    return (
        len(rival.parameters) <= len(best.parameters)
        and other <= (1.0 - criteria.NAMED) * explainable
        and other <= criteria.FORM_RATIO * left
    )


def _as_good(rival: Fitted, best: Fitted, noise: float, explainable: float, floor: float) -> bool:
    def fits(left: float) -> bool:
        return left <= max((1.0 - criteria.LAW_FITS) * explainable, floor)

    left = max(best.mean_square - noise, 0.0)
    other = max(rival.mean_square - noise, 0.0)
    ratio = (other + floor) / (left + floor)
    more = len(rival.parameters) - len(best.parameters)
    if more > 0 and (fits(left) or best.name in CONTAINS.get(rival.name, ())):
        # nothing is left that a richer law is needed for
        return ratio <= criteria.RICHER_AHEAD
    if ratio <= criteria.AHEAD:
        return True
    if ratio > criteria.FORM_RATIO:
        return False
    if more < 0 and fits(other):
        return True
    difference = rival.errors - best.errors
    return standard_errors(difference) < criteria.STANDARD_ERRORS


# -- the other candidates ------------------------------------------------------------------------


def candidates_of(
    rows: Rows,
    rounds: Sequence[Round],
    findings: Findings,
    noise: float,
    aside: Mapping[str, str],
) -> tuple[Candidate, ...]:
    """
    Return every candidate that was not added, its share when added alone, and why not.

    `aside` are those that were not tried, and why.
    """
    group = findings.group.names if findings.group else ()
    possible = {*findings.effects, *group, *(name for one in rounds for name in one.best)}
    visible = _visible(rounds)
    shares: dict[str, float] = {}
    last: dict[str, Round] = {}
    for one in rounds:
        left = max(one.before.mean_square - noise, 1e-300)
        if one is rounds[-1]:
            left = findings.of_refit or left
        shares |= {
            name: gain / left
            for name, gain in gains_of(rows, one).items()
            # what follows the path counts beside plays, which come last
            if name not in shares or find_effect(name).rate_independent
        }
        last |= dict.fromkeys(one.best, one)
    if findings.gain and WANDERS in shares:
        # as the sentence tells it
        shares[WANDERS] = findings.gain.share
    found = []
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        # what these data cannot show is among the untestable
        if name in findings.effects or (visible[name] < criteria.SWALLOWED and name not in group):
            continue
        value = float(np.clip(share, 0.0, 1.0))
        why = _why_not(name, value, findings, last[name], rows.passes)
        is_partly = findings.verdict == 'partly_explained' and not _is_beside(name, findings)
        if is_partly and value >= shares.get(findings.effects[0], 1.0):
            why = f'explains no less than {findings.effects[0]}, which is as simple or simpler'
        found.append(Candidate(name, value, why))
    found += [
        Candidate(name, 0.0, 'these data speak against it')
        for name, share in visible.items()
        if share >= criteria.SWALLOWED and name not in possible
    ]
    return (*found, *(Candidate(name, 0.0, why) for name, why in aside.items()))


def _is_beside(name: str, findings: Findings) -> bool:
    """Return whether an effect was tried beside a refit of H that was then not needed."""
    return findings.of_refit > 0.0 and not find_effect(name).rate_independent


def _visible(rounds: Sequence[Round]) -> dict[str, float]:
    """Return the share of the columns of each candidate that the rest could not make at best."""
    found: dict[str, float] = {}
    for one in rounds:
        for name, share in one.visible.items():
            found[name] = max(share, found.get(name, 0.0))
    return found


def set_aside(
    rows: Rows,
    selected: Selected,
    settings: DiagnosisSettings,
    noise: float,
    misses: float,
    tested: Collection[str],
) -> dict[str, str]:
    """
    Return the candidates that were not tried though data might show them, and why not.

    `misses` is what G may miss of these data, % of stroke.
    """
    tried = _visible(selected.rounds)
    size = rows.percent(selected.rounds[0].before.mean_square - noise)
    found = {}
    for name in settings.effects or tuple(catalogue()):
        effect = find_effect(name)
        if name in tried or name in tested:
            continue
        if effect.in_dynamics and size < misses:
            found[name] = (
                f'only {size:.2g} % of stroke are left for it; of motion as fast as here G may '
                f'miss {misses:.2g} %, by what it missed when it was identified'
            )
        elif effect.rate_independent and selected.imitated is None:
            found[name] = 'a sum of plays leaves nothing for it'
    return found


def smallest_detectable(
    rows: Rows, base: Fitted, selected: Selected, noise: float
) -> float | None:
    """
    Return the size that a further effect must have to be taken, rms in % of stroke.

    None where the range was passed so rarely that none is taken.
    """
    if rows.passes < criteria.PASSES:
        return None
    # what follows time alone fits any slow residual
    last = selected.rounds[-1].chance
    chance = max((x for n, x in last.items() if not find_effect(n).time_driven), default=0.0)
    share = criteria.FURTHER if selected.taken else criteria.ADDED
    least = max(
        criteria.BEYOND_CHANCE * chance,
        criteria.LEAST_GAIN * (base.mean_square - noise),
        share * (selected.fitted.mean_square - noise),
    )
    return max(criteria.SMALLEST_EFFECT, rows.percent(least))


def _why_not(name: str, share: float, findings: Findings, last: Round, passes: float) -> str:
    best = ' and '.join(findings.effects)
    if findings.group and name in findings.group.names:
        if findings.gain and name == WANDERS:
            return f'a gain of {findings.gain.value:.4g} explains that of what the model misses'
        if not findings.effects:
            return 'may hide in the base model'
        does = 'does nearly what a refit of the hysteresis does, like'
        does = does if findings.of_refit else 'explains as much as'
        return f'{does} {findings.effects[0]}: these data do not tell them apart'
    if share < criteria.LEAST_GAIN:
        return 'explains next to nothing'
    if findings.verdict == 'none':
        return f'there is only {findings.left:.2g} % of stroke to explain'
    follows_path = find_effect(name).rate_independent and not findings.of_refit
    if not findings.effects or follows_path or _is_beside(name, findings):
        of = 'what a sum of plays leaves' if follows_path else 'what could be explained'
        if findings.of_refit:
            of = 'what a refit of the hysteresis leaves'
        explains = f'explains {100.0 * share:.0f} % of {of}'
        if passes < criteria.PASSES:
            return f'{explains}; the range was passed too rarely to test that'
        if share < criteria.ADDED:
            return f'{explains}, too little for a cause'
        if follows_path:
            return f'{explains}; a wider hysteresis may explain as much'
        return f'{explains}: as chance might, at a price elsewhere, or not where it alone acts'
    # behind what set in since nothing was tried
    if name in last.best and last.before.mean_square > 0.0 and not findings.of_refit:
        more = 1.0 - last.best[name].errors.sum() / last.before.errors.sum()
        if more < criteria.LEAST_GAIN:
            return f'{best} explains more; nothing is left for it after that'
    return f'{best} explains more'


def untestable_of(
    rounds: Sequence[Round], settings: DiagnosisSettings, tested: Collection[str]
) -> tuple[Untestable, ...]:
    """Return the candidates that these data cannot show, but for those `tested` otherwise."""
    names, visible = settings.effects or tuple(catalogue()), _visible(rounds)
    return tuple(
        Untestable(name, find_effect(name).needs or 'data in which it shows')
        for name in names
        if name not in tested and visible.get(name, 0.0) < criteria.SWALLOWED
    )


def errors_of_laws(rows: Rows, fits: Iterable[Fitted]) -> dict[str, float]:
    """Return how far the laws of H miss kinds of excitation held out, % of stroke."""
    return {
        fitted.state.law.name: rows.percent(float(fitted.transfer.sum()) / rows.n)
        for fitted in fits
        if fitted.state.law is not None and not fitted.state.effects
    }
