# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The inverse of a model: the forward model goes where it was told, or it says why not."""

from dataclasses import replace
import re

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.linear_inverse import linear_inverse
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay, Dynamics
import pytest
from scipy.signal import lfilter


def sine(frequency, seconds=0.25, size=25e-6):
    """Return a sine around 35 um that starts and ends at rest."""
    t = np.arange(round(seconds * FS)) / FS
    envelope = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.05)
    return 35e-6 - size * envelope * np.cos(2 * np.pi * frequency * t)


def triangle(frequency=10.0, seconds=0.25):
    """Return a triangle between 5 and 65 um."""
    t = np.arange(round(seconds * FS)) / FS
    return 5e-6 + 60e-6 * (1.0 - np.abs(2.0 * ((frequency * t) % 1.0) - 1.0))


@pytest.mark.parametrize('wanted', [sine(1.0), sine(120.0), triangle()], ids=['1', '120', 'tri'])
def test_the_model_goes_where_it_is_told(wanted):
    drive = pi.invert(PAPER, wanted)
    assert_array_equal(drive.wanted[drive.lead :], wanted)
    assert_allclose(PAPER.simulate(drive.v), drive.predicted, atol=2e-9)
    # 100 rms(wanted - predicted) / (max wanted - min wanted)
    assert drive.error < 0.002
    assert not drive.clipped.any() and not drive.warnings
    assert drive.t[drive.lead] == 0.0 and drive.t[0] == -drive.lead / FS


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_stable_g_has_an_inverse_that_looks_ahead(seed):
    rng = np.random.default_rng(seed)
    pairs, zeros = rng.integers(1, 4), rng.integers(0, 4)
    poles = rng.uniform(0.3, 0.98, pairs) * np.exp(1j * rng.uniform(0.1, 2.5, pairs))
    a = np.real(np.poly([*poles, *poles.conj()]))[1:]
    # inside and outside of the unit circle
    b = np.real(np.poly(rng.uniform(0.2, 2.5, zeros) * -1.0))
    dynamics = Dynamics(a, np.atleast_1d(b)).normalised()
    delay = Delay(int(rng.integers(0, 20)), float(rng.uniform(0.0, 0.99)))
    model = replace(PAPER, dynamics=dynamics, delay=delay)
    x = np.zeros(6000)
    x[2000:4000] = np.sin(np.pi * np.arange(2000) / 2000) ** 4
    w = linear_inverse(model)(x)
    y = model.delay.apply(lfilter(dynamics.b, np.append(1.0, dynamics.a), w))
    assert np.abs(y - x).max() < 1e-3
    assert_allclose(linear_inverse(model)(np.ones(10)), np.ones(10), rtol=1e-9)


@pytest.mark.parametrize('gain', [0.0, 1e300, -1e300, 1e-300])
def test_a_g_without_a_gain_that_can_be_inverted_is_refused(gain):
    model = replace(PAPER, dynamics=Dynamics(np.empty(0), np.array([gain])))
    with pytest.raises(ModelError, match=re.escape(f'{gain:g}')):
        linear_inverse(model)


def test_what_is_out_of_reach_is_refused_or_clipped_and_told():
    wanted = 30e-6 + 60e-6 * np.sin(np.arange(4000) / 400.0) ** 2
    with pytest.raises(DataError, match=r'samples .* 0 .. 10 V: .* 1\d'):
        pi.invert(PAPER, wanted)
    drive = pi.invert(PAPER, wanted, clip=True)
    assert drive.v.max() == 10.0 and drive.v.min() >= 0.0
    assert drive.clipped.any() and ' 0 .. 10 V' in drive.warnings[0]
    free = ~drive.clipped
    miss = np.abs(drive.wanted - drive.predicted)
    assert np.median(miss[free]) < 1e-8 < miss[drive.clipped].max()
    with pytest.raises(DataError, match=r'at 100 V/s'):
        pi.invert(PAPER, sine(120.0), slew=100.0)
    slow = pi.invert(PAPER, sine(120.0), slew=100.0, clip=True)
    assert np.abs(np.diff(slow.v)).max() <= 100.0 / FS * (1 + 1e-9)
    with pytest.raises(DataError, match=r' 100 um; .* 0 and 10 V .* um'):
        pi.invert(PAPER, np.full(10, 100e-6))


@pytest.mark.parametrize('start', [0.0, -5e-6])
def test_a_motion_wider_than_the_reach_is_told_to_be_narrower(start):
    # no shift brings 60 um within the 36.3 um of 0 .. 5 V
    wanted = start + 30e-6 * (1.0 - np.cos(np.arange(4000) / 4000 * 2 * np.pi))
    with pytest.raises(DataError, match='narrower than the 36'):
        pi.invert(PAPER, wanted, limits=(0.0, 5.0))


def test_a_motion_that_begins_at_once_needs_a_lead():
    wanted = np.concatenate([np.linspace(10e-6, 40e-6, 400), np.full(400, 40e-6)])
    drive = pi.invert(PAPER, wanted)
    # the delay of three samples at least
    assert drive.lead >= 3
    assert_allclose(drive.wanted[: drive.lead], 10e-6)
    assert drive.error < 0.01


def test_where_a_stage_creeps_before_its_motion_is_told():
    creep = EffectSetting('creep', {'gain': [0.02], 'time_constant': [10.0]})
    model = replace(PAPER, effects=(creep,))
    (told,) = pi.invert(model, sine(20.0)).warnings
    # 2 % of the 35 um at which it begins, less what the wait makes up for
    assert 'creeps' in told and ' 0.62 um ' in told
    assert not pi.invert(model, sine(20.0, size=2e-6) - 32e-6).warnings
