# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Decide which candidate is taken, from the errors of all candidates on held-out data.

A candidate is a set K of effects beside one treatment of H and G.  Its error E is the geometric
mean of two mean squares: with interleaved blocks held out, and with whole kinds of motion held
out.  The error of a set is the error of its best treatment:

    left(K) = max(E(K) - noise, 0) + NOISE_SHARE noise.

After `PASSES` of the range, a set is admissible if

- left falls by the square of `SMALLEST_EFFECT` from the H as given;
- left(K) <= TAKES^(|K| - |K'|) left(K') for every part K' of K, the empty set included, and on
  interleaved blocks alone if K' has an effect;
- a change of G in K exceeds the known error of G; beside a K without such a change, a K' with a
  change of G within this error counts as a part, too;
- left(K) is at most `TAKES` of left with a special case in the place of an effect (`contains`);
- the last effect gains `BEYOND_CHANCE` times the gain by chance, unless it follows time alone.

The set that leaves least is taken, or a set with fewer parameters within `ALIKE`.  Sets of its
size within `RIVALS`, or further if it explains only a part, form a class with it.

A wide H imitates an effect of the path: an effect that is the same at any speed.  If no set is
admissible in labelled records, such an effect may be taken beside the given H.  Its gain must
reach ``1 - TAKES`` of the gain of the best refit.  It has then set in since the identification.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import itertools
import math

import numpy as np
from piezo_ident.common.choice import simplest
from piezo_ident.diagnosis.criteria import (
    ALIKE,
    BEYOND_CHANCE,
    LITTLE,
    NOISE_SHARE,
    PASSES,
    RIVALS,
    SMALLEST_EFFECT,
    TAKES,
)
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.search import Round
from piezo_ident.effects import find_effect

#: effect that never counts as set in: minor loops of any material are not quite congruent
OF_MATERIALS = 'noncongruent_minor_loops'


@dataclass(frozen=True, eq=False)
class FittedSet:
    """
    A set of effects beside one treatment of H and G, fitted.

    The effects are sorted, without the effects that have tests of their own.  `way` is the
    treatment of H: 'given', 'plays' or 'wide'.  The refined model also has 'drawn' (wide, towards
    the given H) or 'gain' (the given H times `gain`).  `found_in` is the search that found the
    candidate.
    """

    effects: tuple[str, ...]
    way: str
    fitted: Fitted
    found_in: Round | None = None
    gain: float = 1.0

    @property
    def size(self) -> int:
        """Number of parameters beside H."""
        return len(self.fitted.parameters)

    @property
    def retunes(self) -> bool:
        """Whether G is retuned."""
        return bool(self.fitted.state.retuning)


@dataclass(frozen=True, eq=False)
class Candidates:
    """
    All candidates of some data.

    The noise is the mean square of the noise of a row.  `missed` is the possible error of G on
    this motion, rms in % of stroke: a smaller change of G cannot be detected.
    """

    rows: Rows
    noise: float
    missed: float
    all: tuple[FittedSet, ...]

    def and_these(self, more: Sequence[FittedSet]) -> Candidates:
        """Return these candidates and more."""
        return replace(self, all=(*self.all, *more))

    @property
    def least_share(self) -> float:
        """Part of the noise that is added to each error, a mean square."""
        return NOISE_SHARE * self.noise

    def left(self, candidate: FittedSet) -> float:
        """Compute the mean square error of a candidate less the noise."""
        fitted = candidate.fitted
        error = np.sqrt(fitted.errors.sum() * fitted.transfer.sum()) / self.rows.n
        return self.beyond_noise(float(error))

    def beyond_noise(self, square: float) -> float:
        """Subtract the noise from a mean square, then add a share of the noise."""
        return max(square - self.noise, 0.0) + self.least_share

    def percent(self, left: float) -> float:
        """Convert an error to rms in % of stroke."""
        return self.rows.percent(left - self.least_share)

    def is_part(self, left: float, whole: float) -> bool:
        """Return whether an error is a large part of a whole, and as large as an effect."""
        return left > LITTLE * whole and self.percent(left) >= SMALLEST_EFFECT

    def of(self, effects: tuple[str, ...], beside: tuple[str, ...] = ()) -> tuple[FittedSet, ...]:
        """
        Return the candidates of a set, the best first.

        A retuned G is a change of G, too.  Candidates with a retuned G are left out if the set, or
        the set `beside`, changes G.
        """
        some = [c for c in self.all if c.effects == effects]
        if change_g(beside) or change_g(effects):
            some = [c for c in some if not c.retunes]
        return tuple(sorted(some, key=self.left))

    def best(self, effects: tuple[str, ...], beside: tuple[str, ...] = ()) -> FittedSet | None:
        """Return the best candidate of a set; see `of`."""
        return next(iter(self.of(effects, beside)), None)

    def without(self, beside: tuple[str, ...] = ()) -> FittedSet:
        """Return the best candidate without an effect; see `of`."""
        return self.of((), beside)[0]

    @property
    def bests(self) -> tuple[FittedSet, ...]:
        """The best candidate of each set of effects, ordered by their errors."""
        bests = map(self.best, dict.fromkeys(c.effects for c in self.all))
        return tuple(sorted(filter(None, bests), key=self.left))

    def is_admissible(self, effects: tuple[str, ...]) -> bool:
        """Return whether a set fulfils the conditions of this module."""
        best = self.best(effects)
        if not effects or best is None or self.rows.passes < PASSES:
            return False
        left = self.left(best)
        given = min(self.left(c) for c in self.of((), effects) if c.way == 'given')
        if given - left < self.rows.square(SMALLEST_EFFECT):
            return False
        sizes = range(len(effects))
        for part in (x for k in sizes for x in itertools.combinations(effects, k)):
            other = self.best(part, effects)
            if other is None:
                continue
            before, share = self.left(other), TAKES ** (len(effects) - len(part))
            if not change_g(effects):
                before = min(before, self._missed_by_g(part))
            if left > share * before:
                return False
            # beside another effect, whole kinds of motion must not be the only evidence
            own, rest = (self.beyond_noise(c.fitted.mean_square) for c in (best, other))
            if part and own > share * rest:
                return False
            changes = change_g(tuple(set(effects) - set(part)))
            if changes and self.rows.percent(before - left) < self.missed:
                return False
        others = map(self.best, _narrower(effects))
        if any(left > TAKES * self.left(other) for other in others if other is not None):
            return False
        return _beyond_chance(best)

    def _missed_by_g(self, part: tuple[str, ...]) -> float:
        """Compute the least error of a set plus a change of G within the known error of G."""
        before, found = self.best(part), math.inf
        names = {name for c in self.all for name in c.effects if change_g([name])}
        for name in names:
            other = self.best(tuple(sorted((*part, name))))
            if before is None or other is None:
                continue
            if self.rows.percent(self.left(before) - self.left(other)) < self.missed:
                found = min(found, self.left(other))
        return found

    @property
    def as_given(self) -> FittedSet:
        """The model as it was given."""
        return next(c for c in self.of(()) if c.way == 'given' and not c.retunes)

    @property
    def given(self) -> float:
        """Error of the model as it was given."""
        return self.left(self.as_given)

    def like_refit(self) -> tuple[FittedSet, ...]:
        """List effects of the path with ``1 - TAKES`` of the gain of a refit, the best first."""
        given, refit = self.given, self.left(self.without())
        if given - refit < self.rows.square(SMALLEST_EFFECT) or self.rows.passes < PASSES:
            return ()
        single = [c for c in self.all if c.way == 'given' and len(c.effects) == 1]
        path = [c for c in single if find_effect(c.effects[0]).rate_independent]
        found = [c for c in path if self.left(c) - refit <= TAKES * (given - refit)]
        return tuple(sorted(found, key=self.left))


