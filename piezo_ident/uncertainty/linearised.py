# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Linearise the free run of an identified model in all of its parameters together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.jackknife import Linearised
from piezo_ident.fitting.stage import PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.results import Identification
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.selection.judged import Judged, JudgedRun

#: number of blocks of each step, and most rows of its equations (time)
BLOCKS, MOST_ROWS = 30, 100_000
#: most samples times parameters: 1e8 take about a second of processor time
MOST_WORK = 3e8
#: kinds of segments to which the steps of labelled records fit H and G
STEPS = 'triangle', 'noise'


def linearised(result: Identification, judged: Judged) -> Linearised | None:
    """
    Linearise the free run of an identified model at its parameters.

    Returns None for weights of the swarm, for fitted starts of labelled records, and for records
    that would take too long.
    """
    if result.hysteresis.solver == 'swarm':
        return None
    if judged.fit is not None:
        return Linearised.of(judged.fit)
    model, runs = result.model, judged.runs
    try:
        stage = stage_of(model, result.hysteresis.law, len(runs))
    except ModelError:
        return None
    # these equations hold the start constant
    if result.memories or stage.values.size * sum(r.use.size for r in runs) > MOST_WORK:
        return None
    return Linearised.of(fit(stage, _stretches(model, runs), iterations=0))


def stage_of(model: StageModel, name: str, records: int = 1) -> Stage:
    """Describe a model whose records begin at rest; ModelError if its H is of another law."""
    law = HysteresisLaw(name, model.hysteresis.thresholds, model.hysteresis.span)  # type: ignore[arg-type]
    rest = np.zeros((records, PARTS))
    stage = Stage.linear(law, model.dynamics, model.delay.samples, rest)
    return replace(stage, coefficients=model.dynamics.gain * law.coefficients(model.hysteresis))


def _stretches(model: StageModel, runs: Sequence[JudgedRun]) -> list[Stretch]:
    """Take the samples that the steps fitted, each step in `BLOCKS` blocks of one size."""
    size = {kind: max(1, sum(int(_fitted(run, kind).sum()) for run in runs)) for kind in STEPS}
    every, before, parts = -(-sum(size.values()) // MOST_ROWS), 0.0, list[Stretch]()
    for i, run in enumerate(runs):
        own = {kind: _fitted(run, kind) for kind in STEPS}
        count = before + sum((np.cumsum(x) / size[kind] for kind, x in own.items()), np.zeros(1))
        before, n = float(count[-1]), run.use.size
        use = np.any(list(own.values()), axis=0) & (np.arange(n) // 20 % every == 0)
        u, x = model.scaling.u(run.piece.v), model.scaling.x(run.piece.y)
        block = np.minimum(count * BLOCKS, len(STEPS) * BLOCKS - 1).astype(int)
        parts.append(Stretch(u, x, use, block, run.piece.sample_rate, i, i))
    return parts


def _fitted(run: JudgedRun, kind: str) -> Mask:
    """Mark the fitted samples in segments of a kind."""
    own = np.zeros(run.use.size, dtype=bool)
    for s in run.piece.find(kind):
        own[s.start : s.stop] = run.use[s.start : s.stop] & ~run.held[s.start : s.stop]
    return own
