# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Delay and G from any fast motion, on modes in continuous time behind a held voltage."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.identification.fast_motion import FastAndCalm, FastMotion, moving
from piezo_ident.identification.linear_part import find_linear_part
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.slow_part import fast_part, without_slow_part
from piezo_ident.operators.dynamics import Dynamics
import pytest
from scipy import signal

FS, OVER = 20_000.0, 8
#: natural frequency [Hz], damping, share of the static gain: an antiresonance lies between them
MODES = ((900.0, 0.01, 0.8), (2300.0, 0.015, 0.2))
DELAY = 2.375


def stage(w):
    """Return the answer of the modes to a held signal, a fraction of a sample late."""
    held = np.concatenate([np.zeros(round(DELAY * OVER)), np.repeat(w, OVER)])[: w.size * OVER]
    x = np.zeros(held.size)
    for f, zeta, share in MODES:
        s = 2.0 * np.pi * f
        system = ([share * s * s], [1.0, 2.0 * zeta * s, s * s])
        b, a, _ = signal.cont2discrete(system, 1.0 / FS / OVER, 'zoh')
        x += signal.lfilter(np.ravel(b), a, held)
    return x[::OVER]


def truth(f):
    s = 2j * np.pi * f
    modal = sum(
        share * (2 * np.pi * f0) ** 2 / (s * s + 4 * np.pi * zeta * f0 * s + (2 * np.pi * f0) ** 2)
        for f0, zeta, share in MODES
    )
    # the hold is half a sample late
    return modal * np.exp(-s * (DELAY + 0.5) / FS) * np.sinc(f / FS)


def chirp(seconds, top):
    t = np.arange(int(seconds * FS)) / FS
    return 0.05 * signal.chirp(t, 10.0, seconds, top) * np.minimum(1.0, 50.0 * t)


def steps():
    return np.repeat(np.arange(24) % 2 * 0.1, 1500).astype(float)


def noise():
    white = np.random.default_rng(2).standard_normal(30_000)
    return 0.02 * signal.sosfilt(signal.butter(4, 4000.0, fs=FS, output='sos'), white)


def found_in(w, x, **options):
    whole = np.ones(w.size, dtype=bool)
    return find_linear_part(FastMotion.of([Excerpt(w, x, whole)], FS), 12, **options)


@pytest.mark.parametrize('drive', [lambda: chirp(1.2, 4000.0), steps, noise])
def test_modes_antiresonance_and_delay_come_out_of_any_broad_motion(drive):
    w = drive()
    x = stage(w) + 2e-5 * np.random.default_rng(1).standard_normal(w.size)
    found = found_in(w, x)
    G = found.fit.dynamics.normalised()
    modes = sorted(m.frequency for m in G.modes(FS) if m.damping < 0.1)
    np.testing.assert_allclose(modes, [f for f, *_ in MODES], rtol=3e-3)
    f = np.array([50.0, 300.0, 700.0, 1200.0, 1500.0, 2000.0])
    late = np.exp(-2j * np.pi * f * found.delay.total / FS)
    expected = truth(f)
    # a ring of some samples tells the phase of the whole
    np.testing.assert_allclose(G.response(f, FS) * late, expected, atol=0.02 * abs(expected).max())
    assert G.a.size <= 6
    assert found.errors['dynamics'] < 0.2 * found.errors['nothing']


def test_a_chirp_in_much_noise_shows_both_modes():
    w = chirp(1.2, 4000.0)
    x = stage(w)
    x += 0.2 * np.std(x) * np.random.default_rng(3).standard_normal(x.size)
    modes = found_in(w, x).fit.dynamics.modes(FS)
    assert [round(mode.frequency / 10.0) for mode in modes] == [90, 230]
    assert_allclose([mode.damping for mode in modes], [0.01, 0.015], rtol=0.05)


def test_a_delay_that_steps_misread_spoils_no_rough_search():
    w = noise()
    found = found_in(w, stage(w), delays=[20], rough=True)
    assert found.methods['dynamics'] < 0.1 and found.delay.samples < 5


def test_creep_in_the_displacement_leaves_no_slow_pole():
    w = steps()
    creep = signal.lfilter([1.0 - np.exp(-2e-3)], [1.0, -np.exp(-2e-3)], w)
    found = found_in(w, stage(w) + 0.05 * creep)
    poles = found.fit.dynamics.poles
    slow = (poles.imag == 0.0) & (poles.real > np.exp(-2.0 * np.pi * 40.0 / FS))
    assert not slow.any()


def test_one_slow_sine_shows_no_mode_but_what_its_start_rings():
    w = 0.5 * np.sin(2.0 * np.pi * 40.0 * np.arange(20_000) / FS)
    x = stage(w) + 1e-3 * np.random.default_rng(1).standard_normal(w.size)
    found = found_in(w, x)
    modes = [] if found.fit is None else found.fit.dynamics.modes(FS)
    for mode in (m for m in modes if m.damping < 0.1):
        assert min(abs(mode.frequency / f - 1.0) for f, *_ in MODES) < 0.01


def test_a_mode_that_rings_longer_than_a_window_is_kept():
    # for half a second, which is many windows
    rings = np.exp(2.0 * np.pi * 60.0 / FS * (-0.006 + 1j * np.sqrt(1.0 - 0.006**2)))
    a = np.real(np.poly([rings, np.conj(rings)]))
    w = noise()
    x = signal.lfilter([a.sum()], a, w)
    found = found_in(w, x + 2e-5 * np.random.default_rng(1).standard_normal(w.size))
    [mode] = [m for m in found.fit.dynamics.modes(FS) if m.damping < 0.1]
    assert mode.frequency == pytest.approx(60.0, rel=1e-3)


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


def test_pure_delay_is_found_to_a_part_of_a_sample():
    w = chirp(0.6, 400.0)
    later = np.interp(np.arange(w.size) - 1.4, np.arange(w.size), w)
    found = found_in(w, later + 1e-4 * np.random.default_rng(1).standard_normal(w.size))
    assert found.fit is None
    assert found.delay.total == pytest.approx(1.4, abs=0.05)


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


def test_fast_motion_under_a_slow_sweep_is_left_where_there_is_better():
    t = np.arange(40_000) / FS
    sweep = 0.45 * np.sin(2.0 * np.pi * 60.0 * t) + 0.02 * np.sin(2.0 * np.pi * 400.0 * t)
    u = np.concatenate([sweep, np.zeros(4000), chirp(1.0, 3000.0)])
    samples = FastAndCalm.of([Excerpt(u, u, np.ones(u.size, dtype=bool))], FS, 0.9)
    [fast] = samples.fast
    assert fast[44_000:].mean() > 0.5
    assert fast[:38_000].mean() < 0.01


def test_of_a_rest_only_its_beginning_counts():
    u = np.concatenate([np.zeros(1000), np.linspace(0.0, 1.0, 1000), np.ones(1000)])
    moves = moving(u, 1000.0, 1.0)
    assert not moves[:990].any()
    assert moves[1010:2190].all()
    assert not moves[2210:].any()
