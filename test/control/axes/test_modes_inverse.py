# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Shared modes are inverted: all axes move as wanted, or a sentence says why not."""

from dataclasses import replace

import axes_stage as stage
import numpy as np
import piezo_ident as pi
from piezo_ident.control.axes.axes_inverse import SINGULAR
from piezo_ident.model.modes.stream import ModesStream
import pytest
from random_models import random_modes_model, random_voltages
from scipy.ndimage import gaussian_filter1d


def softly(n, edge=400):
    """Return a window that rises from zero and falls to zero."""
    k = np.arange(n)
    return np.minimum(1.0, np.minimum(k, k[::-1]) / edge)[:, None] ** 2


def case(seed, axes=2, n=3000, size=2.0, **options):
    """Return a random model and motions by axis that it can make, but for some fast parts."""
    rng = np.random.default_rng(seed)
    model = random_modes_model(rng, axes, **options)
    modes = model.modes
    v = modes.v0 + softly(n) * (random_voltages(rng, modes, n, size) - modes.v0)
    y = gaussian_filter1d(ModesStream(modes).process(v), 5.0, axis=0)
    return model, dict(zip(sorted(model.axes), y.T, strict=True))


def errors(model, wanted, drive):
    """Return the errors of the simulated stage under a drive, in % of stroke, by axis."""
    y = model.simulate(drive.voltages)
    miss = {a: wanted[a] - y[a][drive.lead :] for a in wanted}
    return {a: 100 * float(np.sqrt(np.mean(e**2)) / np.ptp(wanted[a])) for a, e in miss.items()}


@pytest.mark.parametrize(
    ('seed', 'strength', 'most'),
    [(0, 0.1, 0.01), (1, 0.1, 0.01), (2, 0.1, 0.01), (3, 0.1, 0.01), (4, 0.5, 0.5), (5, 0.5, 0.5)],
)
def test_random_modes_move_as_wanted(seed, strength, most):
    options = {'softens': bool(seed % 2), 'creeps': seed in (2, 3)}
    model, wanted = case(seed, 1 + seed % 3, strength=strength, **options)
    backwards = dict(reversed(wanted.items()))
    drive = pi.invert(model, backwards)
    assert errors(model, wanted, drive) == pytest.approx(dict(drive.errors), rel=1e-9)
    assert max(drive.errors.values()) < most
    # what the plays do is far more
    linear = pi.MultiAxisModel(model.axes, replace(model.modes, e=0 * model.modes.e))
    assert max(errors(model, wanted, pi.invert(linear, wanted)).values()) > 3 * most
    for axis, one in drive.items():
        np.testing.assert_array_equal(one.predicted, drive.predicted[axis])
        np.testing.assert_array_equal(one.wanted[one.lead :], wanted[axis])
        assert one.passes > 2 and one.t[one.lead] == 0.0 and not one.clipped.any()


def test_an_axis_without_a_motion_rests():
    model, wanted = case(1)
    drive = pi.invert(model, {'y': wanted['y']})
    moved = drive.predicted['y_b']
    assert np.abs(moved - moved[0]).max() < 1e-3 * np.ptp(wanted['y'])


def test_limits_and_slew_are_kept():
    model, wanted = case(1)
    free = pi.invert(model, wanted)
    v = free.voltages['v']
    low, high = float(v.min()), float(v.min() + 0.7 * np.ptp(v))
    with pytest.raises(pi.DataError, match=rf' of y .* {high:g} V.* \S+ um'):
        pi.invert(model, wanted, limits=(min(low, 0.0), high))
    held = pi.invert(model, wanted, limits=(min(low, 0.0), high), clip=True)
    assert held.voltages['v'].max() <= high and held['y'].clipped.any()
    assert any(f' of y are out of reach within 0 .. {high:g} V' in x for x in held['y'].warnings)
    within = ~held['y'].clipped
    miss = (held['y'].wanted - held['y'].predicted)[within]
    assert np.sqrt(np.mean(miss**2)) < 0.02 * np.ptp(wanted['y'])
    slew = 0.8 * float(np.abs(np.diff(v)).max()) * model.sample_rate
    slow = pi.invert(model, wanted, slew=slew, clip=True)
    for u in slow.voltages.values():
        assert np.abs(np.diff(u)).max() * model.sample_rate <= slew * (1 + 1e-9)


