# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that a free-run fit leaves in the model and in the results of the steps."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import PAPER
from piezo_ident.fitting.free_run import fit
from piezo_ident.fitting.stage import PARTS, Stage
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.identification.free_run_fit import SPAN
from piezo_ident.identification.free_run_result import _compact, _hysteresis_result, FreeRunFits
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.selection.comparison import Candidate

LAW = HysteresisLaw('plays', np.array([0.3]), SPAN)


def test_a_sum_of_plays_is_the_same_from_its_file():
    model = replace(PAPER, hysteresis=_compact(LAW.hysteresis([0.2, 0.05, 0.8])))
    again = model_from_dict(model_to_dict(model)).hysteresis
    assert again.span == model.hysteresis.span
    assert again.flattest == model.hysteresis.flattest


def test_deviations_of_the_powers_are_those_of_a_linear_fit():
    n = 600
    v = 0.5 - 0.5 * np.cos(np.arange(n) / 30.0)
    X = np.column_stack([*LAW.columns(v), np.ones(n)])
    truth = np.array([0.2, 0.05, 0.8])
    x = X[:, :3] @ truth + 0.01 * np.random.default_rng(0).standard_normal(n)
    linear = Stage.linear(LAW, Dynamics.unit(), 0, np.zeros((1, PARTS)))
    block = np.arange(n) * 10 // n
    stretch = Stretch(v, x, np.ones(n, dtype=bool), block, 1000.0)
    last = fit(replace(linear, coefficients=truth), [stretch], iterations=0)
    best = Candidate('plays', last, 1.0, 1.0)
    result = _hysteresis_result(FreeRunFits((), (), last, last, (best,), best))
    expected = np.sqrt(np.diag(np.linalg.inv(X.T @ X)) * last.loss / n)
    assert_allclose(result.std, expected[:3], rtol=1e-6)
