# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Linearise the free run of an identified model in all of its parameters together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Mask
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.jackknife import Linearised
from piezo_ident.fitting.stage import PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.results import Identification
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.selection.judged import Judged, JudgedRun

#: number of blocks of each step, and most rows of its equations (time)
BLOCKS, MOST_ROWS = 30, 50_000
#: most samples times parameters: 1e8 take about two seconds of processor time
MOST_WORK = 3e8
#: kinds of segments to which the steps of labelled records fit H, and G
STEPS = 'triangle', 'noise'


def linearised(result: Identification, judged: Judged) -> Linearised | None:
    """
    Linearise the free run of an identified model at its parameters.

    Returns None for weights of the swarm, for fitted starts of labelled records, for records that
    would take too long, and if the equations have no solution.
    """
    if result.hysteresis.solver == 'swarm':
        return None
    if judged.fit is not None:
        return Linearised.of(judged.fit)
    model, runs = result.model, judged.runs
    try:
        # each step has offsets of its own
        stage = stage_of(model, result.hysteresis.law, len(STEPS) * len(runs))
        # these equations hold the start constant
        if result.memories or stage.values.size * sum(r.use.size for r in runs) > MOST_WORK:
            return None
        stretches = [s for step in range(len(STEPS)) for s in _stretches(model, runs, step)]
        whole = Linearised.of(fit(stage, stretches, iterations=0))
    except (IdentificationError, ModelError):
        return None
    return whole.in_steps(np.arange(len(whole.A)) >= BLOCKS)


def stage_of(model: StageModel, name: str, records: int = 1) -> Stage:
    """Describe a model whose records begin at rest; ModelError if its H is of another law."""
    law = HysteresisLaw(name, model.hysteresis.thresholds, model.hysteresis.span)  # type: ignore[arg-type]
    rest = np.zeros((records, PARTS))
    stage = Stage.linear(law, model.dynamics, model.delay.samples, rest)
    return replace(stage, coefficients=model.dynamics.gain * law.coefficients(model.hysteresis))


def _stretches(model: StageModel, runs: Sequence[JudgedRun], step: int) -> list[Stretch]:
    """Take the samples to which a step was fitted, in `BLOCKS` blocks of one size."""
    own = [_fitted(run, STEPS[step]) for run in runs]
    total, before = max(1, sum(int(use.sum()) for use in own)), 0
    every, parts = -(-total // MOST_ROWS), list[Stretch]()
    for i, (run, use) in enumerate(zip(runs, own, strict=True), step * len(runs)):
        count = before + np.cumsum(use)
        before = int(count[-1])
        u, x = model.scaling.u(run.piece.v), model.scaling.x(run.piece.y)
        block = step * BLOCKS + np.minimum(count * BLOCKS // total, BLOCKS - 1)
        thinned = use & (np.arange(use.size) // 20 % every == 0)
        parts.append(Stretch(u, x, thinned, block, run.piece.sample_rate, i, i))
    return parts


def _fitted(run: JudgedRun, kind: str) -> Mask:
    """Mark the fitted samples in segments of a kind."""
    own = np.zeros(run.use.size, dtype=bool)
    for s in run.piece.find(kind):
        own[s.start : s.stop] = run.use[s.start : s.stop] & ~run.held[s.start : s.stop]
    return own
