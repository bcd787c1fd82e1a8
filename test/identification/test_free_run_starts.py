# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""H, G and the delay from any motion, on modes in continuous time behind a held voltage."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.stage import PARTS
from piezo_ident.fitting.stretch import delayed, Stretch
from piezo_ident.identification.free_run_starts import Allowed, linear_starts, Search
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.operators.play import play_columns
from piezo_ident.selection.motion_kinds import interleaved
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


def found_in(w, x, **allowed):
    """Return the stage that the search finds for one motion."""
    span = np.ptp(w)
    block = np.arange(w.size) * 25 // w.size
    whole = np.ones(w.size, dtype=bool)
    stretch = Stretch((w - w.min()) / span, x / span, whole, block, FS)
    law = HysteresisLaw('plays', np.arange(1, 10) / 10.0)
    guess = np.full((1, PARTS), 0.5)
    search = Search([stretch], interleaved(25), None, law, guess, Allowed(**allowed), lambda: None)
    best, _ = search.best()
    return best.fit.stage


@pytest.mark.parametrize('drive', [lambda: chirp(1.2, 4000.0), steps, noise])
def test_modes_antiresonance_and_delay_come_out_of_any_broad_motion(drive):
    w = drive()
    x = stage(w) + 2e-5 * np.random.default_rng(1).standard_normal(w.size)
    found = found_in(w, x)
    G = found.dynamics
    # poles near half the sampling rate stand for the part of a sample of the delay
    modes = sorted(m.frequency for m in G.modes(FS) if m.damping < 0.1 and m.frequency < 5000.0)
    assert_allclose(modes, [f for f, *_ in MODES], rtol=3e-3)
    f = np.array([50.0, 300.0, 700.0, 1200.0, 1500.0, 2000.0])
    late = np.exp(-2j * np.pi * f * found.delay / FS)
    expected = truth(f)
    # a ring of some samples tells the phase of the whole
    assert_allclose(G.response(f, FS) * late, expected, atol=0.02 * abs(expected).max())
    assert G.a.size <= 6


def test_a_chirp_in_much_noise_shows_both_modes():
    w = chirp(1.2, 4000.0)
    x = stage(w)
    x += 0.2 * np.std(x) * np.random.default_rng(3).standard_normal(x.size)
    modes = [m for m in found_in(w, x).dynamics.modes(FS) if m.damping < 0.1]
    # what lies above the drive stands for the part of a sample of the delay
    modes = [m for m in modes if m.frequency < 4000.0]
    assert [round(mode.frequency / 10.0) for mode in modes] == [90, 230]
    assert_allclose([mode.damping for mode in modes], [0.01, 0.015], rtol=0.05)


def test_no_order_is_larger_than_the_largest_of_the_user():
    assert Allowed(largest=4).orders((1, 4, 6)) == [(1, 2), (4, 4)]
    assert Allowed(largest=1).orders((1, 2)) == [(1, 1)]
    assert Allowed(order=(6, 3), largest=4).orders((1, 2)) == [(6, 3)]


def test_a_long_delay_of_the_user_takes_no_lags():
    # the delay is half of the fitted parts between held-out samples
    w = np.append(0.0, np.cumsum(np.random.default_rng(0).standard_normal(1999)))
    x = delayed(signal.lfilter([0.3], [1.0, -1.5, 0.8], w), 200)
    use = np.arange(2000) % 500 < 400
    stretch = Stretch(w, x, use, np.zeros(2000, dtype=int), FS)
    [(delay, G)] = linear_starts([w], [stretch], Allowed(200, (2, 1)), ()).values()
    assert delay == 200
    assert_allclose([*G.a, *G.b], [-1.5, 0.8, 0.3], atol=1e-3)


def test_one_slow_sine_shows_no_mode_but_what_its_start_rings():
    w = 0.5 * np.sin(2.0 * np.pi * 40.0 * np.arange(20_000) / FS)
    x = stage(w) + 1e-3 * np.random.default_rng(1).standard_normal(w.size)
    for mode in found_in(w, x).dynamics.modes(FS):
        if mode.damping < 0.1:
            assert min(abs(mode.frequency / f - 1.0) for f, *_ in MODES) < 0.01


