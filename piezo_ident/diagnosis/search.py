# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One round of the search: which candidate lowers the error on data that were not fitted.

Every candidate is tried by finite differences of the whole model, the effect switched slightly
on.  Its columns are scored by what they gain on held-out blocks in addition to all that is in the
model already, against what chance gains on circular-shift surrogates of the residual.  The most
promising ones are fitted together with everything else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.diagnosis.criteria import (
    AHEAD,
    FINAL,
    FIRST,
    JOINT_FITS,
    ON_AMPLITUDE,
    POLISHING,
    SIMPLER,
    STARTS,
    SURROGATES,
    WORTH_FIT,
)
from piezo_ident.diagnosis.cross_validation import (
    held_out_errors,
    normal_equations,
    NormalEquations,
    solve,
    with_columns,
)
from piezo_ident.diagnosis.joint_fit import base_at, fit_base, fit_jointly, Fitted
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.signature import shows
from piezo_ident.diagnosis.simulator import Added, Simulator, State
from piezo_ident.effects import Effect, Trial, View
from piezo_ident.effects.trials import number_of
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.residual.stretches import block_means

__all__ = ['Round', 'Scored', 'score_trials', 'search_round', 'started']

Array = NDArray[np.float64]

#: called with the share of the work that is done; may raise `Cancelled`
Tick = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Scored:
    """
    One trial of a candidate and what it would gain.

    Attributes
    ----------
    effect, trial
    coefficients : ndarray, shape (c,)
        Steps of its columns that fit best.
    errors : ndarray, shape (blocks,)
        Sum of squares of each block, held out in spread sets.
    chance : float
        Largest gain in the sum of squares of a surrogate.
    visible : float
        Share of its columns that everything else in the model cannot make up for.
    is_possible : bool
        False where the data speak against it: an effect without amplitudes that should come out
        of the fit about once, and does not.
    """

    effect: type[Effect]
    trial: Trial
    coefficients: Array
    errors: Array
    chance: float
    visible: float
    is_possible: bool = True

    @property
    def error(self) -> float:
        """Sum of the held-out squares."""
        return float(self.errors.sum())


@dataclass(frozen=True, eq=False)
class Round:
    """
    One round of the search.

    Attributes
    ----------
    before : Fitted
        What the candidates were added to.
    best : dict of str to Scored
        The best trial of every candidate that could be tried.
    contenders : tuple of Fitted
        Candidates that were fitted jointly with everything else, best first, and show where they
        should.
    chance : dict of str to float
        Mean square that a candidate gains on surrogates of the residual, at best.
    visible : dict of str to float
        Share of a candidate's own columns that a refit of the rest does not swallow.
    warnings : tuple of str
        Candidates whose joint fit failed, and why.
    """

    before: Fitted
    best: dict[str, Scored]
    contenders: tuple[Fitted, ...]
    chance: dict[str, float]
    visible: dict[str, float]
    warnings: tuple[str, ...] = ()


def search_round(
    simulator: Simulator,
    before: Fitted,
    effects: Sequence[type[Effect]],
    lines: Sequence[float],
    noise: float,
    rng: np.random.Generator,
    tick: Tick,
) -> Round:
    """
    Score all candidates and fit the best of them jointly.

    `lines` are those in the residual [Hz], `noise` is the mean square of the noise of a row, and
    `rng` draws the shifts of the surrogates.
    """
    n = simulator.rows.n
    shifts = rng.integers(n // 20, n - n // 20, 4 * SURROGATES)
    shifted = [np.roll(before.e, int(k)) for k in shifts]
    # of a residual that repeats, a shift by a period is no surrogate
    shifted.sort(key=lambda e: abs(float(e @ before.e)))
    surrogates = np.stack(shifted[:SURROGATES], axis=1)
    trials: dict[str, list[Scored]] = {}
    chance: dict[str, float] = {}
    visible: dict[str, float] = {}
    for scored in score_trials(
        simulator, before, effects, lines, surrogates, lambda share: tick(0.5 * share)
    ):
        name = scored.effect.name
        visible[name] = max(visible.get(name, 0.0), scored.visible)
        if scored.is_possible:
            chance[name] = max(chance.get(name, 0.0), scored.chance / n)
            trials.setdefault(name, []).append(scored)
    for scores in trials.values():
        scores.sort(key=lambda s: s.error)
    best = {name: scores[0] for name, scores in trials.items()}
    total = float(before.errors.sum())
    least = WORTH_FIT * max(total - noise * n, 1e-300)
    promising = [scores for scores in trials.values() if total - scores[0].error > least]
    promising.sort(key=lambda scores: scores[0].error)
    chosen = promising[:JOINT_FITS]
    # a small step does not tell from its like what an effect does in full
    alike = look_alikes(chosen[0][0].effect.name) if chosen else ()
    chosen += [scores for scores in promising[JOINT_FITS:] if scores[0].effect.name in alike]
    starts = [
        (
            scores[0].effect,
            # a law that looks best while it is small need not be the one that fits best
            [before.state.with_effect(started(simulator.rows, s)) for s in scores[:STARTS]],
        )
        for scores in chosen
    ]
    _add_plain_starts(simulator, before, starts, lines)
    contenders, warnings = _contenders(simulator, before, starts, noise, tick)
    tick(1.0)
    return Round(
        before=before,
        best=best,
        contenders=tuple(_simplest_first(contenders, noise)),
        chance=chance,
        visible=visible,
        warnings=tuple(warnings),
    )


def _add_plain_starts(
    simulator: Simulator,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], list[State]]],
    lines: Sequence[float],
) -> None:
    """
    Add the best start of each effect beside a sum of plays, as an H of the wide law.

    A wide H that has made up for an effect hardly lets go of it.
    """
    law = before.state.law
    if not starts or law is None or law.name == 'plays':
        return
    plays = HysteresisLaw('plays', law.thresholds, law.span)
    plain = fit_jointly(simulator, *fit_base(simulator, before.state, plays))
    state = plain.state.with_coefficients(law, law.coefficients(plain.state.hysteresis))
    best: dict[str, Scored] = {}
    none = np.zeros((simulator.rows.n, 0))
    for scored in score_trials(simulator, plain, [effect for effect, _ in starts], lines, none):
        name = scored.effect.name
        if scored.is_possible and (name not in best or scored.error < best[name].error):
            best[name] = scored
    for effect, states in starts:
        if effect.name in best:
            states.append(state.with_effect(started(simulator.rows, best[effect.name])))