@pytest.mark.parametrize(
    ('change', 'options', 'says'),
    [
        (lambda y: y + 1.0, {}, r'of y .* um, .* 0 .. 10 V'),
        (lambda y: y[:1], {}, r'motion .* \(1,\)'),
        (lambda y: np.full(y.size, np.nan), {}, r'motion .* \(3000,\) .* 3000 bad'),
        (lambda y: y[None], {}, r'motion .* \(1, 3000\)'),
        (lambda y: y, {'sample_rate': 1000.0}, 'sampled at 1000 Hz'),
    ],
)
def test_a_wanted_motion_that_cannot_be_is_refused(change, options, says):
    model, wanted = case(1)
    with pytest.raises(pi.DataError, match=says):
        pi.invert(model, {**wanted, 'y': change(wanted['y'])}, **options)


def loop_model(**options):
    """Return a model of two axes with the modes of a stage of 2 kHz about 5 V."""
    modes = replace(stage.loop_stage(**options), v0=np.full(2, 5.0))
    axes = random_modes_model(np.random.default_rng(0), 2).axes
    return pi.MultiAxisModel(
        {a: replace(x, sample_rate=stage.RATE) for a, x in axes.items()}, modes
    )


def test_modes_that_soften_by_a_tenth_are_inverted_at_all_levels():
    model, t = loop_model(plays=0.05), np.arange(4000) / stage.RATE
    soft = softly(t.size, 600)[:, 0]
    wanted = {
        'y': soft * (1.2 * np.sin(2 * np.pi * 40 * t) + 0.4 * np.sin(2 * np.pi * 170 * t)),
        'y_b': soft * 1.5 * np.sin(2 * np.pi * 3 * t),
    }
    drive = pi.invert(model, wanted)
    assert max(errors(model, wanted, drive).values()) < 0.02


def test_motion_faster_than_the_stage_is_told():
    model, t = loop_model(), np.arange(3000) / stage.RATE
    wanted = {'y': np.random.default_rng(4).normal(size=t.size) * softly(t.size)[:, 0]}
    drive = pi.invert(model, wanted, limits=(-1e3, 1e3))
    assert any('misses' in text for text in drive['y'].warnings)
    assert errors(model, wanted, drive) == pytest.approx({'y': drive.errors['y']}, rel=1e-9)


@pytest.mark.parametrize('share', [-0.5, -10.0])
def test_what_does_not_contract_is_refused_in_one_sentence(share):
    model, wanted = case(1)
    modes = model.modes
    wild = replace(modes, e=share * modes.e, levels=0)
    if share == -0.5:
        # plays take back all that the voltage gives beyond their threshold
        weights = share * np.vstack([np.zeros((2, 2)), np.eye(2)])
        mu = np.array([[0.0] * 3] * 2 + [[2.0, 0.0, 0.0]] * 2)
        of_voltages = np.vstack([np.zeros((2, 2)), np.eye(2)])
        nothing = np.zeros((4, modes.linear.order))
        wild = replace(
            modes,
            e=modes.linear.b @ weights.T,
            h=np.zeros((2, 4)),
            f=nothing,
            g=of_voltages,
            levels=0,
            mu=mu,
        )
    with pytest.raises(pi.ModelError, match=r'% .* after \d+ passes'):
        pi.invert(pi.MultiAxisModel(model.axes, wild), wanted, limits=(-1e4, 1e4))


def test_axes_that_move_as_one_have_no_inverse():
    model, wanted = case(1)
    one = model.modes.linear
    twice = replace(model.modes, linear=replace(one, c=np.vstack([one.c[0], one.c[0]])))
    with pytest.raises(pi.ModelError, match=f'condition .* {SINGULAR:g};'):
        pi.invert(pi.MultiAxisModel(model.axes, twice), wanted)
