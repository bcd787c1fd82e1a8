# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The three steps on labelled records: delay from steps, G from noise, H from a triangle.

H is fitted last.  The squared free-run error on held-out samples then decides whether a law fitted
to all motion replaces plays, whether pairs of slow poles and zeros stay in G, and whether G stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.errors import (
    fitted_memories,
    moves_on,
    squares_left,
    with_fine_plays,
)
from piezo_ident.identification.prepare import Excerpt, excerpts_of, Run
from piezo_ident.identification.results import FitOutcome, Steps
from piezo_ident.identification.settings import Progress, Settings
from piezo_ident.identification.starts import lag_of, with_starts
from piezo_ident.identification.step1_delay import DelayResult, first_step
from piezo_ident.identification.step2_dynamics import (
    beside_law,
    DynamicsResult,
    second_step,
    without_pairs,
)
from piezo_ident.identification.step3_choice import LAW_GAIN, Means, third_step
from piezo_ident.identification.step3_hysteresis import fit_again, HysteresisFit
from piezo_ident.identification.warnings import warn_of_delay, warn_of_thresholds, warn_of_triangle
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics

#: kinds of segments that are fitted; all others are only judged
FITTED = ('triangle', 'noise', 'settle', 'step')
#: a model without a pair of poles and zeros that H may replace may err more by this share
AS_WELL = 0.01
#: largest orders that are tried besides `Settings.max_order` if G has such a pair
SMALLER = (8, 4)


def model_of(
    rate: float, scaling: Scaling, fit: HysteresisFit, G: Dynamics, delay: Delay
) -> StageModel:
    """Build the model; its zero of displacement is that of the last fitted excerpt."""
    moved = replace(scaling, y0=scaling.y0 + float(fit.offsets[-1]) * scaling.Y)
    return StageModel(rate, moved, fit.hysteresis, G, delay)


def within(model: StageModel, low: float, high: float) -> StageModel:
    """Set the identified range of a model to two normalised voltages."""
    span = (model.scaling.v(low), model.scaling.v(high))
    return replace(model, scaling=replace(model.scaling, range=span))