def test_a_mode_that_rings_longer_than_a_block_is_kept():
    rings = np.exp(2.0 * np.pi * 60.0 / FS * (-0.006 + 1j * np.sqrt(1.0 - 0.006**2)))
    a = np.real(np.poly([rings, np.conj(rings)]))
    w = noise()
    x = signal.lfilter([a.sum()], a, w)
    found = found_in(w, x + 2e-5 * np.random.default_rng(1).standard_normal(w.size))
    low = (m for m in found.dynamics.modes(FS) if m.damping < 0.1 and m.frequency < 5000.0)
    [mode] = low
    assert mode.frequency == pytest.approx(60.0, rel=1e-3)


def test_a_given_delay_and_order_are_kept():
    w = chirp(0.3, 4000.0)
    found = found_in(w, stage(w), delay=2, order=(4, 6))
    assert found.delay == 2
    assert (found.dynamics.a.size, found.dynamics.b.size) == (4, 6)


def test_a_given_order_is_used_where_the_search_would_take_none():
    w = chirp(0.3, 300.0)
    x = w + 1e-4 * np.random.default_rng(6).standard_normal(w.size)
    assert found_in(w, x).dynamics.is_static
    assert found_in(w, x, order=(2, 3)).dynamics.a.size == 2
    # parts of 30 samples are too short for it
    with pytest.raises(IdentificationError, match=r'G of order \(40, 40\).*--order'):
        found_in(w[:100], x[:100], order=(40, 40))


def test_plays_in_the_middle_of_their_bands_are_no_start_as_of_a_simulation():
    rng = np.random.default_rng(4)
    u = np.concatenate([np.zeros(50), np.cumsum(rng.standard_normal(3000))])
    u = np.abs(u) / np.abs(u).max()
    law = HysteresisLaw('plays', np.array([0.2, 0.6, 0.95]))
    middle = play_columns(u, law.thresholds, -0.5 * law.thresholds)
    x = 0.6 * u + 0.4 * np.array([0.3, 0.3, 0.4]) @ middle + 1e-4 * rng.standard_normal(u.size)
    block = np.arange(u.size) * 25 // u.size
    stretch = Stretch(u, x, np.ones(u.size, dtype=bool), block, FS)
    known, allowed = np.zeros((1, PARTS)), Allowed(order=(1, 2), delay=0)
    search = Search([stretch], interleaved(25), None, law, known, allowed, lambda: None)
    best, _ = search.best()
    assert best.fit.rms < 2e-4
    assert_allclose(best.fit.stage.memory(stretch), -0.5 * law.thresholds, atol=0.05)


def test_what_a_slow_pole_of_g_stood_for_becomes_creep():
    rng = np.random.default_rng(5)
    w = np.repeat(rng.uniform(0.0, 1.0, 60), 100).astype(float)
    tau, share, rate = 0.4, 0.03, 100.0
    lag = -np.expm1(-1.0 / rate / tau)
    crept = signal.lfilter([0.0, lag], [1.0, lag - 1.0], w) * share + w
    x = signal.lfilter([0.4], [1.0, -0.6], crept) + 1e-5 * rng.standard_normal(w.size)
    block = np.arange(w.size) * 25 // w.size
    stretch = Stretch(w, x, np.ones(w.size, dtype=bool), block, rate)
    law = HysteresisLaw('plays', np.array([0.3]))
    known, allowed = np.zeros((1, PARTS)), Allowed(delay=0)
    search = Search([stretch], interleaved(25), None, law, known, allowed, lambda: None)
    best, _ = search.best()
    taus = np.array([0.1, 0.4])
    creeping = search.wider(best, taus)[0].fit.stage
    assert best.fit.stage.dynamics.radius > 0.95
    assert creeping.dynamics.radius == pytest.approx(0.6, abs=0.05)
    assert creeping.creep.sum() == pytest.approx(share, abs=2e-3)