@dataclass(frozen=True, eq=False)
class Decision:
    """
    Result of the decision.

    Attributes
    ----------
    best : FittedSet or None
        The candidate that was taken, if an effect was found.
    whole : float
        Error to explain, a mean square: the error of the best H and G without an effect.  For an
        effect that has set in since the identification, the error of the model as given.
    names : tuple of str
        A class: effects of the best set and of its rivals that some of these sets lack.
    set_in : bool
        Whether an effect has set in since the identification.
    """

    best: FittedSet | None
    whole: float
    names: tuple[str, ...] = ()
    set_in: bool = False


def decide(candidates: Candidates) -> Decision:
    """Decide between candidates."""
    bests = tuple(c for c in candidates.bests if candidates.is_admissible(c.effects))
    found = bests or candidates.like_refit()
    # only labels tell the earlier error on other motion
    if not (bests or (candidates.rows.kinds and found and found[0].effects != (OF_MATERIALS,))):
        return Decision(None, candidates.left(candidates.without()))
    best = simplest(found, candidates.left, lambda c: c.size, ALIKE)
    if bests:
        whole = candidates.left(candidates.without(best.effects))
        rivals = _rivals_of(candidates, best)
    else:
        whole, most = candidates.given, RIVALS * candidates.left(best)
        rivals = tuple(c.effects for c in found if c is not best and candidates.left(c) <= most)
    common = set(best.effects).intersection(*rivals)
    names = dict.fromkeys(itertools.chain(best.effects, *rivals))
    told = tuple(n for n in names if n not in common)
    return Decision(best, whole, told, set_in=not bests)


def _rivals_of(candidates: Candidates, best: FittedSet) -> tuple[tuple[str, ...], ...]:
    """Return the sets of equal size that are not separated from the best set, by their errors."""
    left, whole = candidates.left(best), candidates.left(candidates.without(best.effects))
    most = RIVALS * left
    if candidates.is_part(left, whole):
        # the law of the remaining error is unknown: a rival may remove most of the same error
        most = max(most, left + TAKES * (whole - left))
    others = (c.effects for c in candidates.bests if len(c.effects) == len(best.effects))
    sets = (s for s in others if s != best.effects and best.effects not in _narrower(s))
    bests = [candidates.best(s, best.effects) for s in sets]
    return tuple(c.effects for c in bests if c is not None and candidates.left(c) <= most)


def change_g(effects: Sequence[str]) -> bool:
    """Return whether at least one of the effects changes G."""
    return any(find_effect(name).in_dynamics for name in effects)


def _narrower(effects: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the sets with a special case in the place of an effect that `contains` it."""
    for name in effects:
        for other in find_effect(name).contains:
            yield tuple(sorted({*effects, other} - {name}))


def _beyond_chance(candidate: FittedSet) -> bool:
    """Return whether the effect found last gains more than on surrogates of the residual."""
    found, fitted = candidate.found_in, candidate.fitted
    # an effect that only depends on time fits a shifted residual equally well
    if found is None or find_effect(fitted.name).time_driven:
        return True
    gain = found.before.mean_square - fitted.mean_square
    return gain >= BEYOND_CHANCE * found.chance.get(fitted.name, 0.0)
