# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Promise the error of another record, and give the model its prediction band.

The promise for the same kinds of motion is the rms error of the model on its records.  This error
is raised to the error of held-out samples, and an unknown start adds its error.  The promise for
another kind of motion is the geometric mean of q times the geometric mean of r_k, in the notation
of `piezo_ident.uncertainty.band`.  The mean of q pairs the swing and nesting of each kind with the
speed of each kind.  About half of the kinds err more than this promise.

Hum, drift and a wandering gain count in full, as the refined model of a diagnosis lacks them.

Limits: both promises are for the rms error over a whole record, in % of the stroke of the judged
records.  A zero of the sensor that has clearly moved does not count.
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from piezo_ident.diagnosis.held_out import errors_of_segments, excess, unseen_runs
from piezo_ident.diagnosis.messages import sentence
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Identification
from piezo_ident.model.metrics import percent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.selection.judged import Judged, Promise
from piezo_ident.uncertainty.band import KEY, PredictionBand
from piezo_ident.uncertainty.calibration import Blocks, blocks_of, calibrated
from piezo_ident.uncertainty.parameters import QUANTITIES
from piezo_ident.uncertainty.weights import weights_of

#: kinds whose swings and speeds differ by less than this factor are one kind of motion (taste)
OCTAVE = 2.0


def with_band(model: StageModel, band: PredictionBand) -> StageModel:
    """Add a band to a model, and thus to its file."""
    return replace(model, identification={**model.identification, KEY: band.to_dict()})


def promised_identification(result: Identification, judged: Judged) -> Identification:
    """Add promise and band to an identification."""
    model = result.model
    alone = unseen_runs(model, ((r.record, r.piece, r.use, r.zero) for r in judged.runs))
    own, more = (
        {label: float(np.sum(e**2)) / max(e.size, 1) for label, e in errors_of_segments(x).items()}
        for x in (judged.runs, alone)
    )
    # another record lacks the fitted start of these runs
    blocks = blocks_of(model, judged.runs, {k: max(x - own[k], 0.0) for k, x in more.items()})
    if blocks is None:
        return result
    band = calibrated(blocks)
    promise = promise_of(blocks, blocks, band, abs(model.scaling.Y), result.stroke)
    if not judged.tests_other_motion:
        promise = replace(promise, other=None)
    return replace(result, model=with_band(model, band), promise=promise)


def promised_diagnosis(result: Diagnosis) -> Diagnosis:
    """Add weights, promise and band to a diagnosis, and the promise to its sentence."""
    model = result.model
    result = replace(result, weights=weights_of(result.errors_of_sets))
    fit, stroke = result.runs, result.stroke
    runs = unseen_runs(model, ((r.record, r.piece, r.sound, 0.0) for r in result.residuals))
    same, other = (
        blocks_of(model, runs, excess(fit, {k: (0.01 * x * stroke) ** 2 for k, x in e.items()}))
        for e in (result.held_out.by_segment if result.held_out else {}, result.after.by_segment)
    )
    if same is None or other is None:
        return result
    band = calibrated(other)
    promise = promise_of(same, other, band, abs(model.scaling.Y), stroke)
    if result.changes:
        # the deviations belong to the model before the diagnosis
        known = {k: x for k, x in model.identification.items() if k != QUANTITIES}
        model = replace(model, identification=known)
    result = replace(result, model=with_band(model, band), promise=promise)
    return replace(result, sentence=sentence(result))


def promise_of(
    same: Blocks, other: Blocks, band: PredictionBand, span: float, stroke: float
) -> Promise:
    """Promise the error of another record, from blocks of the same kinds and of other kinds."""
    mean = float(np.average(same.square, weights=same.weight))
    swing, speed, nesting = (np.sqrt(other.of_kinds(other.motion[:, i])) for i in (1, 2, 3))
    same_motion = percent(span * math.sqrt(mean), stroke)
    if all(x.max() < OCTAVE * x.min() for x in (swing, speed)):
        return Promise(same_motion, None)
    k, m = (x.ravel() for x in np.indices((other.kinds, other.kinds)))
    scales = band.scale(np.array([swing[k], speed[m], nesting[k]]))
    expected = math.exp(float(np.mean(np.log(scales)) + np.mean(np.log(band.ratios))))
    return Promise(same_motion, percent(span * expected, stroke))
