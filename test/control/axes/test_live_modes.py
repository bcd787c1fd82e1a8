# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Shared modes are inverted live: near the offline inverse, however cut, within all limits."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import piezo_ident as pi
from piezo_ident.control.axes.live_modes import LiveModesInverse
from piezo_ident.model.modes.stream import ModesStream
import pytest
from random_models import random_modes_model, random_voltages
from scipy.ndimage import gaussian_filter1d

AXES = ('y', 'y_b', 'y_c')
# the filters look ahead, so the voltage begins by a step below that of rest
LIMITS = {'limits': (-1.0, 11.0), 'rest': 0.0}


def case(seed, axes=2, n=3000, size=2.0, **options):
    """Return a random model, and motions from rest under 0 V that it can make, a row an axis."""
    rng = np.random.default_rng(seed)
    model = random_modes_model(rng, axes, **options)
    k = np.arange(n)
    soft = (0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, np.minimum(k, k[::-1]) / 800)))[:, None]
    v = soft * (
        model.modes.v0 + size * (random_voltages(rng, model.modes, n) - model.modes.v0) / 3
    )
    y = gaussian_filter1d(ModesStream(model.modes).process(v), 5.0, axis=0)
    return model, np.ascontiguousarray(y.T)


def driven(live, wanted, size=100):
    """Return the voltages for a motion and where they miss it, until the motion is over."""
    known = np.pad(wanted, ((0, 0), (0, live.preview)), mode='edge')
    parts = [live.process(known[:, k : k + size]) for k in range(0, known.shape[1], size)]
    return (np.hstack(z) for z in zip(*parts, strict=True))


def errors(model, live, wanted, v, order=AXES):
    """Return what the modes miss under voltages, by axis [% of the span]."""
    columns = {f'v{a[1:]}': row for a, row in zip(order, v, strict=False)}
    y = model.simulate(columns)
    miss = [y[a][live.preview :] - row for a, row in zip(order, wanted, strict=False)]
    return [100 * np.std(e) / np.ptp(row) for e, row in zip(miss, wanted, strict=True)]


@pytest.mark.parametrize(
    ('seed', 'strength', 'most'),
    [(0, 0.1, 0.1), (1, 0.1, 0.1), (2, 0.1, 0.1), (3, 0.1, 0.1), (4, 0.5, 0.1), (5, 0.5, 1.5)],
)
def test_random_modes_move_as_wanted(seed, strength, most):
    model, wanted = case(seed, 1 + seed % 3, softens=bool(seed % 2), strength=strength)
    axes = AXES[: len(wanted)]
    live = LiveModesInverse(model, axes, **LIMITS)
    v, clipped = driven(live, wanted)
    assert not clipped.any() and live.passes > 2
    left = errors(model, live, wanted, v)
    # the offline inverse leaves 0.001 %, and the linear one some percent
    assert max(left) < most
    linear = pi.MultiAxisModel(model.axes, replace(model.modes, e=0 * model.modes.e))
    plain = LiveModesInverse(linear, axes, **LIMITS)
    assert max(errors(model, plain, wanted, next(driven(plain, wanted)))) > 3 * most


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_cuts_change_nothing(seed):
    rng = np.random.default_rng(seed)
    model, wanted = case(rng.integers(6), 1 + seed % 3, n=2000)
    live = LiveModesInverse(model, AXES[: len(wanted)], preview=int(rng.integers(20, 200)))
    whole = live.process(wanted)
    live.reset()
    cuts = np.unique(rng.integers(1, wanted.shape[1], 6))
    parts = [live.process(part) for part in np.split(wanted, cuts, axis=1)]
    np.testing.assert_allclose(np.hstack([part.v for part in parts]), whole.v, rtol=0, atol=1e-12)
    assert np.array_equal(np.hstack([part.clipped for part in parts]), whole.clipped)


def test_the_order_of_the_rows_is_that_of_the_axes():
    model, wanted = case(1)
    forwards, backwards = (LiveModesInverse(model, axes) for axes in (AXES[:2], AXES[1::-1]))
    v, _ = driven(forwards, wanted)
    other, _ = driven(backwards, wanted[::-1])
    np.testing.assert_array_equal(v, other[::-1])
    np.testing.assert_array_equal(forwards.position, backwards.position[::-1])


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_and_slew_are_kept_whatever_is_wanted(seed):
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.uniform([0.0, 7.0], [3.0, 10.0]))
    slew = 10.0 ** rng.uniform(2.0, 5.0)
    model = random_modes_model(np.random.default_rng(rng.integers(6)))
    live = LiveModesInverse(model, AXES[:2], limits=(low, high), slew=slew)
    wanted = rng.choice([1e-6, 1e-4]) * np.cumsum(rng.standard_normal((2, 500)), axis=1)
    v, clipped = driven(live, wanted)
    assert v.min() >= low and v.max() <= high
    step = slew / model.sample_rate
    assert np.abs(np.diff(v, axis=1, prepend=low)).max() <= step * (1 + 1e-9)
    assert clipped.any() or np.ptp(wanted) < 60e-6


def test_what_is_clipped_is_told_and_the_other_axis_moves_on():
    model, wanted = case(1)
    free = LiveModesInverse(model, AXES[:2], **LIMITS)
    high = 0.9 * float(next(driven(free, wanted))[0].max())
    free.reset()
    # the second axis stays below this limit
    wanted[1] = free.position[1] + 0.6 * (wanted[1] - free.position[1])
    v, clipped = driven(free, wanted)
    assert not clipped.any()
    alone = errors(model, free, wanted, v)
    live = LiveModesInverse(model, AXES[:2], limits=(-1.0, high), rest=0.0)
    v, clipped = driven(live, wanted)
    left = errors(model, live, wanted, v)
    assert clipped[0].any() and not clipped[1].any()
    # the second axis meets its motion as without a limit
    assert left[0] > 0.5 and left[1] < 2.0 * alone[1] < 0.05


def test_a_preview_that_is_short_is_told_and_what_makes_no_sense_refused():
    model, wanted = case(2)
    live = LiveModesInverse(model, AXES[:2], preview=2)
    assert live.error > 0.1 and 'preview of 2 samples' in live.warnings[0]
    assert LiveModesInverse(model, AXES[:2]).error < 0.1
    with pytest.raises(pi.DataError, match='rest, 11 V, lies outside'):
        LiveModesInverse(model, AXES[:2], rest=11.0)
    with pytest.raises(pi.ModelError, match='preview of 0 samples'):
        LiveModesInverse(model, AXES[:2], preview=0)
    for wrong in (wanted[:1], wanted[:, :0], np.full((2, 5), np.nan)):
        with pytest.raises(pi.DataError, match=r'\b2 rows '):
            live.process(wrong)
    with pytest.raises(pi.ModelError, match=r'y, y_b .*LiveInverse'):
        LiveModesInverse(pi.MultiAxisModel(model.axes), AXES[:2])


def test_modes_that_run_away_are_refused():
    model, _ = case(3)
    wild = replace(model.modes, e=-300.0 * model.modes.e, levels=0)
    with pytest.raises(pi.ModelError, match=r'at sample \d+ of \d+'):
        LiveModesInverse(pi.MultiAxisModel(model.axes, wild), AXES[:2])
