# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Step 3: choose the law of H and its thresholds by data that were not fitted.

Each of eight parts of the data is predicted from all other parts.  A wider law must lower the
geometric mean of the rms errors by `LAW_GAIN`, even with one standard error added.  Small motion
may reject this law.  Otherwise H is a sum of plays, with finer thresholds as long as held-out
blocks err less.  The error of the fit itself would prefer laws that are too wide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.choice import simplest
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.settings import Progress, Settings
from piezo_ident.identification.solvers.least_squares import triangular_factor
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    filtered_rows,
    fit_hysteresis,
    HysteresisFit,
)
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName, LAWS

#: number of plays in the paper, used if the data cannot choose their number
PAPER_COUNT = 10
#: numbers of evenly spaced thresholds that are tried, one after the other
COUNTS = (10, 14, 20, 28, 40, 56, 80)
#: share by which a larger number must lower the held-out error
GAIN = 0.01
#: number of thresholds that small motion may add below the smallest
SMALL = 4
#: number of operators of a wider law, and number of parts of the record that are predicted in turn
FINE, PARTS = 40, 8
#: share by which a wider law must lower the error of the parts.  Wrong laws lowered the error by
#: up to 17 % (on loops of Bouc-Wen and Duhem models).  The right law lowered it by 60 to 95 % (on
#: Preisach loops)
LAW_GAIN = 0.25
#: largest error of a wider law on small motion, relative to the error of plays.  For a law with
#: lags along the path, the limit is 1 - `LAW_GAIN` instead.  The error of this law was 6 to 27 %
#: on its own kinds of loops, and 84 % under creep
NO_WORSE = 1.1


def merged(hysteresis: Hysteresis) -> Array:
    """
    Merge the thresholds of a fit on a fine grid into fewer thresholds in better places.

    On a grid finer than the truth, least squares puts a weight on the two neighbours of each true
    threshold and zero elsewhere.  Each such pair becomes one threshold at its centre of weight.

    Examples
    --------
    >>> merged(Hysteresis([0.1, 0.2, 0.3, 0.4], [0.0, 0.5, 0.5, 0.0], 0.0, 1.0))
    array([0.25])
    """
    r, q = hysteresis.thresholds, hysteresis.weights
    alive = q > 1e-6 * max(float(q.max(initial=0.0)), 1e-12)
    places, i = list[float](), 0
    while i < r.size:
        count = int(alive[i : i + 2].sum()) if alive[i] else 0
        pair = slice(i, i + count)
        if count:
            places.append(float(r[pair] @ q[pair] / q[pair].sum()))
        i += max(count, 1)
    return np.array(places)


def _held_loss(
    fit: Sequence[Excerpt],
    held: Sequence[Excerpt],
    thresholds: Array,
    dynamics: Dynamics,
    delay: Delay,
) -> tuple[float, Array]:
    result = fit_hysteresis(factorise(fit, thresholds, dynamics, delay), thresholds)
    R = factorise(held, thresholds, dynamics, delay)
    return float(np.sqrt(result.left(R))), merged(result.hysteresis)


def choose_thresholds(
    fit: Sequence[Excerpt],
    held: Sequence[Excerpt],
    swing: float,
    dynamics: Dynamics,
    delay: Delay,
    tick: Callable[[float], None] = lambda share: None,
) -> Array:
    """
    Refine the thresholds until two larger grids in a row lower the held-out error too little.

    At each size of the grid, plays without weight are dropped and neighbours are merged.  The
    merged thresholds compete with the grid by their held-out error, to which each threshold
    adds 0.1 %.  `fit` and `held` are the same runs in the same order with the fitted and the
    held-out samples.  `swing` is the excited range of the normalised voltage.  `tick` is called
    with the share of the work done, and may raise to stop it.
    """
    best = even_thresholds(swing, COUNTS[0])
    best_loss, _ = _held_loss(fit, held, best, dynamics, delay)
    misses = 0
    for i, count in enumerate(COUNTS[1:]):
        tick(i / len(COUNTS))
        even = even_thresholds(swing, count)
        loss, places = _held_loss(fit, held, even, dynamics, delay)
        candidates = [(loss, even)]
        if 1 < places.size < even.size:
            candidates.append((_held_loss(fit, held, places, dynamics, delay)[0], places))
        # the price of a threshold lets fewer thresholds win a tie
        loss, thresholds = min(
            candidates, key=lambda c: (c[0] * (1 + 1e-3 * c[1].size), c[1].size)
        )
        if loss < (1.0 - GAIN) * best_loss:
            best, best_loss, misses = thresholds, loss, 0
        else:
            misses += 1
            if misses == 2:
                break
    return best


