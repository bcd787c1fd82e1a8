# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit the unknown memory of labelled runs that do not start at the lowest voltage.

A play may stand still at an unknown output until the voltage has moved by its threshold.  A
free-run fit varies weights and start together; the shares m of `fitting.stage` describe the start.
Each block of a run is thinned to its extremes, which decide the play outputs, and its last sample,
at which the fit compares the displacement.  The best of several guesses is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.fitting.free_run import Fit, fit
from piezo_ident.fitting.stage import memory_of, PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.prepare import Excerpt, Run
from piezo_ident.identification.step3_hysteresis import even_thresholds
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw

Rule = Callable[[Array], Array]

#: number of blocks into which a run is thinned: to choose a guess, and to fit the memory
ROUGH, BLOCKS = 500, 2000
#: number of plays of the temporary H, and of the blocks of a run in the fit (both taste)
PLAYS, FIT_BLOCKS = 40, 50
#: number of shares of the fitted memory for each share of a guess
FINER = 2
#: shares m of plays that a last rise has pushed up, and that a last fall has pushed down
ENDS = (0.9, 0.1)
#: iterations from every guess, iterations from the best guesses, and number of best guesses
FEW, MANY, BEST = 3, 15, 1
#: share by which another guess must err less than the plain guess to be chosen: a record of steps
#: alone tells little about the memory
CLEARLY = 0.02


def _guesses() -> Array:
    """List guesses: between the branches of a stage, after a last rise, and after a last fall."""
    between = [np.full(PARTS, share) for share in (0.5, 0.25, 0.75)]
    turned = [np.where(np.arange(PARTS) < k, *ENDS) for k in range(PARTS + 1)]
    back = [1.0 - shares for shares in turned[1:-1]]
    return np.array([*between, *turned, *back])


def _thinned(excerpts: Sequence[Excerpt], lag: float, count: int) -> list[Stretch]:
    """Thin runs to extremes and last samples of `count` blocks; the displacement lags by `lag`."""
    stretches = []
    for i, excerpt in enumerate(excerpts):
        u, n = excerpt.u, excerpt.u.size
        size = max(1, n // count)
        edges = np.arange(0, n - n % size, size)
        blocks = u[: edges.size * size].reshape(-1, size)
        last = edges + size - 1
        keep = np.unique([edges + blocks.argmin(axis=1), edges + blocks.argmax(axis=1), last])
        at = np.minimum(keep + lag, n - 1)
        use = np.isin(keep, last) & (keep + lag <= n - 1) & excerpt.use[np.rint(at).astype(int)]
        x = np.interp(at, np.arange(n), excerpt.x)
        block = (i + np.arange(keep.size) / keep.size) * FIT_BLOCKS
        stretches.append(Stretch(u[keep], x, use, block.astype(int), 1.0, i, i))
    return stretches


def fit_starts(
    excerpts: Sequence[Excerpt], unknown: Sequence[bool], lag: float = 0.0
) -> list[Rule | None]:
    """
    Find the memory at the start of each run as a function of the thresholds.

    Parameters
    ----------
    excerpts : sequence of Excerpt
        Runs with the samples to use, preferably slow motion; each gets an offset.
    unknown : sequence of bool
        Whether the memory of a run is fitted; the other runs keep theirs.
    lag : float, optional
        Samples by which the displacement follows slow motion, through the delay and G.

    Returns
    -------
    list of callable or None
        `Excerpt.memory` of each run.
    """
    rules = [e.memory for e in excerpts]
    stretches = _thinned(excerpts, lag, BLOCKS)
    sought = [i for i, is_sought in enumerate(unknown) if is_sought and stretches[i].use.any()]
    if not sought:
        return rules
    span = min(float(e.u.min()) for e in excerpts), max(float(e.u.max()) for e in excerpts)
    law = HysteresisLaw('plays', even_thresholds(span[1] - span[0], PLAYS), span)

    rough = _thinned(excerpts, lag, ROUGH)
    rough = rough if all(s.use.any() for s in rough) else stretches

    def rough_fit(shares: Array) -> Fit:
        guesses = np.zeros((len(excerpts), PARTS))
        guesses[sought] = shares
        return fit(Stage.linear(law, Dynamics.unit(), 0, guesses), rough, iterations=FEW)

    def full_fit(one: Fit) -> Fit:
        starts, guesses = (np.repeat(x, FINER, 1) for x in (one.stage.starts, one.stage.guesses))
        finer = replace(one.stage, starts=starts, guesses=guesses)
        return fit(finer, stretches, iterations=MANY)

    plain, *others = map(rough_fit, _guesses())
    plain, *others = map(full_fit, [plain, *sorted(others, key=lambda one: one.loss)[:BEST]])
    chosen = min(others, key=lambda one: one.loss)
    stage = (chosen if chosen.loss < (1.0 - CLEARLY) * plain.loss else plain).stage
    for i in sought:
        u0, widest = float(excerpts[i].u[0]), float(law.thresholds[-1])
        rules[i] = partial(memory_of, u0, widest, stage.starts[i])
    return rules


def lag_of(G: Dynamics, delay: Delay) -> float:
    """Compute the number of samples by which the displacement follows slow motion."""
    a = np.concatenate([[1.0], G.a])
    k_b, k_a = np.arange(G.b.size), np.arange(a.size)
    return delay.total + float(k_b @ G.b / G.b.sum() - k_a @ a / a.sum())


def with_starts(runs: Sequence[Run], lag: float = 0.0) -> list[Run]:
    """
    Fit the memory at the start of runs to the fitted samples of their triangles.

    All samples of a run count as known once its memory is fitted.  `lag` is as in `fit_starts`.
    """
    excerpts = [run.excerpt(run.mask('triangle') & run.use & ~run.held_out()) for run in runs]
    driven = [i for i, e in enumerate(excerpts) if e.use.any()]
    unknown = [not bool(np.array_equal(runs[i].known, runs[i].use)) for i in driven]
    fitted_runs = list(runs)
    rules = fit_starts([excerpts[i] for i in driven], unknown, lag)
    for i, rule in zip(driven, rules, strict=True):
        if rule is not None:
            fitted_runs[i] = replace(runs[i], memory=rule, known=runs[i].use)
    return fitted_runs
