# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Predict the error of a stage under the voltage of an inverse.

The error about its mean has three parts: the known error of the model, the part of the motion
above the lowest mode that rings, and the drift by creep from earlier motion.  Their squares are
added.  The known error holds no mean, because a diagnosis fits the zero of each record.  The mean
is the shift by creep from earlier motion.  A model with creep predicts this shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.control.linear_inverse import lowest_mode
from piezo_ident.effects.creep import Creep
from piezo_ident.model.metrics import worst_error
from piezo_ident.model.stage_model import StageModel
from scipy.signal import butter, sosfiltfilt

#: time of the stroke to the beginning of a motion, and of the wait there [s]; taste
RISE, HOLD = 0.2, 1.0
#: remaining creep that is worth a warning if the error of the model is unknown [of its span]
MATTERS = 1e-3


@dataclass(frozen=True)
class Expectation:
    """
    Expected error of a stage [m].

    `rms` is the error about its mean; it is None if the error of the model is unknown.  `offset`
    is the mean error; it is None if the model lacks creep.
    """

    rms: float | None
    offset: float | None
    warnings: tuple[str, ...]


def known_rms(model: StageModel) -> float | None:
    """Error of a model on its worst kind of motion [m]; None if it is unknown."""
    worst = worst_error(model)
    return None if worst is None else 0.01 * worst * abs(model.scaling.Y)


def expect(model: StageModel, v: Array, y: Array) -> Expectation:
    """
    Predict the error of a stage whose wanted displacement is y [m] under v [V], shape (n,) each.

    The stage comes from its lowest voltage, and waits for `HOLD` at the first position.
    """
    known, late = known_rms(model), _late(model, v)[-y.size :]
    limit = MATTERS * abs(model.scaling.Y) if known is None else known
    warnings, fast = list[str](), 0.0
    if known is not None:
        mode, fast = lowest_mode(model), _above_mode(model, y)
        if fast > known:
            warnings.append(
                f'{100 * fast / np.ptp(y):.2g} % of the motion lie above {mode:.4g} Hz, where the '
                'stage rings: corners or jumps. The model may miss all of it, and the expected '
                'error contains it; round the corners, or let the scan learn'
            )
        if _is_slow(model):
            warnings.append(
                'the record of the identification held no fast motion; the expected error holds '
                'for motion as slow as in that record; identify with steps or noise'
            )
    if late.size and abs(late[0]) >= limit:
        low = model.scaling.range[0]
        warnings.append(
            f'the stage creeps: {HOLD:g} s after it came from {low:g} V, '
            f'it is still {1e6 * abs(late[0]):.2g} um off the first position; wait longer, or '
            f'begin it under {low:g} V'
        )
    drifts = float(np.std(late)) if late.size else 0.0
    return Expectation(
        None if known is None else math.hypot(known, fast, drifts),
        float(late.mean()) if late.size else None,
        tuple(warnings),
    )


def _is_slow(model: StageModel) -> bool:
    """Tell whether G is unknown and no diagnosis measured the error on fast motion."""
    missing = model.identification.get('not_identified')
    if 'diagnosis' in model.identification or not isinstance(missing, Sequence):
        return False
    return any(str(what).startswith('dynamics:') for what in missing)


def _above_mode(model: StageModel, y: Array) -> float:
    """Rms of the part of a motion above the lowest mode that rings [m]."""
    mode = lowest_mode(model)
    if not (0.0 < mode < 0.5 * model.sample_rate) or not np.ptp(y):
        return 0.0
    sos = butter(4, mode, btype='highpass', fs=model.sample_rate, output='sos')
    around = max(16, round(model.sample_rate / mode))
    fast = sosfiltfilt(sos, np.pad(y - y[0], around, mode='edge'))
    return float(np.sqrt(np.mean(fast**2)))


def _late(model: StageModel, v: Array) -> Array:
    """Displacement through creep from the stroke and wait before v [m]; empty without creep."""
    only = replace(model, effects=tuple(e for e in model.effects if e.name == Creep.name))
    if not only.effects:
        return np.empty(0)
    rise = np.linspace(model.scaling.range[0], v[0], max(round(RISE * model.sample_rate), 2))
    way = np.pad(rise, (0, round(HOLD * model.sample_rate)), 'edge')
    return only.stream().process(np.append(way, v))[way.size :] - only.stream().process(v)
