# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The decision: which candidate, by one ratio of what candidates leave of data that were held out.

A candidate is a set K of effects in a model whose H and G are treated in some way.  Its error is
the geometric mean of two mean squares, of blocks held out in spread sets and of whole kinds of
motion held out, and a set has the error of its best way:

    left(K) = max(E(K) - noise, 0) + NOISE_SHARE noise.

A set is admissible if it is larger than the smallest effect, and if each of its effects takes most
of what is left without it; beside another effect, of blocks alone, too.  Of the admissible sets
the one that leaves least is taken, or one with fewer parameters that leaves about as much; sets
of the same size that leave hardly more are its rivals, and with them it is a class.  Size decides,
not significance: of 100,000 samples any law of the right trend takes a significant part.

An effect that follows the path of the voltage is in any H wide enough, so beside that it takes
nothing.  But where it has set in since the identification, the H as given does not hold it: where
one such effect beside that H does most of what another H does, that is the finding.
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

#: loops that the H of any material has a little
OF_MATERIALS = 'noncongruent_minor_loops'


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    A set of effects beside one treatment of H and G, fitted.

    Attributes
    ----------
    effects : tuple of str
        Names, sorted, but for those that tests of their own have shown.
    way : str
        How H is treated: 'given', 'plays' or 'wide'.
    fitted : Fitted
    found_in : Round or None
        The search that found it.
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
        What G may miss of motion like this by what it missed when it was identified, rms in % of
        stroke: no smaller change of G can be told.
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
        """What counts as left of the noise, a mean square."""
        return NOISE_SHARE * self.noise

    def left(self, candidate: Candidate) -> float:
        """Return what a candidate leaves beyond the noise, a mean square."""
        return self.left_by(candidate.fitted)

    def left_by(self, fitted: Fitted) -> float:
        """Return what a fit leaves beyond the noise, a mean square."""
        error = np.sqrt(fitted.errors.sum() * fitted.transfer.sum()) / self.rows.n
        return self.beyond_noise(float(error))

    def beyond_noise(self, square: float) -> float:
        """Return a mean square without the noise, but for a share of it."""
        return max(square - self.noise, 0.0) + self.least_share

    def _of_blocks(self, candidate: Candidate) -> float:
        """Return what is left of blocks held out in spread sets alone."""
        return self.beyond_noise(candidate.fitted.mean_square)

    def percent(self, left: float) -> float:
        """Return what is left as rms in % of stroke."""
        return self.rows.percent(left - self.least_share)

    def is_part(self, left: float, whole: float) -> bool:
        """Return whether what is left of a whole is more than little, and could be an effect."""
        return left > LITTLE * whole and self.percent(left) >= SMALLEST_EFFECT

    def of(self, effects: tuple[str, ...], beside: tuple[str, ...] = ()) -> tuple[Candidate, ...]:
        """
        Return the candidates of a set, the best first; empty where there is none.

        Beside a set that changes G a retuned G is a change, too, and does not count.
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
        """The sets of effects, the one that leaves least first."""
        least: dict[tuple[str, ...], float] = {}
        for c in self.all:
            best = self.best(c.effects)
            if best is not None:
                least[c.effects] = self.left(best)
        return tuple(sorted(least, key=least.__getitem__))

    def is_admissible(self, effects: tuple[str, ...]) -> bool:
        """Return whether a set is large enough, and each of its effects takes most of the rest."""
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
            # beside another effect it must not be kinds of motion alone that speak for it
            if part and self._of_blocks(best) > most * self._of_blocks(other):
                return False
            changes = change_g(tuple(set(effects) - set(part)))
            if changes and self.rows.percent(before - left) < self.missed:
                return False
        return _beyond_chance(best)

    def _missed_by_g(self, part: tuple[str, ...]) -> float:
        """Return what is left with a changed G that takes no more than G missed before."""
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
        """Return what the model leaves with the H as given."""
        return min(self.left(c) for c in self.of((), effects) if c.way == 'given')

    @property
    def as_given(self) -> Candidate:
        """The model as it was given."""
        found = (c for c in self.of(()) if c.way == 'given' and not c.retunes)
        return next(found)

    @property
    def given(self) -> float:
        """What the model leaves as it was given."""
        return self.left(self.as_given)

    def like_refit(self) -> tuple[Candidate, ...]:
        """
        Return the effects of the path, beside the H as given, that do most of what a refit does.

        The best comes first.
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
    What is decided.

    Attributes
    ----------
    best : Candidate or None
        None where no set of effects is admissible.
    rivals : tuple of tuple of str
        Sets of the same size that are not separated from it, the best first.
    names : tuple of str
        Of its effects and those of its rivals, the ones that not all of them have: a class.
    whole : float
        What there was to explain, a mean square: what the H and G that fit best leave without an
        effect, or what the model leaves as given where an effect has set in since.
    set_in : bool
        Whether one has.
    """

    best: Candidate | None
    whole: float
    rivals: tuple[tuple[str, ...], ...] = ()
    names: tuple[str, ...] = ()
    set_in: bool = False


def decide(candidates: Candidates) -> Decision:
    """Return the decision on candidates."""
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
    Return the decision where no set is admissible beside the H that fits best.

    Without labels nothing tells what the model missed of other motion from the beginning.  Loops
    that are not congruent need not have set in: the H of any material has some.
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
    """Return the best candidate, or one that leaves about as much with fewer parameters."""
    least = min(map(candidates.left, some))
    alike = [c for c in some if candidates.left(c) <= ALIKE * least]
    return min(alike, key=lambda c: (c.size, candidates.left(c)))


def rivals_of(candidates: Candidates, best: Candidate) -> tuple[tuple[str, ...], ...]:
    """
    Return the sets of the size of the best one that are not separated from it, the best first.

    They leave hardly more.  Where the best one explains a part alone, the rest may be of any law:
    then a set that takes most of what the best one takes is one of them, too.
    """
    left, whole = candidates.left(best), candidates.left(candidates.without(best.effects))
    most = RIVALS * left
    if candidates.is_part(left, whole):
        most = max(most, left + TAKES * (whole - left))
    found = []
    for other in candidates.sets:
        if len(other) != len(best.effects) or other == best.effects:
            continue
        rival = candidates.best(other, best.effects)
        if rival is not None and candidates.left(rival) <= most:
            found.append(other)
    return tuple(found)


def change_g(effects: Sequence[str]) -> bool:
    """Return whether one of some effects changes G."""
    return any(find_effect(name).in_dynamics for name in effects)


def _parts(effects: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Give all smaller sets of the same effects."""
    for k in range(len(effects)):
        yield from itertools.combinations(effects, k)


def _beyond_chance(candidate: Candidate) -> bool:
    """Return whether the effect found last gains more than on surrogates of the residual."""
    found, fitted = candidate.found_in, candidate.fitted
    # what follows time alone fits a shifted residual as well
    if found is None or find_effect(fitted.name).time_driven:
        return True
    gain = found.before.mean_square - fitted.mean_square
    return gain >= BEYOND_CHANCE * found.chance.get(fitted.name, 0.0)