def with_small(
    thresholds: Array,
    fit: Sequence[Excerpt],
    small: Sequence[Excerpt],
    dynamics: Dynamics,
    delay: Delay,
) -> Array:
    """
    Add small thresholds if the small motion needs them; each is half of the next.

    A triangle over the whole range hardly shows how a small loop opens.  Steps and noise move in
    small loops, so the excerpts `small` of such motion judge the fit to `fit`.
    """
    finer = np.concatenate([thresholds[0] / 2.0 ** np.arange(SMALL, 0, -1), thresholds])

    def error(r: Array) -> float:
        h = fit_hysteresis(factorise(fit, r, dynamics, delay), r).hysteresis
        # the rows below the offsets are free of the offsets
        R = factorise(small, h.thresholds, dynamics, delay)[len(small) :, len(small) :]
        return float(np.linalg.norm(R[:, :-1] @ [*h.weights, h.p1, h.p2] - R[:, -1]))

    return finer if small and error(finer) < error(thresholds) / NO_WORSE else thresholds


@dataclass(frozen=True, eq=False)
class Means(Excerpt):
    """Excerpt of fast motion, compared by means over rows, in which the error of G vanishes."""

    @property
    def row(self) -> int:
        """Number of samples that a row averages."""
        return max(1, min(int(self.use.sum()) // 1000, 50))


@dataclass(frozen=True, eq=False)
class Choice:
    """
    Choice of a law for H; the law is None if the plain sum of plays stays.

    Each part of the data is predicted from all other parts.  `errors` holds, for each tried law,
    the geometric mean of the rms errors of the parts, normalised.
    """

    law: HysteresisLaw | None
    errors: Mapping[str, float] = field(default_factory=dict)


def choose_law(
    excerpts: Sequence[Excerpt],
    dynamics: Dynamics,
    delay: Delay,
    tick: Callable[[float], None] = lambda share: None,
    others: Sequence[Excerpt] = (),
) -> Choice:
    """
    Choose the law of H by parts of the data that are predicted from all others.

    `others` is small motion, on which a wider law must err at most `NO_WORSE` times as much as
    plays.  A law with lags must err by `LAW_GAIN` less than plays, because under a triangle of
    one speed creep looks like a lag along the path.
    `tick` is called with the share of the work done, and may raise to stop it.
    """
    span = min(e.span[0] for e in excerpts), max(e.span[1] for e in excerpts)
    r = even_thresholds(max(e.swing for e in excerpts), FINE)
    law_of = {name: HysteresisLaw(name, r, span) for name in LAWS}
    all_terms = HysteresisLaw('any', r, span)
    parts = _parts(excerpts, all_terms, dynamics, delay)
    tick(0.3)
    whole = triangular_factor(parts, parts[0].shape[1])

    def fitted(R: Array, law: HysteresisLaw) -> HysteresisFit:
        return fit_hysteresis(_of(R, law, all_terms), law)

    # the columns of all laws together, with free weights, are a lower bound for every law
    least = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=1e-10)[0]
    floor = float(np.sum((whole[:, :-1] @ least - whole[:, -1]) ** 2))
    if len(parts) < PARTS or floor > (1.0 - LAW_GAIN) ** 2 * fitted(whole, law_of['plays']).loss:
        return Choice(None)
    losses: dict[str, Array] = {}
    for i, (name, law) in enumerate(law_of.items()):
        each = (fitted(_all_but(parts, j), law).coefficients for j in range(len(parts)))
        losses[name] = np.array(
            [_left_out(R, x, law, all_terms) for R, x in zip(parts, each, strict=True)]
        )
        tick(0.3 + 0.7 * (i + 1) / len(LAWS))
    logs = {name: 0.5 * np.log(loss) for name, loss in losses.items()}
    errors = {name: float(np.exp(log.mean())) for name, log in logs.items()}
    better = [
        name
        for name in LAWS[1:]
        if _upper(logs[name] - logs['plays']) < np.log(1.0 - LAW_GAIN)
        and fitted(whole, law_of[name]).hysteresis.lowest_slope() > 0
    ]
    for excerpt in others if better else ():
        laws = {name: law_of[name] for name in ('plays', *better)}
        fits = {name: (law, fitted(whole, law).coefficients) for name, law in laws.items()}
        better = _kept_on_small_motion(fits, excerpt, all_terms, dynamics, delay)
    if not better:
        return Choice(None, errors)
    chosen = simplest(better, errors.__getitem__, LAWS.index, 1.0 / (1.0 - LAW_GAIN))
    return Choice(law_of[chosen], errors)


def _kept_on_small_motion(
    fits: Mapping[LawName, tuple[HysteresisLaw, Array]],
    excerpt: Excerpt,
    all_terms: HysteresisLaw,
    dynamics: Dynamics,
    delay: Delay,
) -> list[LawName]:
    """List the laws, fitted with these coefficients, that small motion does not reject."""
    means = Means(excerpt.u, excerpt.x, excerpt.use, excerpt.memory)
    [rows] = filtered_rows([means], all_terms, dynamics, delay)
    R = triangular_factor([rows], rows.shape[1])
    left = {name: _left_out(R, x, law, all_terms) for name, (law, x) in fits.items()}
    worst = {name: 1.0 - LAW_GAIN if law.lags else NO_WORSE for name, (law, _) in fits.items()}
    return [n for n in fits if n != 'plays' and left[n] <= worst[n] ** 2 * left['plays']]


def _upper(difference: Array) -> float:
    """Compute the mean plus one standard error."""
    return float(difference.mean() + difference.std(ddof=1) / np.sqrt(difference.size))


def _parts(
    excerpts: Sequence[Excerpt], law: HysteresisLaw, dynamics: Dynamics, delay: Delay
) -> list[Array]:
    """Compute the factor of each part, with the columns of `factorise`."""
    total = sum(e.rows for e in excerpts)
    parts = []
    for e, rows in zip(excerpts, filtered_rows(excerpts, law, dynamics, delay), strict=True):
        for part in np.array_split(rows, max(1, math.ceil(PARTS * e.rows / max(total, 1)))):
            parts.append(triangular_factor([part], rows.shape[1]) / np.sqrt(max(len(part), 1)))
    return parts


def _all_but(parts: Sequence[Array], j: int) -> Array:
    """Combine the factors of all parts except part j."""
    return triangular_factor([R for i, R in enumerate(parts) if i != j], parts[j].shape[1])


def _of(R: Array, law: HysteresisLaw, all_terms: HysteresisLaw) -> Array:
    """Select the columns of one law, and the used offsets, from a factor for all terms."""
    k = R.shape[1] - all_terms.size - 1
    offsets = np.flatnonzero(np.any(R[:, :k], axis=0))
    columns = [*offsets, *(k + law.within(all_terms)), R.shape[1] - 1]
    return np.asarray(np.linalg.qr(R[:, columns], mode='r'))


def _left_out(
    R: Array, coefficients: Array, law: HysteresisLaw, all_terms: HysteresisLaw
) -> float:
    """Compute the mean square of a part around its own offset."""
    R = _of(R, law, all_terms)
    # the rows below the offset are free of the offset
    inner = R[R.shape[1] - law.size - 1 :, -law.size - 1 :]
    return float(np.sum((inner[:, :-1] @ coefficients - inner[:, -1]) ** 2))


def third_step(
    fit: Sequence[Excerpt],
    held: Sequence[Excerpt],
    G: Dynamics,
    delay: Delay,
    settings: Settings,
    progress: Progress,
    whole: Sequence[Excerpt] | None = None,
    others: Sequence[Excerpt] = (),
) -> HysteresisFit:
    """
    Find H: choose law and thresholds by held-out error, then fit the weights.

    A number of thresholds in the settings stays.  `fit` and `held` are the same runs in the same
    order with the fitted and the held-out samples.  The final weights are fitted to `whole`, by
    default `fit`.  `others` is small motion, which can reject a wider law.
    """
    progress('hysteresis', 0.0)
    fitted = whole or fit
    swing = max(e.swing for e in fitted)
    choice = Choice(None)
    if settings.thresholds is None and settings.solver == 'least_squares':
        choice = choose_law(
            fitted, G, delay, lambda share: progress('hysteresis', 0.2 * share), others
        )
    law: HysteresisLaw | Array
    if choice.law is not None:
        law = choice.law
    elif settings.thresholds is not None:
        law = even_thresholds(swing, settings.thresholds)
    elif any(e.use.any() for e in held):
        law = choose_thresholds(
            fit, held, swing, G, delay, lambda share: progress('hysteresis', 0.2 + 0.1 * share)
        )
        law = with_small(law, fit, others, G, delay)
    else:
        law = even_thresholds(swing, PAPER_COUNT)
    n, rows = int(sum(e.use.sum() for e in fitted)), sum(e.rows for e in fitted)
    R = factorise(fitted, law, G, delay)
    progress('hysteresis', 0.3)
    share = 0.6 / settings.swarm_iterations
    result = fit_hysteresis(
        R,
        law,
        n,
        rows=rows,
        solver=settings.solver,
        polish=settings.polish,
        rng=np.random.default_rng(settings.seed),
        swarm_size=settings.swarm_size,
        maxiter=settings.swarm_iterations,
        callback=lambda swarm: progress('hysteresis', 0.3 + share * swarm.nit),
    )
    progress('hysteresis', 1.0)
    return replace(result, errors_of_laws=choice.errors)
