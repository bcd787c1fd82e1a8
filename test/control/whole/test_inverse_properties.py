# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Inverse, then forward, is the identity: behind a lag, for any stable G, for every effect.

`make limits` has limits of voltage and speed kept in 10,000 random references.
"""

from dataclasses import replace
import os

from effect_table import VISIBLE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS
import piezo_ident as pi
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis_law import LAWS
import pytest
from random_models import random_hysteresis, random_model, random_path, smooth_motion

SEED = st.integers(0, 2**32 - 1)
#: what the inversion may leave beside an effect, % of stroke; of a model without, `PLAIN`
PLAIN = 0.01
LEFT = {'backlash': 0.05, 'periodic_disturbance': 0.2, 'rate_dependent_hysteresis': 0.3}
# a spring gives way with the motion, and the inverse makes up for it by iteration alone
LEFT['loop_hysteresis'] = 2.0
#: effects that leave the motions within reach
EFFECTS = {
    **VISIBLE,
    'saturation': {'low': 0.0, 'high': 0.95, 'knee': 0.1},
    'slew_limit': {'limit': 2000.0},
}
#: effects in random models whose limits are tried: each way to invert, and a limit of its own
LIMITED = ('amplifier_lag', 'rate_dependent_hysteresis', 'creep', 'backlash', 'saturation')
#: references of random limits
COUNT = int(os.environ.get('REFERENCES', '150'))


@settings(max_examples=20, deadline=None)
@given(seed=SEED, pole=st.floats(0.01, 0.99))
def test_a_lag_before_h_is_made_up_for_within_limits(seed, pole):
    rng = np.random.default_rng(seed)
    h, v = random_hysteresis(rng, 'plays'), random_path(rng, 400)

    def lagged(v):
        u = np.empty(v.size)
        last = v[0]
        for k, x in enumerate(v):
            last = u[k] = pole * last + (1.0 - pole) * x
        return u

    inverse = HysteresisInverse(h, (0.0, 1.0), pole=pole)
    inverse.reset(v[0])
    found, reached = inverse.process(h(lagged(v)))
    assert_allclose(reached, h(lagged(v)), atol=1e-12)
    assert_allclose(h(lagged(found)), reached, atol=1e-10)
    inverse = HysteresisInverse(h, (0.2, 0.7), 0.03, pole)
    inverse.reset(0.5)
    found, reached = inverse.process(h(v))
    assert found.min() >= 0.2 and found.max() <= 0.7
    assert np.abs(np.diff(np.append(0.5, found))).max() <= 0.03 + 1e-15
    assert_allclose(h(lagged(np.append(0.5, found)))[1:], reached, atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(seed=SEED, law=st.sampled_from(LAWS))
def test_any_model_goes_where_it_is_told(seed, law):
    rng = np.random.default_rng(seed)
    model = random_model(rng, law)
    wanted = smooth_motion(rng, model)
    drive = pi.invert(model, wanted)
    assert drive.error < PLAIN
    assert_array_equal(model.simulate(drive.v), drive.predicted)


@pytest.mark.parametrize('name', sorted(VISIBLE))
def test_any_model_with_an_effect_goes_where_it_is_told(name):
    for seed, law in enumerate(LAWS):
        rng = np.random.default_rng(seed)
        plain = random_model(rng, law, damped=0.02)
        wanted = smooth_motion(rng, plain)
        model = replace(plain, effects=(EffectSetting(name, EFFECTS[name]),))
        channels = {'other_axis': np.sin(np.arange(wanted.size) / 300.0)}
        drive = pi.invert(model, wanted, channels=channels if name == 'cross_coupling' else {})
        assert drive.error < LEFT.get(name, PLAIN), (law, drive.error)


def test_limits_are_kept_whatever_is_wanted():
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        names = rng.choice(LIMITED, 1)
        effects = tuple(EffectSetting(n, VISIBLE[n]) for n in names) * int(rng.integers(2))
        model = random_model(rng, LAWS[seed % len(LAWS)], effects)
        low, high = np.sort(rng.uniform([0.0, 5.5], [4.5, 10.0]))
        slew = 10.0 ** rng.uniform(0.0, 6.0)
        rest = model.without_dynamics().simulate([low, high])
        # up to half a stroke out of reach
        wanted = rest.mean() + np.ptp(rest) * (2.0 * random_path(rng, 200) - 1.0)
        drive = pi.invert(model, wanted, limits=(low, high), slew=slew, clip=True)
        assert drive.v.min() >= low and drive.v.max() <= high, seed
        assert np.abs(np.diff(drive.v)).max() <= slew / FS * (1 + 1e-9), seed
        assert np.all(np.isfinite(drive.predicted)), seed
