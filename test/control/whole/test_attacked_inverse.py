# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a lab gives to the inverse by mistake, or at the edge: a right drive, or one clear line."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.linear_inverse import linear_inverse
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

T = np.arange(4000) / FS
SINE = 35e-6 - 20e-6 * np.cos(2 * np.pi * 20 * T)


def resonance(frequency, damping):
    """Return G of one mode."""
    w = 2 * np.pi * frequency / FS
    poles = circle(np.exp(-damping * w), w * np.sqrt(1 - damping**2))
    return Dynamics(np.real(np.poly(poles))[1:], np.ones(1)).normalised()


def circle(radius, angle):
    """Return a pair of poles or zeros."""
    return radius * np.exp([1j * angle, -1j * angle])


@pytest.mark.parametrize(
    'wanted, options, line',
    [
        (SINE * 1e6, {}, r'starts at 1.5e\+07 um; .* in metres\?'),
        (SINE * 1e6, {'clip': True}, r'in metres\?'),
        (SINE + 1j, {}, 'expected real numbers, got complex128; give its real part'),
        (SINE[None], {}, r'shape \(1, 4000\)'),
        (SINE[:1], {}, r'shape \(1,\)'),
        ('abc', {}, 'wanted motion: .* <U3'),
        (np.where(T > 0.1, np.nan, SINE), {}, '1999 bad'),
        (np.ma.masked_greater(SINE, 50e-6), {}, r'\d+ bad'),
        (-SINE, {}, 'starts at -15 um; between 0 and 10 V the stage rests at 0 .. 71'),
        (-SINE, {}, 'raise the motion by 55 um'),
        (SINE, {'sample_rate': 1e4}, 'sampled at 10000 Hz, the model at 20000 Hz'),
        (SINE, {'limits': (-np.inf, np.inf)}, r'limits \(-inf, inf\)'),
        (SINE, {'limits': 10.0}, 'limits 10.0'),
        (SINE, {'limits': (10.0, 0.0)}, r'limits \(10.0, 0.0\)'),
        (SINE, {'limits': ('low', 'high')}, r"limits \('low', 'high'\)"),
        (SINE, {'limits': (30.0, 40.0)}, 'limits .* 0 .. 10 V'),
        (SINE, {'limits': (5.0, 5.0 + 1e-9)}, 'starts at 15 um; between 5 and 5 V'),
        (SINE, {'slew': 0.0}, 'slew 0.0'),
        (SINE, {'slew': None}, 'slew None'),
        (SINE, {'slew': 1e-12}, r'3959 samples .* at 1e-12 V/s: by up to 40 um'),
        (35e-6 + 20e-9 * np.sin(300 * T), {'slew': 1e-6}, 'by up to 0.02 um'),
        (np.where(T < 0.1, 20e-6, 50e-6), {}, '5 samples .* to 18'),
        (SINE, {'channels': {'axis': np.zeros(5)}}, "channel 'axis' must be a vector of 4000"),
        (SINE, {'channels': {'axis': np.full(4000, np.nan)}}, "channel 'axis'"),
    ],
)
def test_what_cannot_be_costs_one_line(wanted, options, line):
    with pytest.raises(DataError, match=line) as error:
        pi.invert(PAPER, wanted, **options)
    assert '\n' not in str(error.value)


def test_what_has_no_inverse_is_named():
    h = Hysteresis(PAPER.hysteresis.thresholds, PAPER.hysteresis.weights, -0.8, 1.1)
    with pytest.raises(ModelError, match=r'inverse: .*slope .* -1\.3'):
        pi.invert(replace(PAPER, hysteresis=h), SINE)
    with pytest.raises(ModelError, match='gain 0;'):
        pi.invert(replace(PAPER, dynamics=Dynamics([0.5], [1.0, -1.0])), SINE)
    with pytest.raises(ModelError, match=r'this model .* 0\.99999'):
        pi.invert(replace(PAPER, dynamics=drifting(0.5)), SINE)


def drifting(share):
    """Return dynamics of which a share of the gain comes in a minute, as of a drift."""
    pole = 0.999999
    a = np.polymul(np.append(1.0, PAPER.dynamics.a), [1.0, -pole])[1:]
    zero = [1.0, -1.0 + (1.0 - pole) / (1.0 - share)]
    return Dynamics(a, np.polymul(PAPER.dynamics.b, zero)).normalised()


def test_a_little_that_is_slower_than_any_filter_is_made_up_for():
    model = replace(PAPER, dynamics=drifting(0.05))
    drive = pi.invert(model, SINE + 10e-6)
    assert drive.error < 0.01 and not drive.warnings
    # within a second almost nothing of the share has come: it takes as much more voltage
    y = model.simulate(drive.v)[drive.lead :]
    assert np.sqrt(np.mean((y - SINE - 10e-6) ** 2)) < 1e-4 * np.ptp(SINE)


