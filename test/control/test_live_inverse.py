# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The live inverse: as the offline one, however the motion is cut, within its limits."""

from dataclasses import replace

from effect_table import VISIBLE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.live_inverse import LiveInverse
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay, Dynamics
import pytest

SECONDS = 0.25


def motion(frequency=20.0, size=20e-6, mean=35e-6, start=0.0):
    """Return a sine that is joined softly from a displacement at rest."""
    t = np.arange(round(SECONDS * FS)) / FS
    fade = 0.5 - 0.5 * np.cos(np.pi * np.minimum(t / 0.05, 1.0))
    return start + fade * (mean - start + size * np.sin(2 * np.pi * frequency * t))


def driven(live, wanted, size=100):
    """Return the voltage for a motion, and where it was clipped, until the motion is over."""
    known = np.append(wanted, np.full(live.preview, wanted[-1]))
    parts = [live.process(known[k : k + size]) for k in range(0, known.size, size)]
    return (np.concatenate(z) for z in zip(*parts, strict=True))


def missed(model, live, wanted, v):
    """Return what the model misses, 100 rms / span, when it follows `preview` samples later."""
    t = np.arange(v.size) / FS
    y = model.stream().process(v, t, {'other_axis': np.zeros(v.size)})[live.preview :]
    return 100.0 * np.sqrt(np.mean((y - wanted) ** 2)) / np.ptp(wanted)


@pytest.mark.parametrize('frequency', [1.0, 120.0])
def test_it_is_the_offline_inverse_within_what_the_preview_costs(frequency):
    wanted = motion(frequency)
    live = LiveInverse(PAPER)
    v, clipped = driven(live, wanted)
    assert not clipped.any()
    drive = pi.invert(PAPER, wanted)
    # in the middle: the motion ends abruptly
    middle = slice(200, 4800)
    offline = drive.v[drive.lead :][middle]
    assert_allclose(v[live.preview :][middle], offline, atol=1e-3)
    assert missed(PAPER, live, wanted[:4800], v[: 4800 + live.preview]) < 0.002
    assert live.error < 0.002 and not live.warnings


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_cuts_change_nothing(seed):
    rng = np.random.default_rng(seed)
    model = replace(PAPER, effects=(EffectSetting('creep', VISIBLE['creep']),))
    live, wanted = LiveInverse(model, preview=150), motion()[:2000]
    assert live.passes > 1
    whole = live.process(wanted)
    live.reset()
    cuts = np.sort(rng.integers(0, wanted.size, 6))
    parts = [live.process(part) for part in np.split(wanted, cuts)]
    v = np.concatenate([part.v for part in parts])
    assert_allclose(v, whole.v, atol=1e-10)


@pytest.mark.parametrize('name', sorted(set(VISIBLE) - {'cross_coupling'}))
def test_it_makes_up_for_every_effect(name):
    model = replace(PAPER, effects=(EffectSetting(name, VISIBLE[name]),))
    plain, live = LiveInverse(PAPER), LiveInverse(model)
    # what saturation leaves
    wanted = motion(20.0, size=5e-6, mean=25e-6, start=live.position)
    before = missed(model, plain, wanted, next(driven(plain, wanted)))
    after = missed(model, live, wanted, next(driven(live, wanted)))
    assert after < max(0.1 * before, 0.02)


def test_zeros_outside_of_the_unit_circle_and_a_long_delay_are_no_hindrance():
    poles = 0.95 * np.exp(1j * np.array([0.3, -0.3]))
    dynamics = Dynamics(np.real(np.poly(poles))[1:], np.array([0.2, -1.0, -0.5])).normalised()
    model = replace(PAPER, dynamics=dynamics, delay=Delay(40, 0.5))
    assert np.abs(np.roots(dynamics.b)).max() > 2.0
    live, wanted = LiveInverse(model), motion(120.0)
    assert missed(model, live, wanted, next(driven(live, wanted))) < 0.02


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_and_slew_are_kept_whatever_is_wanted(seed):
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.uniform([0.0, 7.0], [3.0, 10.0]))
    slew = 10.0 ** rng.uniform(2.0, 5.0)
    effects = (EffectSetting('creep', VISIBLE['creep']),) if seed % 2 else ()
    live = LiveInverse(replace(PAPER, effects=effects), limits=(low, high), slew=slew)
    wanted = rng.choice([1e-6, 1e-4]) * np.cumsum(rng.standard_normal(500))
    v, clipped = driven(live, wanted)
    assert v.min() >= low and v.max() <= high
    assert np.abs(np.diff(v, prepend=low)).max() <= slew / FS * (1 + 1e-9)
    assert clipped.any() or np.ptp(wanted) < 60e-6


def test_what_is_clipped_is_told_and_the_rest_is_reached():
    wanted = motion(size=60e-6)
    live = LiveInverse(PAPER)
    v, clipped = driven(live, wanted)
    miss = np.abs(PAPER.simulate(v)[live.preview :] - wanted)
    told = clipped[live.preview :]
    assert told.any() and miss[told].max() > 10e-6
    assert np.median(miss[~told]) < 1e-8


def test_it_goes_on_behind_a_voltage_that_another_one_applied():
    wanted = motion(mean=30e-6)
    live = LiveInverse(PAPER)
    v, _ = driven(live, wanted)
    k = 2600
    other = LiveInverse(PAPER)
    for part in np.split(v[:k], 4):
        other.follow(part, 0)
    # it knows where the stage is
    assert abs(other.position - wanted[k - 1 - live.preview]) < 2e-9
    rest = other.process(wanted[k - live.preview :]).v
    assert_allclose(rest, v[k : wanted.size], atol=1e-3)
    # with the plays that the turning points alone leave
    other = LiveInverse(PAPER)
    turns = np.array([v[0], v[:k].max(), v[:k][np.argmax(v[:k]) :].min()])
    other.recall(turns, np.zeros(3))
    other.follow(v[k - 400 : k], k - 400)
    assert_allclose(other.process(wanted[k - live.preview :]).v, rest, atol=2e-2)


@pytest.mark.parametrize('size', [1, 2, 7, 401])
def test_what_follows_another_voltage_does_not_depend_on_the_blocks(size):
    live = LiveInverse(PAPER)
    wanted = motion(mean=30e-6)
    v, _ = driven(live, wanted)
    rest, parts = wanted[2600:4000], []
    for blocks in ([rest], np.split(rest, range(size, rest.size, size))):
        live.reset()
        live.follow(v[:2600])
        parts.append(np.concatenate([live.process(block).v for block in blocks]))
    assert parts[0].size == rest.size - live.preview
    assert np.array_equal(*parts)


def test_a_preview_that_is_short_is_told_and_one_without_sense_refused():
    live = LiveInverse(PAPER, preview=4)
    assert live.error > 0.1
    assert 'preview of 4 samples' in live.warnings[0]
    with pytest.raises(ModelError, match=r'preview of 3 samples .* 3 samples'):
        LiveInverse(PAPER, preview=3)
    with pytest.raises(DataError, match='rest, 11 V, lies outside'):
        LiveInverse(PAPER, rest=11.0)
    with pytest.raises(DataError, match='finite'):
        LiveInverse(PAPER).process([np.nan])


def test_a_channel_that_nobody_knows_ahead_is_left_out():
    model = replace(PAPER, effects=(EffectSetting('cross_coupling', VISIBLE['cross_coupling']),))
    live = LiveInverse(model)
    assert 'cross_coupling is not made up for' in live.warnings[0]
    assert np.isfinite(live.process(motion()).v).all()
