# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that a free-run fit leaves in the model and in the results of the steps."""

from dataclasses import replace

import numpy as np
from paper_stage import PAPER
from piezo_ident.identification.free_run_fit import SPAN
from piezo_ident.identification.free_run_result import _compact
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.operators.hysteresis_law import HysteresisLaw

LAW = HysteresisLaw('plays', np.array([0.3]), SPAN)


def test_a_sum_of_plays_is_the_same_from_its_file():
    model = replace(PAPER, hysteresis=_compact(LAW.hysteresis([0.2, 0.05, 0.8])))
    again = model_from_dict(model_to_dict(model)).hysteresis
    assert again.span == model.hysteresis.span
    assert again.flattest == model.hysteresis.flattest
