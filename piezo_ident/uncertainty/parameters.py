# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
State the quantities that a user reads from a model, with their standard deviations.

A deviation is how far another record of the same motion and noise would move a quantity, by the
replicates of `piezo_ident.fitting.jackknife`.  A 95 % interval is the value plus and minus about
two deviations: Student's quantile for one degree of freedom fewer than blocks.  Orders of G whose
error counts as equal add their rms difference: Buckland, Burnham and Augustin, "Model selection:
an integral part of inference", Biometrics 53(2), 1997, doi:10.2307/2533961.

Limits: the delay is a whole number of samples and does not vary in these equations.  Deviations
contain the error of the law of H as far as it differs from block to block.  An error that all
blocks share is a bias, which appears on other motion only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
import math
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.jackknife import deviations, Linearised
from piezo_ident.fitting.stage import PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.results import Identification
from piezo_ident.model.front_door import ModelParameter
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.selection.judged import Judged, JudgedRun

#: entries of a model file, below `identification`
QUANTITIES, PARAMETERS, MISSING = 'quantities', 'uncertainties', 'not_identified'
#: number of frequencies at which G is stated, and the lowest as a share of the highest (taste)
FREQUENCIES, LOWEST = 10, 1e-2
#: swings at which the width of the loop is stated, as shares of the range
SWINGS = (0.25, 0.5, 1.0)
#: points of a quarter of a loop
POINTS = 100
#: reason why a loop is not identified
CLOSED = 'no play with a weight is as narrow as this loop; give more thresholds (--thresholds)'
#: width of a loop that is rounding, normalised
ROUNDING = 1e-12
#: largest distance of a replica from its mode, as a share of the frequency
SAME_MODE = 0.2
#: number of blocks of each step, and most rows of its equations (time)
BLOCKS, MOST_ROWS = 30, 50_000
#: most samples times parameters: 1e8 take about two seconds of processor time
MOST_WORK = 3e8
#: kinds of segments to which the steps of labelled records fit H, and G
STEPS = 'triangle', 'noise'


def with_deviations(result: Identification, judged: Judged) -> Identification:
    """Add quantities and deviations to the model of an identification."""
    fitted = linearised(result, judged)
    if fitted is None:
        return result
    model, frequencies = result.model, _frequencies(result)
    near = fitted.stage.dynamics
    rows = list(_quantities(fitted.stage, model, frequencies, near))

    def values(stage: Stage) -> Array:
        own = [row.value for row in _quantities(stage, model, frequencies, near)]
        return np.concatenate([np.array(own, dtype=np.float64), _coefficients(stage)])

    at = values(fitted.stage)
    replicas = [values(stage) for stage in fitted.replicates()]
    std, more = np.split(deviations(np.array(replicas).reshape(-1, at.size), at), [len(rows)])
    others = [values(replace(fitted.stage, dynamics=G)) for G in result.dynamics.others]
    off = np.array([x[: len(rows)] - at[: len(rows)] for x in (at, *others)])
    std = np.hypot(std, np.sqrt(np.mean(off**2, axis=0)))
    # a mode that replicates or other orders lack is unknown, and so is a loop that no play opens
    closed = np.array([row.part == 'H' and row.value == 0.0 for row in rows]) & (std == 0.0)
    told = np.where(np.isfinite(std) & ~closed, std, np.inf)
    quantities = [asdict(replace(row, std=float(s))) for row, s in zip(rows, told, strict=True)]
    missing = (*result.not_identified, *((rows[i].name, CLOSED) for i in np.flatnonzero(closed)))
    known = {**model.identification, QUANTITIES: quantities}
    known[PARAMETERS] = _of_coefficients(fitted.stage, model, more, known)
    known[MISSING] = [f'{what}: {why}' for what, why in missing]
    return replace(result, model=replace(model, identification=known), not_identified=missing)


