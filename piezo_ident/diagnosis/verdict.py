# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The verdict: what was found, how sure that is, and what the data cannot tell.

A name needs nearly all that can be explained, and must be clearly ahead of every other candidate;
otherwise the names that remain are reported as a class, or the residual as partly explained or
unexplained.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.diagnosis.apart import experiment_for, look_alikes, rivals_of
from piezo_ident.diagnosis.fit import Fitted
from piezo_ident.diagnosis.results import (
    Candidate,
    Class,
    DiagnosisSettings,
    Unexplained,
    Untestable,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.search import Round
from piezo_ident.effects import catalogue, find_effect

__all__ = [
    'PASSES',
    'Findings',
    'candidates_of',
    'judge',
    'smallest_taken',
    'takes',
    'untestable_of',
]

#: least share of the explainable part that a name stands for; below the second nothing is added
NAMED, ADDED = 0.92, 0.5
#: a gain below this share of what is left, or below this rms [% of stroke], is no effect
LEAST_GAIN, SMALLEST = 0.10, 0.05
#: how much better than on turned residuals a gain must be
BEYOND_CHANCE = 1.5
#: what a further effect must explain of what the ones before it left
FURTHER = 0.6
#: how much an effect may raise the error of any kind of excitation
HARM = 1.25
#: names of a class, at most
MOST = 3
#: a candidate is not testable when a refit of the base swallows all but this share of it
SWALLOWED = 1e-4
#: passes over the range, there or back, that a test on data not fitted needs
PASSES = 3.0


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
    unexplained : Unexplained
    """

    verdict: str
    share: float
    effects: tuple[str, ...]
    group: Class | None
    unexplained: Unexplained


def percent(rows: Rows, mean_square: float) -> float:
    """Return a mean square as rms in % of stroke."""
    return 100.0 * float(np.sqrt(max(mean_square, 0.0))) / rows.stroke


def takes(rows: Rows, this: Round, noise: float, explainable: float, *, first: bool) -> bool:
    """
    Return whether the best contender of a round is an effect.

    Parameters
    ----------
    rows : Rows
    this : Round
    noise : float
        Mean square of the noise of a row.
    explainable : float
        Mean square that was there to be explained before anything was added.
    first : bool
        Whether nothing was added before.
    """
    if not this.contenders:
        return False
    best = this.contenders[0]
    before, after = this.before.mean_square, best.fitted.mean_square
    gain, left = before - after, max(before - noise, 1e-300)
    if percent(rows, gain) < SMALLEST or gain < LEAST_GAIN * explainable:
        return False
    # what follows time alone fits a residual that was turned in time as well; its lines and
    # trends have tests of their own
    chance = 0.0 if best.effect.time_driven else this.chance.get(best.name, 0.0)
    if gain < BEYOND_CHANCE * chance:
        return False
    if gain < (ADDED if first else FURTHER) * left:
        return False
    return not _harms(rows, this.before, best.fitted, noise)


def smallest_taken(
    rows: Rows,
    base: Fitted,
    fitted: Fitted,
    rounds: Sequence[Round],
    taken: Sequence[Round],
    noise: float,
) -> float | None:
    """
    Return how much a further effect would have to explain, rms in % of stroke.

    Parameters
    ----------
    rows : Rows
    base, fitted : Fitted
        Before and after everything that was added.
    rounds, taken : sequence of Round
        All, and those whose best contender was added.
    noise : float
        Mean square of the noise of a row.

    Returns
    -------
    float or None
        None where the range was passed so rarely that none would have been taken.
    """
    if rows.passes < PASSES:
        return None
    # what follows time alone fits any slow residual
    last = rounds[-1].chance
    chance = max((x for n, x in last.items() if not find_effect(n).time_driven), default=0.0)
    least = max(
        BEYOND_CHANCE * chance,
        LEAST_GAIN * (base.mean_square - noise),
        (FURTHER if taken else ADDED) * (fitted.mean_square - noise),
    )
    return max(SMALLEST, percent(rows, least))


def _harms(rows: Rows, before: Fitted, after: Fitted, noise: float) -> bool:
    """Return whether the error grows where it was no trifle."""
    kinds = np.unique(rows.group)
    counts = np.bincount(rows.group[rows.block], minlength=kinds.size)
    one = np.bincount(rows.group, before.errors) / counts
    other = np.bincount(rows.group, after.errors) / counts
    trifle = noise + (SMALLEST * rows.stroke / 100.0) ** 2
    return bool(np.any(other > HARM**2 * one + trifle))


def judge(
    rows: Rows,
    base: Fitted,
    fitted: Fitted,
    taken: Sequence[Round],
    noise: float,
    left_out: Collection[str] = (),
    bent: Round | None = None,
) -> Findings:
    """
    Return the verdict.

    Parameters
    ----------
    rows : Rows
    base, fitted : Fitted
        Before and after everything that was added.
    taken : sequence of Round
        The rounds whose best contender was added.
    noise : float
        Mean square of the noise of a row.
    left_out : collection of str, optional
        Effects that were not tried.
    bent : Round, optional
        What else the first one may have been: an effect that bent G at the identification.
    """
    explainable = max(base.mean_square - noise, 0.0)
    left = max(fitted.mean_square - noise, 0.0)
    size = percent(rows, explainable)
    if not taken:
        rest = Unexplained(1.0 if explainable else 0.0, size, '')
        small = size < SMALLEST
        return Findings('none' if small else 'unexplained', 0.0, (), None, rest)
    share = float(np.clip(1.0 - left / explainable, 0.0, 1.0))
    effects = tuple(this.contenders[0].name for this in taken)
    rest = Unexplained(1.0 - share, percent(rows, left), '')
    if share < NAMED:
        return Findings('partly_explained', share, effects, None, rest)
    for i, this in enumerate(taken):
        contenders = (*this.contenders, *(bent.contenders[:1] if bent and i == 0 else ()))
        # what the effects after it account for is held against none of them
        rest_of = max(this.contenders[0].fitted.mean_square - fitted.mean_square, 0.0) + noise
        size = (base if i == 0 else this.before).mean_square
        rivals = rivals_of(rows, contenders, rest_of, size - rest_of)
        names = tuple(dict.fromkeys((effects[i], *(c.name for c in rivals))))
        untried = [name for name in look_alikes(names[0]) if name in left_out]
        if len(names) > 1 or untried:
            group = _class((*names, *untried)[:MOST], untried)
            return Findings('class', share, effects, group, rest)
    return Findings('named', share, effects, None, rest)


def _class(names: Sequence[str], untried: Sequence[str]) -> Class:
    todo = f'record {experiment_for(names)}'
    if untried:
        todo = f'diagnose again with {" and ".join(untried)} among the candidates; {todo}'
    return Class(tuple(names), todo)


def candidates_of(
    rows: Rows, rounds: Sequence[Round], findings: Findings, noise: float
) -> tuple[Candidate, ...]:
    """Return every candidate that was not added, its share when added alone, and why not."""
    first, last = rounds[0], rounds[-1]
    possible = {name for one in rounds for name in one.best}
    possible |= {*findings.effects, *(findings.group.names if findings.group else ())}
    left = max(first.before.mean_square - noise, 1e-300)
    shares = {
        name: (first.before.errors.sum() - s.errors.sum()) / rows.n / left
        for name, s in first.best.items()
    }
    for c in first.contenders:
        gain = (first.before.mean_square - c.fitted.mean_square) / left
        shares[c.name] = max(shares[c.name], gain)
    found = []
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        if name in findings.effects:
            continue
        value = float(np.clip(share, 0.0, 1.0))
        why = _why_not(name, value, findings, last, rows.passes)
        is_partly = findings.verdict == 'partly_explained'
        if is_partly and value >= shares.get(findings.effects[0], 1.0):
            why = f'explains no less than {findings.effects[0]}, which is as simple or simpler'
        found.append(Candidate(name, value, why))
    found += [
        Candidate(name, 0.0, 'these data speak against it')
        for name, share in first.visible.items()
        if share >= SWALLOWED and name not in possible
    ]
    return tuple(found)


def _why_not(name: str, share: float, findings: Findings, last: Round, passes: float) -> str:
    best = ' and '.join(findings.effects)
    if findings.group and name in findings.group.names:
        return f'explains as much as {findings.effects[0]}: these data do not tell them apart'
    if not findings.effects:
        if share < LEAST_GAIN:
            return 'explains next to nothing'
        if findings.verdict == 'none':
            return f'there is only {findings.unexplained.rms_percent:.2g} % of stroke to explain'
        said = f'explains {100.0 * share:.0f} % of what could be explained'
        if passes < PASSES:
            return f'{said}, of a range that was passed too rarely to test that'
        if share < ADDED:
            return f'{said}, too little for a cause'
        return f'{said}, as chance might, or at the expense of another kind of excitation'
    if share < LEAST_GAIN:
        return 'explains next to nothing'
    gain = last.before.mean_square
    if name in last.best and gain > 0.0:
        more = 1.0 - last.best[name].errors.sum() / last.before.errors.sum()
        if more < LEAST_GAIN:
            return f'{best} explains more; nothing is left for it after that'
    return f'{best} explains more'


def untestable_of(
    rounds: Sequence[Round], settings: DiagnosisSettings, tested: Collection[str]
) -> tuple[Untestable, ...]:
    """
    Return the candidates that these data cannot show.

    Parameters
    ----------
    rounds : sequence of Round
    settings : DiagnosisSettings
    tested : collection of str
        Effects that were tested otherwise, or are in the model as it was given.
    """
    first = rounds[0]
    found = []
    for name in settings.effects or catalogue():
        if name in settings.without or name in tested:
            continue
        effect = find_effect(name)
        if first.visible.get(name, 0.0) < SWALLOWED:
            found.append(Untestable(name, effect.needs or 'data in which it shows'))
    return tuple(found)
