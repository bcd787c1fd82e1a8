# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Error of G at its identification; a smaller change of the dynamics cannot be detected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.diagnosis.criteria import IN_PROPORTION
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.identification.spectra import high_passed
from piezo_ident.model.stage_model import StageModel


def missed_then(model: StageModel) -> float:
    """Return the error on fast motion at the identification [% of stroke]; 0 if unknown."""
    known = _entries(model, 'errors')
    if 'fast_motion' in known:
        known = {'fast_motion': known['fast_motion']}
    # a file without this entry holds the error on all motion
    return max((float(x) for x in known.values() if isinstance(x, int | float)), default=0.0)


def missed_now(simulator: Simulator) -> float:
    """
    Estimate the error of G on the motion in these data, % of stroke.

    The error of G grows with fast motion.  Part of the known error does not belong to G, such as
    small loops that open less than H predicts.  Only the share `IN_PROPORTION` of the proportional
    growth therefore counts.
    """
    model = simulator.model
    then = _entries(model, 'fast_displacement').get('percent_of_stroke')
    missed = missed_then(model)
    if not isinstance(then, int | float) or not then > 0.0:
        return missed
    fast = [high_passed(run.x, run.piece.sample_rate)[run.use] for run in simulator.rows.runs]
    now = 100.0 * float(np.sqrt(np.mean(np.concatenate(fast) ** 2)))
    return missed * max(1.0, IN_PROPORTION * now / float(then))


def _entries(model: StageModel, name: str) -> Mapping[str, Any]:
    found = model.identification.get(name)
    return found if isinstance(found, Mapping) else {}