def quantities_of(model: StageModel, result: Identification) -> list[ModelParameter]:
    """List the quantities of a sum of plays, such as a simulated stage, as for a result."""
    near = result.model.dynamics
    return list(_quantities(stage_of(model, 'plays'), model, _frequencies(result), near))


def _frequencies(result: Identification) -> Array:
    highest = min(result.dynamics.known_to, 0.5 * result.model.sample_rate)
    return np.geomspace(LOWEST * highest, highest, FREQUENCIES)


def _coefficients(stage: Stage) -> Array:
    """Return weights, p0, p1 and p2 of H, and a and b of G."""
    h, G = stage.hysteresis, stage.dynamics
    return np.concatenate([h.weights, [h.p0, h.p1, h.p2], G.a, G.b])


def _of_coefficients(
    stage: Stage, model: StageModel, std: Array, known: dict[str, Any]
) -> dict[str, Any]:
    """Replace the deviations of single steps by deviations of all parameters together."""
    m, na = stage.law.thresholds.size, stage.dynamics.a.size
    own = np.isin(stage.law.thresholds, model.hysteresis.thresholds)
    weights, powers, a, b = np.split(std, [m, m + 3, m + 3 + na])
    entry = {**known.get(PARAMETERS, {}), 'weights': weights[own].tolist()}
    entry |= dict(zip(('p0', 'p1', 'p2'), powers.tolist(), strict=True))
    return entry | ({'a': a.tolist(), 'b': b.tolist()} if na == model.dynamics.a.size else {})


def _quantities(
    stage: Stage, model: StageModel, frequencies: Array, near: Dynamics
) -> Iterator[ModelParameter]:
    """Yield the quantities of a stage; its modes are the nearest to the modes of `near`."""
    s, rate, h, G = model.scaling, model.sample_rate, stage.hysteresis, stage.dynamics
    low, high = s.u(np.array(s.range)).tolist()
    line = float(np.diff(h(np.array([low, high])))[0] / (high - low))
    yield ModelParameter('H', 'static gain', abs(line * s.Y / s.V), 'm/V')
    for share in SWINGS:
        size = share * (high - low)
        width = abs(s.Y) * _loop_width(stage, 0.5 * (low + high - size), size)
        yield ModelParameter('H', f'loop width at {share:.0%} of the range', width, 'm')
    if not near.is_static:
        response = G.response(frequencies, rate)
        # a sample of delay may as well be a sample of G, so the phase contains the delay
        phase = np.unwrap(np.angle(response)) - 2.0 * np.pi * frequencies * stage.delay / rate
        for f, gain, angle in zip(frequencies, np.abs(response), phase, strict=True):
            yield ModelParameter('G', f'gain at {f:.4g} Hz', float(gain), '')
            yield ModelParameter('G', f'phase at {f:.4g} Hz', math.degrees(angle), 'deg')
        modes = G.modes(rate)
        for i, mode in enumerate(near.modes(rate), 1):
            # nothing drove faster modes
            if mode.frequency > frequencies[-1]:
                break
            far = [abs(x.frequency / mode.frequency - 1.0) for x in modes]
            same = modes[int(np.argmin(far))] if far and min(far) < SAME_MODE else None
            f, damping = (same.frequency, same.damping) if same else (math.nan, math.nan)
            yield ModelParameter('G', f'mode {i}', f, 'Hz')
            yield ModelParameter('G', f'damping of mode {i}', damping, '')
    for tau, share in zip(stage.taus, stage.creep, strict=True):
        yield ModelParameter('creep', f'gain at {tau:.4g} s', float(share), '')


def _loop_width(stage: Stage, low: float, size: float) -> float:
    """Return the width of a loop in its middle, normalised; it is closed after one cycle."""
    up = np.linspace(low, low + size, 2 * POINTS + 1)
    w = stage.hysteresis(np.concatenate([up, up[-2::-1], up[1:], up[-2::-1]]))
    width = float(w[7 * POINTS] - w[5 * POINTS])
    return 0.0 if abs(width) < ROUNDING else width


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