def _contenders(
    simulator: Simulator,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], Sequence[State]]],
    noise: float,
    tick: Tick,
) -> tuple[list[Fitted], list[str]]:
    """Return the candidates that show, fitted jointly, best first, and the fits that failed."""
    contenders, warnings = list[Fitted](), list[str]()
    beside_wide: dict[str, Fitted] = {}
    at = 0.5

    def alive() -> None:
        tick(at)

    for i, (effect, states) in enumerate(starts):
        at = 0.5 + 0.5 * i / len(starts)
        alive()
        fits, failure = [], ''
        for state in states:
            try:
                fits.append(
                    fit_jointly(simulator, state, before.base, iterations=FIRST, tick=alive)
                )
            except ModelError:
                # the law cannot run with these parameters
                continue
            except IdentificationError as error:
                failure = f'{effect.name} was not judged: {error}'
        if fits:
            contenders.append(min(fits, key=lambda f: f.mean_square))
            beside_wide[effect.name] = min(fits[:STARTS], key=lambda f: f.mean_square)
        elif failure:
            warnings.append(failure)
    contenders.sort(key=lambda c: c.mean_square)
    for i, contender in enumerate(contenders[:FINAL]):
        try:
            contenders[i] = _to_the_end(simulator, contender, alive)
            other = beside_wide[contender.name]
            if other is not contender:
                # a few iterations do not tell which base leads further
                other = _to_the_end(simulator, other, alive)
                ahead = contenders[i].mean_square < other.mean_square / AHEAD
                if shows(simulator, other, noise) and not (
                    ahead and shows(simulator, contenders[i], noise)
                ):
                    contenders[i] = other
        except IdentificationError as error:
            warnings.append(f'{contender.name} was fitted in {FIRST} iterations only: {error}')
    contenders = [c for c in contenders if shows(simulator, c, noise)]
    contenders.sort(key=lambda c: c.mean_square)
    return contenders, warnings


def _to_the_end(simulator: Simulator, fitted: Fitted, tick: Callable[[], None]) -> Fitted:
    """Return a fit with fresh columns of H, as long as that makes a difference."""
    for _ in range(POLISHING):
        state, before = fitted.state, fitted.mean_square
        fitted = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
        if fitted.mean_square > (1.0 - WORTH_FIT) * before:
            break
    return fitted


def _simplest_first(contenders: list[Fitted], noise: float) -> list[Fitted]:
    """Move the effect with the fewest parameters to the front of those that fit as well."""
    if not contenders:
        return contenders
    limit = SIMPLER * max(contenders[0].mean_square - noise, 0.0) + noise
    good = [c for c in contenders if c.mean_square <= limit]
    simplest = min(good, key=lambda c: len(c.parameters))
    return [simplest, *(c for c in contenders if c is not simplest)]


# -- scores of trials ----------------------------------------------------------------------------


