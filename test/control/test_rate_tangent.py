# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tangent of H with plays that widen: differences, and its transpose."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.control.rate_tangent import tangent
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.chain import Block
import pytest
from random_models import random_hysteresis

FS = 20e3


@pytest.mark.parametrize('law', ['plays', 'bias'])
@pytest.mark.parametrize('exponent', [1.0, 0.7])
def test_it_is_the_change_with_a_small_change_of_the_voltage(law, exponent):
    rng = np.random.default_rng(3)
    h = random_hysteresis(rng, law)
    values = {'exponent': exponent, 'levelling': 0.02, 'cutoff': 500.0, 'stretch': 0.01}
    values |= {'gain': 1e-4, 'lead': 1e-5, 'lead_stretch': 1e-4}
    effect = RateDependentHysteresis(FS, values, h)

    def under(u):
        effect.reset(0.2, 0.2)
        return effect.process(Block(u, u, u)).x

    t = np.arange(600) / FS
    u = 0.5 - 0.3 * np.cos(2 * np.pi * 80 * t) + 0.05 * np.sin(2 * np.pi * 310 * t)
    J, change = tangent(effect, u, 0.2), rng.standard_normal(t.size)
    # from rest
    change[0], step = 0.0, 1e-9
    found = (under(u + step * change) - under(u - step * change)) / (2 * step)
    assert_allclose(J.matvec(change), found, atol=1e-4 * np.abs(found).max())
    other = rng.standard_normal(t.size)
    assert other @ J.matvec(change) == pytest.approx(J.rmatvec(other) @ change, rel=1e-9)
