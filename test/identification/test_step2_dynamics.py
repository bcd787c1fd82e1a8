# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Step 2: slow poles that stand for hysteresis or creep, and no dynamics."""

import numpy as np
from piezo_ident.identification.step2_dynamics import fast_part, without_slow_part
from piezo_ident.operators.dynamics import Dynamics
import pytest

FS = 20_000.0


def test_a_real_pole_beside_a_real_zero_far_below_the_modes_goes():
    rings = np.exp(2.0 * np.pi * 1300.0 / FS * (-0.02 + 1j))
    pole, zero, lag = np.exp(-2.0 * np.pi * np.array([70.0, 75.0, 300.0]) / FS)
    modes = [rings, np.conj(rings), lag]
    G = Dynamics(np.real(np.poly([*modes, pole]))[1:], np.poly([zero]))
    left = fast_part(G, FS, lean=True)
    np.testing.assert_allclose(sorted(left.poles, key=abs), sorted(modes, key=abs), rtol=1e-9)
    assert left.gain == pytest.approx(1.0)


def test_poles_off_the_real_axis_that_decay_beside_such_zeros_go_too():
    rings = np.exp(2.0 * np.pi * 636.0 / FS * (-0.005 + 1j))
    pole, zero = np.exp(2.0 * np.pi / FS * np.array([-64.0 + 17.0j, -65.0 + 37.0j]))
    modes = [rings, np.conj(rings)]
    G = Dynamics(
        np.real(np.poly([*modes, pole, np.conj(pole)]))[1:],
        np.real(np.poly([zero, np.conj(zero)])),
    )
    left = fast_part(G, FS, lean=True)
    np.testing.assert_allclose(
        sorted(left.poles, key=np.imag), sorted(modes, key=np.imag), rtol=1e-9
    )
    # without a near zero they are a lag of the stage
    far = Dynamics(G.a, np.poly([0.5, 0.4]))
    assert fast_part(far, FS, lean=True).a.size == 4


def test_slow_real_poles_go_and_slow_pairs_are_refused():
    slow, fast = np.exp(-2.0 * np.pi * np.array([5.0, 1500.0]) / FS)
    G = Dynamics(np.poly([slow, fast])[1:], np.poly([0.9995 * slow]) * (1.0 - fast))
    left = without_slow_part(G, FS)
    np.testing.assert_allclose(left.poles, [fast], rtol=1e-9)
    assert left.gain == pytest.approx(1.0)
    pair = np.exp(2.0 * np.pi * 10.0 / FS * (-0.1 + 1j))
    assert (
        without_slow_part(Dynamics(np.real(np.poly([pair, np.conj(pair)]))[1:], [1.0]), FS) is None
    )
