# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Decide which candidate is taken, from the errors of all candidates on held-out data.

A candidate is a set K of effects beside one treatment of H and G.  Its error E is the geometric
mean of two mean squares: of blocks held out in spread sets, and of whole kinds of motion held out.
The error of a set is the error of its best treatment:

    left(K) = max(E(K) - noise, 0) + NOISE_SHARE noise.

A set is admissible if it lowers the error by at least the smallest effect, and if each of its
effects removes most of the error that is left without this effect.  Beside another effect, this
must hold for the blocks alone, too.  The decision takes the admissible set with the smallest
error, or a set with fewer parameters and about the same error.  Sets of the same size with a
slightly larger error are its rivals; the set and its rivals form a class.  Size decides instead of
significance: in 100,000 samples any law of the right trend gains a significant part.

A wide enough H can imitate an effect that follows the path of the voltage, so such an effect gains
little beside a refitted H.  If the effect appeared after the identification, the H as given lacks
it.  If one such effect beside the given H does most of the work of a refitted H, the effect is the
finding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import itertools
import math

import numpy as np
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

#: effect of minor loops that the H of any material shows a little
OF_MATERIALS = 'noncongruent_minor_loops'


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    A set of effects beside one treatment of H and G, fitted.

    Attributes
    ----------
    effects : tuple of str
        Names, sorted, without the effects that tests of their own have shown.
    way : str
        Treatment of H: 'given', 'plays' or 'wide'.
    fitted : Fitted
    found_in : Round or None
        The search that produced the candidate.
    """

    effects: tuple[str, ...]
    way: str
    fitted: Fitted
    found_in: Round | None = None

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

    Attributes
    ----------
    rows : Rows
    noise : float
        Mean square of the noise of a row.
    missed : float
        Possible error of G on this motion, derived from its error at the identification, rms in %
        of stroke.  A smaller change of G cannot be detected.
    all : tuple of Candidate
    """

    rows: Rows
    noise: float
    missed: float
    all: tuple[Candidate, ...]

    def and_these(self, more: Sequence[Candidate]) -> Candidates:
        """Return these candidates and more."""
        return replace(self, all=(*self.all, *more))

    @property
    def least_share(self) -> float:
        """Part of the noise that is added to each error, a mean square."""
        return NOISE_SHARE * self.noise

    def left(self, candidate: Candidate) -> float:
        """Compute the error of a candidate beyond the noise, a mean square."""
        return self.left_by(candidate.fitted)

    def left_by(self, fitted: Fitted) -> float:
        """Compute the error of a fit beyond the noise, a mean square."""
        error = np.sqrt(fitted.errors.sum() * fitted.transfer.sum()) / self.rows.n
        return self.beyond_noise(float(error))

    def beyond_noise(self, square: float) -> float:
        """Subtract the noise from a mean square, then add a share of the noise."""
        return max(square - self.noise, 0.0) + self.least_share

    def _of_blocks(self, candidate: Candidate) -> float:
        """Compute the error beyond the noise on blocks held out in spread sets alone."""
        return self.beyond_noise(candidate.fitted.mean_square)

    def percent(self, left: float) -> float:
        """Convert an error to rms in % of stroke."""
        return self.rows.percent(left - self.least_share)

    def is_part(self, left: float, whole: float) -> bool:
        """Return whether an error is a large part of a whole, and as large as an effect."""
        return left > LITTLE * whole and self.percent(left) >= SMALLEST_EFFECT

    def of(self, effects: tuple[str, ...], beside: tuple[str, ...] = ()) -> tuple[Candidate, ...]:
        """
        Return the candidates of a set, the best first; empty if the set has no candidate.

        A retuned G is a change of G, too.  Candidates with a retuned G are left out if the set, or
        the set `beside`, changes G.
        """
        some = [c for c in self.all if c.effects == effects]
        if change_g(beside) or change_g(effects):
            some = [c for c in some if not c.retunes]
        return tuple(sorted(some, key=self.left))

    def best(self, effects: tuple[str, ...], beside: tuple[str, ...] = ()) -> Candidate | None:
        """Return the best candidate of a set; see `of`."""
        return next(iter(self.of(effects, beside)), None)

    def without(self, beside: tuple[str, ...] = ()) -> Candidate:
        """Return the best candidate without an effect; see `of`."""
        return self.of((), beside)[0]

    @property
    def sets(self) -> tuple[tuple[str, ...], ...]:
        """Sets of effects, ordered by the error of the best candidate of each."""
        least: dict[tuple[str, ...], float] = {}
        for c in self.all:
            best = self.best(c.effects)
            if best is not None:
                least[c.effects] = self.left(best)
        return tuple(sorted(least, key=least.__getitem__))

    def is_admissible(self, effects: tuple[str, ...]) -> bool:
        """Return whether a set is large enough, and each effect removes most of the error."""
        best = self.best(effects)
        if not effects or best is None or self.rows.passes < PASSES:
            return False
        left, given = self.left(best), self._as_given(effects)
        if given - left < self.rows.square(SMALLEST_EFFECT):
            return False
        for part in _parts(effects):
            other = self.best(part, effects)
            if other is None:
                continue
            before, most = self.left(other), TAKES ** (len(effects) - len(part))
            if not change_g(effects):
                before = min(before, self._missed_by_g(part))
            if left > most * before:
                return False
            # beside another effect, whole kinds of motion must not be the only evidence
            if part and self._of_blocks(best) > most * self._of_blocks(other):
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
        for name in (name for name in self._names if change_g([name])):
            other = self.best(tuple(sorted((*part, name))))
            if before is None or other is None:
                continue
            if self.rows.percent(self.left(before) - self.left(other)) < self.missed:
                found = min(found, self.left(other))
        return found

    @property
    def _names(self) -> set[str]:
        return {name for c in self.all for name in c.effects}

    def _as_given(self, effects: tuple[str, ...]) -> float:
        """Compute the error of the model with the H as given."""
        return min(self.left(c) for c in self.of((), effects) if c.way == 'given')

    @property
    def as_given(self) -> Candidate:
        """The model as it was given."""
        found = (c for c in self.of(()) if c.way == 'given' and not c.retunes)
        return next(found)

    @property
    def given(self) -> float:
        """Error of the model as it was given."""
        return self.left(self.as_given)

    def like_refit(self) -> tuple[Candidate, ...]:
        """
        Return the effects of the path that, beside the given H, do most of the work of a refit.

        The effect with the smallest error comes first.
        """
        given, refit = self.given, self.left(self.without())
        if given - refit < self.rows.square(SMALLEST_EFFECT) or self.rows.passes < PASSES:
            return ()
        own = [
            c
            for c in self.all
            if c.way == 'given'
            and len(c.effects) == 1
            and find_effect(c.effects[0]).rate_independent
        ]
        found = [c for c in own if self.left(c) - refit <= TAKES * (given - refit)]
        return tuple(sorted(found, key=self.left))


