# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Promise the error of modes that axes share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

import numpy as np
from piezo_ident.diagnosis.held_out import excess
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.model.metrics import percent
from piezo_ident.model.multi_axis import SHARED_MODES
from piezo_ident.model.stage_model import StageModel
from piezo_ident.selection.judged import JudgedRun, Promise
from piezo_ident.uncertainty.calibration import blocks_of, calibrated
from piezo_ident.uncertainty.promises import promise_of, with_band


def promised_modes(result: Diagnosis, held_out: Mapping[str, float]) -> Diagnosis:
    """
    Add promise and band of shared modes to the diagnosis of an axis.

    `held_out` has the mean squared error on multisines held out [m^2], by the label of segments.
    """
    model, promise = judged_modes(result.model, result.runs, held_out, result.stroke)
    return result if promise is None else replace(result, model=model, promise=promise)


def judged_modes(
    model: StageModel, runs: Sequence[JudgedRun], held_out: Mapping[str, float], stroke: float
) -> tuple[StageModel, Promise | None]:
    """
    Give the model of an axis errors and band of shared modes, beside errors and band of its chain.

    If the samples are too few, the model stays as it is, and the promise is None.

    Parameters
    ----------
    model : StageModel
        The chain.
    runs : sequence of JudgedRun
        Free runs of the modes.
    held_out : mapping of str to float
        Mean squared error on multisines held out [m^2], by the label of segments.
    stroke : float
        [m]
    """
    bare = replace(model, effects=(), identification={})
    blocks = blocks_of(bare, runs, excess(runs, held_out))
    if blocks is None:
        return model, None
    band, span = calibrated(blocks), abs(model.scaling.Y)
    promise = promise_of(blocks, blocks, band, span, stroke)
    mean, worst = (
        percent(span * math.sqrt(square), span)
        for square in (
            float(np.average(blocks.square, weights=blocks.weight)),
            float(blocks.of_kinds(blocks.square).max()),
        )
    )
    known = {'errors': {'after': mean, 'worst': worst}}
    of_modes = with_band(replace(bare, identification={'diagnosis': known}), band).identification
    return replace(model, identification={**model.identification, SHARED_MODES: of_modes}), promise