def fit_three_steps(
    runs: Sequence[Run],
    rate: float,
    scaling: Scaling,
    settings: Settings,
    progress: Progress,
    steps: Steps,
) -> FitOutcome:
    """Take the missing steps, and choose between models by their error on held-out samples."""
    started, steps = with_starts(runs), steps.beside(settings.delay)
    delay_result = steps.delay or first_step(started, settings, progress)
    delay = Delay(delay_result.samples)
    fitter = _LabelledFitter(runs, rate, scaling, settings, progress, delay)
    second = steps.dynamics or second_step(started, delay, settings, progress)
    best = fitter.without_pairs(fitter.fitted(*second, lean=False), started)
    best, delay_result, missing = fitter.with_useful_dynamics(best, delay_result)
    runs, model = best.runs, best.model
    span = min(e.span[0] for e in best.fit), max(e.span[1] for e in best.fit)
    warnings = warn_of_thresholds(best.held, settings.thresholds, best.hysteresis.law)
    warnings += warn_of_delay(delay_result)
    if outside := warn_of_triangle(*span, scaling):
        warnings += outside
        model = within(model, *span)
    masks = [(run.mask(*FITTED) & ~(out := run.held_out()), out) for run in runs]
    results = model, delay_result, best.dynamics, best.hysteresis
    memories = fitted_memories(runs, model)
    return FitOutcome(*results, masks, warnings, tuple(missing.items()), memories)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Results of steps 2 and 3; `left` is the sum of squared errors on held-out samples [m^2]."""

    runs: Sequence[Run]
    fit: Sequence[Excerpt]
    held: Sequence[Excerpt]
    dynamics: DynamicsResult
    hysteresis: HysteresisFit
    model: StageModel
    left: float


@dataclass(frozen=True, eq=False)
class _LabelledFitter:
    """Third step on labelled runs, and its comparisons; the runs have no fitted starts yet."""

    runs: Sequence[Run]
    rate: float
    scaling: Scaling
    settings: Settings
    progress: Progress
    delay: Delay

    def fitted(self, dynamics: DynamicsResult, G: Dynamics, lean: bool) -> _Fitted:
        """Fit starts and H beside G; refine G if H is no sum of plays, if `lean` without pairs."""
        settings, progress, delay = self.settings, self.progress, self.delay
        # fit the starts again with the lag of this G
        runs = with_starts(self.runs, lag_of(G, delay))
        fit, held = (excerpts_of(runs, 'triangle', held=held) for held in (False, True))
        small = excerpts_of(runs, 'step', 'settle', 'noise')
        fitted_to: Sequence[Excerpt] = fit
        hysteresis = third_step(fit, held, G, delay, settings, progress, others=small)
        model = model_of(self.rate, self.scaling, hysteresis, G, delay)
        if hysteresis.law == 'plays' and settings.thresholds is None and moves_on(model, runs):
            motion = [Means(e.u, e.x, e.use, e.memory) for e in excerpts_of(runs, *FITTED)]
            other = third_step(fit, held, G, delay, settings, progress, motion, others=small)
            left = squares_left(model_of(self.rate, self.scaling, other, G, delay), runs)
            if other.law != 'plays' and left < (1.0 - LAW_GAIN) ** 2 * squares_left(model, runs):
                hysteresis, fitted_to = other, motion
        if hysteresis.law != 'plays':
            # G was found with plays
            refined = beside_law(runs, hysteresis.hysteresis, dynamics, G, delay, lean)
            if refined is not None:
                dynamics, G = refined
                hysteresis = fit_again(hysteresis, fitted_to, G, delay)
        model = model_of(self.rate, self.scaling, hysteresis, G, delay)
        return _Fitted(runs, fit, held, dynamics, hysteresis, model, squares_left(model, runs))

    def without_pairs(self, best: _Fitted, started: Sequence[Run]) -> _Fitted:
        """Replace a G with pairs by the smallest G that errs at most `AS_WELL` above the best."""
        G, settings = best.model.dynamics, self.settings
        if without_pairs(G, self.rate).a.size == G.a.size:
            return best
        sizes = [n for n in SMALLER if n < settings.max_order and not settings.order]
        candidates = [best]
        for size in (settings.max_order, *sizes):
            of_size = replace(settings, max_order=size)
            # all models of such a low order may be unstable
            with suppress(IdentificationError):
                second = second_step(started, self.delay, of_size, self.progress, lean=True)
                candidates.append(self.fitted(*second, lean=True))
        # a small order is better: H may replace the pair, and a large order fits errors of H
        limit = (1.0 + AS_WELL) ** 2 * min(one.left for one in candidates)
        return next((one for one in reversed(candidates) if one.left < limit), best)

    def with_useful_dynamics(
        self, best: _Fitted, delay_result: DelayResult
    ) -> tuple[_Fitted, DelayResult, dict[str, str]]:
        """
        Drop G and the delay if the model errs less without them; also return the reasons.

        Both models are judged with fine plays, because errors of few plays say nothing about G.
        """
        is_given = delay_result.source == 'given'
        delay, fine = self.delay if is_given else Delay(0), best.model
        if best.hysteresis.law == 'plays':
            fine = with_fine_plays(fine, best.fit)
        without = replace(fine.without_dynamics(), delay=delay)
        left, of_static = (squares_left(model, best.runs) for model in (fine, without))
        if left <= of_static:
            return best, delay_result, {}
        reason = (
            f'with {"it" if is_given else "both"} the model errs {np.sqrt(left / of_static):.4g} '
            'times as much as without on the selection data; record noise of larger amplitude'
        )
        missing = dict.fromkeys(('dynamics',) if is_given else ('delay', 'dynamics'), reason)
        G = Dynamics.unit()
        dynamics = replace(best.dynamics, order=(0, 1), covariance=np.zeros((1, 1)))
        hysteresis = third_step(best.fit, best.held, G, delay, self.settings, self.progress)
        model = model_of(self.rate, self.scaling, hysteresis, G, delay)
        best = replace(best, dynamics=dynamics, hysteresis=hysteresis, model=model)
        return best, delay_result if is_given else delay_result.unknown, missing