@dataclass(frozen=True, eq=False)
class Decision:
    """
    Result of the decision.

    Attributes
    ----------
    best : Candidate or None
        The candidate that was taken; None if no effect was found.
    rivals : tuple of tuple of str
        Sets of the same size that are not separated from the best set, ordered by error.
    names : tuple of str
        A class: names of the effects in the best set and in its rivals that not every set
        contains.
    whole : float
        Error to explain, a mean square.  It is the error of the best H and G without an effect.
        For an effect that appeared after the identification, it is the error of the model as
        given.
    set_in : bool
        Whether an effect has appeared since the identification.
    """

    best: Candidate | None
    whole: float
    rivals: tuple[tuple[str, ...], ...] = ()
    names: tuple[str, ...] = ()
    set_in: bool = False


def decide(candidates: Candidates) -> Decision:
    """Decide between candidates."""
    possible = [s for s in candidates.sets if candidates.is_admissible(s)]
    bests = [c for c in map(candidates.best, possible) if c is not None]
    if not bests:
        return _set_in(candidates)
    best = _simplest(candidates, bests)
    rivals = rivals_of(candidates, best)
    common = set(best.effects).intersection(*rivals)
    names = dict.fromkeys(itertools.chain(best.effects, *rivals))
    told = tuple(n for n in names if n not in common) if rivals else ()
    return Decision(best, candidates.left(candidates.without(best.effects)), rivals, told)


def _set_in(candidates: Candidates) -> Decision:
    """
    Decide whether an effect has set in, if no set is admissible beside the best H.

    Without labels the earlier error on other motion is unknown, so the decision stays empty.  The
    same holds for loops that are not congruent: the H of any material has some from the beginning.
    """
    found = candidates.like_refit()
    if not found or not candidates.rows.kinds or found[0].effects == (OF_MATERIALS,):
        return Decision(None, candidates.left(candidates.without()))
    best = _simplest(candidates, found)
    most = RIVALS * candidates.left(best)
    rivals = [c for c in found if c is not best and candidates.left(c) <= most]
    names = tuple(c.effects[0] for c in (best, *rivals)) if rivals else ()
    return Decision(best, candidates.given, tuple(c.effects for c in rivals), names, set_in=True)


def _simplest(candidates: Candidates, some: Sequence[Candidate]) -> Candidate:
    """Return the candidate with the fewest parameters among those about as good as the best."""
    least = min(map(candidates.left, some))
    alike = [c for c in some if candidates.left(c) <= ALIKE * least]
    return min(alike, key=lambda c: (c.size, candidates.left(c)))


def rivals_of(candidates: Candidates, best: Candidate) -> tuple[tuple[str, ...], ...]:
    """
    Return the sets of equal size that are not separated from the best set, ordered by error.

    Their errors are at most slightly larger.  If the best set explains only a part, the law of the
    remaining error is unknown.  A set is then a rival, too, if it removes most of the error that
    the best set removes.
    """
    left, whole = candidates.left(best), candidates.left(candidates.without(best.effects))
    most = RIVALS * left
    if candidates.is_part(left, whole):
        most = max(most, left + TAKES * (whole - left))
    found = []
    for other in candidates.sets:
        if len(other) != len(best.effects) or other == best.effects:
            continue
        if best.effects in _narrower(other):
            continue
        rival = candidates.best(other, best.effects)
        if rival is not None and candidates.left(rival) <= most:
            found.append(other)
    return tuple(found)


def change_g(effects: Sequence[str]) -> bool:
    """Return whether at least one of the effects changes G."""
    return any(find_effect(name).in_dynamics for name in effects)


def _parts(effects: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield all smaller sets of the same effects."""
    for k in range(len(effects)):
        yield from itertools.combinations(effects, k)


def _narrower(effects: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the sets with an effect in the place of one that contains it."""
    for name in effects:
        for other in find_effect(name).contains:
            yield tuple(sorted({*effects, other} - {name}))


def _beyond_chance(candidate: Candidate) -> bool:
    """Return whether the effect found last gains more than on surrogates of the residual."""
    found, fitted = candidate.found_in, candidate.fitted
    # an effect that only depends on time fits a shifted residual equally well
    if found is None or find_effect(fitted.name).time_driven:
        return True
    gain = found.before.mean_square - fitted.mean_square
    return gain >= BEYOND_CHANCE * found.chance.get(fitted.name, 0.0)
