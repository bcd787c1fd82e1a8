# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Promise the error of modes that axes share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.held_out import stretches
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.model.metrics import percent
from piezo_ident.model.multi_axis import SHARED_MODES
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.uncertainty.calibration import blocks_of, calibrated
from piezo_ident.uncertainty.promises import promise_of, with_band


def promised_modes(result: Diagnosis, held_out: Mapping[str, float]) -> Diagnosis:
    """
    Add promise and band of shared modes to the diagnosis of an axis.

    `held_out` has the mean squared error on multisines held out [m^2], by the label of segments.
    The model keeps errors and band of the modes apart from those of its chain.
    """
    zeros = [np.zeros(r.piece.n, dtype=bool) for r in result.residuals]
    runs = [
        JudgedRun(r.record, r.piece, r.piece.y - r.after, r.sound, none)
        for r, none in zip(result.residuals, zeros, strict=True)
    ]
    fitted = dict[str, list[Array]]()
    for run in runs:
        for label, start, stop in stretches(run.record, run.piece):
            fitted.setdefault(label, []).append(run.error[start:stop][run.use[start:stop]])
    excess = {
        label: max(held_out[label] - float(np.concatenate(e).var()), 0.0)
        for label, e in fitted.items()
        if label in held_out
    }
    model = replace(result.model, effects=(), identification={})
    blocks = blocks_of(model, runs, excess)
    if blocks is None:
        return result
    band, span = calibrated(blocks), abs(model.scaling.Y)
    stroke = max(float(np.ptp(r.piece.y[r.sound])) for r in result.residuals if r.sound.any())
    promise = promise_of(blocks, blocks, band, span, stroke)
    mean, worst = (
        percent(span * math.sqrt(square), span)
        for square in (
            float(np.average(blocks.square, weights=blocks.weight)),
            float(blocks.of_kinds(blocks.square).max()),
        )
    )
    known = {'errors': {'after': mean, 'worst': worst}}
    of_modes = with_band(replace(model, identification={'diagnosis': known}), band).identification
    identification = {**result.model.identification, SHARED_MODES: of_modes}
    return replace(
        result, model=replace(result.model, identification=identification), promise=promise
    )