def score_trials(
    simulator: Simulator,
    fitted: Fitted,
    effects: Sequence[type[Effect]],
    lines: Sequence[float],
    surrogates: Array,
    tick: Tick = lambda share: None,
) -> Iterator[Scored]:
    """Score every trial of every effect on the residual of a fit; surrogates, shape (n, k)."""
    rows = simulator.rows
    simulator.remember(fitted.state)
    M, prior = fitted.J, fitted.prior[fitted.free]
    E = np.column_stack([fitted.e, surrogates])
    equations = normal_equations(rows, M, E)
    alone = held_out_errors(equations, rows.fold, prior).sum(axis=0)
    view = _view_of(simulator, lines)
    trials = [(effect, trial) for effect in effects for trial in effect.trials(view)]
    for done, (effect, trial) in enumerate(trials):
        tick(done / len(trials))
        try:
            C = _columns(simulator, effect, trial)
        except ModelError:
            continue
        if not np.all(np.isfinite(C)) or not np.any(C):
            continue
        both = with_columns(rows, equations, M, C, E)
        wide = np.concatenate([prior, np.zeros(C.shape[1])])
        theta = solve(both.A.sum(axis=0), both.b[:, :, 0].sum(axis=0), wide)[M.shape[1] :]
        visible = _visible(both, M.shape[1], wide)
        if not trial.moves and not ON_AMPLITUDE[0] <= theta[0] <= ON_AMPLITUDE[1]:
            yield Scored(effect, trial, theta, equations.s[:, 0], 0.0, visible, False)
            continue
        errors = held_out_errors(both, rows.fold, wide)
        chance = float((alone - errors.sum(axis=0))[1:].max(initial=0.0))
        yield Scored(effect, trial, theta, errors[:, 0], chance, visible)


def _columns(simulator: Simulator, effect: type[Effect], trial: Trial) -> Array:
    """
    Return what an effect would add to the rows for a step of each of its amplitudes.

    Shape (n, c): for an effect that is driven by time, a column for each record and amplitude.
    """
    rows = simulator.rows
    count = len(rows.names)
    columns = []
    for setting in trial.settings():
        column = simulator.added(Added(effect.name, (setting,) * count))
        if effect.time_driven:
            columns += [np.where(rows.of_record == k, column, 0.0) for k in range(count)]
        else:
            columns.append(column)
    return np.array(columns).T


def _visible(equations: NormalEquations, p: int, prior: Array) -> float:
    """Return the largest share of a column that the first p columns cannot make."""
    A = equations.A.sum(axis=0)
    shares = []
    for j in range(p, A.shape[0]):
        theta = solve(A[:p, :p], A[:p, j], prior[:p])
        left = A[j, j] - 2.0 * A[:p, j] @ theta + theta @ A[:p, :p] @ theta
        shares.append(float(left / A[j, j]) if A[j, j] > 0.0 else 0.0)
    return max(shares)


def started(rows: Rows, scored: Scored) -> Added:
    """Return the effect with the amplitudes of its score, where a joint fit may start."""
    effect, trial = scored.effect, scored.trial
    added = Added(effect.name, (trial.values,) * len(rows.names))
    known = {p.name: p for p in effect.parameters}
    steps = iter(scored.coefficients)
    for (name, index), step in zip(trial.moves, trial.steps, strict=True):
        for k in range(len(rows.names)) if effect.time_driven else (None,):
            value = number_of(added.values[k or 0], name, index) + float(next(steps)) * step
            added = added.changed(k, name, index, float(known[name].clip(value)))
    return added


def _view_of(simulator: Simulator, lines: Sequence[float]) -> View:
    rows, model = simulator.rows, simulator.model
    speeds = []
    channels: dict[str, list[Array]] = {}
    for run in rows.runs:
        # over a row, so that converter steps do not count as speed
        speeds.append(np.abs(np.diff(block_means(run.u, rows.m))) * model.sample_rate / rows.m)
        for name, x in run.piece.channels.items():
            channels.setdefault(name, []).append(x)
    speed = np.concatenate(speeds)
    moving = speed[speed > 1e-3 * speed.max(initial=0.0)]
    quantiles = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 0.999])
    # of all records that have it: the axis may rest in one of them
    whole = {name: np.concatenate(parts) for name, parts in channels.items()}
    return View(
        sample_rate=model.sample_rate,
        low=min(float(run.u.min()) for run in rows.runs),
        high=max(float(run.u.max()) for run in rows.runs),
        speeds=np.quantile(moving, quantiles) if moving.size else np.zeros(quantiles.size),
        duration=rows.duration,
        channels={name: (float(x.mean()), float(x.std())) for name, x in whole.items()},
        lines=tuple(lines),
        modes=tuple((m.frequency, m.damping) for m in model.dynamics.modes(model.sample_rate)),
        max_frequency=rows.highest_frequency,
        thresholds=model.hysteresis.thresholds,
    )