@pytest.mark.parametrize('level', [0.0, 30e-6, float(PAPER.simulate(np.full(3000, 10.0))[-1])])
def test_a_stage_may_be_told_to_stand_still(level):
    drive = pi.invert(PAPER, np.full(500, level))
    assert np.ptp(drive.v) < 1e-9 and drive.error < 1e-9
    assert drive.lead == 0 and not drive.warnings


def test_a_motion_may_begin_and_turn_at_a_limit_and_begin_beyond_it_where_clipping_is_asked_for():
    drive = pi.invert(PAPER, 20e-6 * (1 - np.cos(2 * np.pi * 20 * T)))
    assert drive.v.min() == 0.0 and drive.error < 0.001
    assert not drive.clipped.any() and not drive.warnings
    drive = pi.invert(PAPER, SINE - 16e-6, clip=True)
    assert drive.v[0] == 0.0 and drive.clipped[drive.lead]
    assert '1 um' in drive.warnings[0] and len(drive.warnings) == 1


def test_limits_beyond_the_identified_range_are_used_as_far_as_h_rises():
    for limits in ((-5.0, 15.0), (-1e3, 1e6)):
        assert_allclose(pi.invert(PAPER, SINE, limits=limits).v, pi.invert(PAPER, SINE).v)
    wanted = np.linspace(20e-6, 74e-6, 4000)
    drive = pi.invert(PAPER, wanted, limits=(-5.0, 15.0))
    assert 10.0 < drive.v.max() < 11.0 and drive.error < 0.001
    assert 'outside the identified range 0 .. 10 V' in drive.warnings[0]
    # above 11 V the cubic of the paper falls
    with pytest.raises(DataError, match=r'samples .* -\d.* \.\. 11\.\d+ V'):
        pi.invert(PAPER, np.linspace(20e-6, 90e-6, 4000), limits=(-5.0, 15.0))


def test_a_motion_that_is_doubtful_is_told():
    noise = 35e-6 + 1e-7 * np.random.default_rng(0).standard_normal(4000)
    for wanted, says in ((SINE * 1e-3, 'is it in metres?'), (noise, 'faster than the stage')):
        assert says in pi.invert(PAPER, wanted).warnings[0]


@pytest.mark.parametrize('samples', [50, 904, 5000, 50_000])
def test_any_delay_is_made_up_for(samples):
    model = replace(PAPER, delay=Delay(samples, 0.3))
    drive = pi.invert(model, SINE)
    assert drive.lead >= samples and drive.error < 0.001


@pytest.mark.parametrize('damping', [0.1, 1e-2, 1e-4])
@pytest.mark.parametrize('frequency', [50.0, 200.0])
def test_a_mode_that_rings_may_lie_at_the_frequency_of_the_motion(frequency, damping):
    model = replace(PAPER, dynamics=resonance(frequency, damping))
    wanted = 35e-6 - 15e-6 * np.minimum(1.0, T / 0.05) * np.cos(2 * np.pi * frequency * T)
    assert pi.invert(model, wanted).error < 0.01


def test_poles_close_together_cost_digits_and_no_more():
    # two modes, and pairs of pole and zero near 1 that a refit added to them
    a = np.poly([*circle(0.9966, 0.2562), *circle(0.9939, 0.1286), 0.9953, 0.9691, 0.6889, 0.6889])
    b = np.poly([*circle(0.9964, 0.2157), 0.995298, 0.9691, *circle(0.742, 0.147), 2.896, -0.339])
    model = replace(PAPER, dynamics=Dynamics(np.real(a)[1:], np.real(b)).normalised())
    assert linear_inverse(model).taps.size < 40_000
    assert pi.invert(model, SINE).error < 0.01


def test_what_leaks_past_the_stage_is_part_of_the_filter():
    # as large as some that were identified
    leak = EffectSetting('input_feedthrough', {'gain': -0.06, 'rate_gain': 3e-4})
    assert pi.invert(replace(PAPER, effects=(leak,)), SINE).error < 0.01


def test_what_is_out_of_reach_does_not_hide_the_rest():
    stage = pi.SimulatedStage.load('effects').model
    drive = pi.invert(stage, 1.4 * SINE, clip=True)
    assert drive.clipped.any() and not any('misses' in told for told in drive.warnings)
    away = np.convolve(drive.clipped, np.ones(401), 'same') == 0.0
    assert np.abs(drive.wanted - drive.predicted)[away].max() < 5e-9
