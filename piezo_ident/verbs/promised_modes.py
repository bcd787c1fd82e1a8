# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Promise the error of modes that axes share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import math

import numpy as np
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.model.metrics import percent
from piezo_ident.model.multi_axis import SHARED_MODES
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.uncertainty.calibration import blocks_of, calibrated
from piezo_ident.uncertainty.promises import excess, promise_of, with_band


def promised_modes(result: Diagnosis, held_out: Mapping[str, float]) -> Diagnosis:
    """
    Add promise and band of shared modes to the diagnosis of an axis.

    `held_out` has the mean squared error on multisines held out [m^2], by the label of segments.
    The model keeps errors and band of the modes apart from those of its chain.
    """
    runs = [
        JudgedRun(r.record, r.piece, r.piece.y - r.after, r.sound, np.zeros_like(r.sound))
        for r in result.residuals
    ]
    model = replace(result.model, effects=(), identification={})
    blocks = blocks_of(model, runs, excess(result, held_out))
    if blocks is None:
        return result
    band, span = calibrated(blocks), abs(model.scaling.Y)
    promise = promise_of(blocks, blocks, band, span, result.stroke)
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
