# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Spectra: the band that is driven, a known filter and its uncertainty."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.identification.spectra import (
    broadband_response,
    excited_band,
    frequency_response,
    prefilter,
)
from piezo_ident.operators.dynamics import Dynamics, filter_arx
import pytest
from scipy import signal

FS = 20_000.0


def test_excited_band_is_that_of_the_filter():
    rng = np.random.default_rng(0)
    sos = signal.butter(8, 3000, fs=FS, output='sos')
    u = signal.sosfilt(sos, rng.standard_normal(60_000))
    # 30 dB below the pass band of an eighth-order Butterworth filter: a little above 3 kHz
    assert 3000 < excited_band(u, FS) < 5000
    assert excited_band(rng.standard_normal(10_000), FS) == pytest.approx(FS / 2)


def test_prefilter_passes_the_band_and_no_mean():
    t = np.arange(20_000) / FS
    low, high = np.sin(2 * np.pi * 300 * t), np.sin(2 * np.pi * 6000 * t)
    out = prefilter(5 + low + high, FS, 2000)[4000:]
    assert out.std() == pytest.approx(np.sqrt(0.5), rel=0.02)
    assert abs(out.mean()) < 0.01
    assert_allclose(prefilter(5 + high, FS, 9500), high - high.mean() + 0, atol=1e-9)


# a resonance at 2 kHz with 5 % damping
POLE = np.exp(2 * np.pi * 2000 / FS * (-0.05 + 1j * np.sqrt(1 - 0.05**2)))
RESONANT = Dynamics(np.real(np.poly([POLE, np.conj(POLE)]))[1:], [0.3, 0.1])


def estimate(noise, seed=0, n=400_000, **options):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n)
    y = filter_arx(RESONANT.a, RESONANT.b, u, at_rest=False)
    return frequency_response(u, y + noise * y.std() * rng.standard_normal(n), FS, **options)


def test_known_filter_is_found_within_its_uncertainty():
    est = estimate(0.3)
    truth = RESONANT.response(est.frequency, FS)
    # beside the peak, where leakage is smaller than chance, and where the formula holds
    away = (np.abs(est.frequency - 2000) > 300) & (est.coherence > 0.5)
    error = (np.abs(est.response) / np.abs(truth) - 1)[away] / est.std[away]
    assert np.std(error) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.abs(error) < 3) > 0.98


def test_coherence_falls_with_noise():
    means = [estimate(noise).coherence.mean() for noise in (0.0, 0.1, 1.0, 10.0)]
    assert means[0] > 0.99
    assert np.all(np.diff(means) < 0)
    assert estimate(1.0).std.mean() > 5 * estimate(0.1).std.mean() * 0.9


def test_band_and_shapes():
    est = estimate(0.1, n=50_000, band=1500.0)
    assert 0 < est.frequency[0]
    assert est.frequency[-1] <= 1500
    assert est.frequency.shape == est.response.shape == est.coherence.shape == est.std.shape
    assert np.all((est.coherence >= 0) & (est.coherence <= 1))


def test_drift_of_both_is_taken_away():
    rng = np.random.default_rng(3)
    u = rng.standard_normal(100_000)
    t = np.linspace(0, 1, u.size)
    est = frequency_response(u, 0.5 * u + 1000 * t, FS)
    assert np.abs(est.response - 0.5).max() < 0.01


def test_any_motion_tells_where_it_is_fast():
    t = np.arange(40_000) / FS
    slow = np.sin(2 * np.pi * t)
    jump = np.where(t > 0.7, slow, -0.5)
    rich = signal.chirp(t, 5.0, 2.0, 500.0)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    found = {}
    for name, u in (('sine', slow), ('jump', jump), ('chirp', rich)):
        y = filter_arx(RESONANT.a, RESONANT.b, u, at_rest=False) + noise
        # a hysteresis makes harmonics that the voltage has not; they tell nothing of G
        w = u if name == 'jump' else u + 0.01 * u**3
        # a piece too short for a segment does no harm
        found[name] = broadband_response([(u, w, y), (u[:30], w[:30], y[:30])], FS)
    assert found['sine'] is None
    assert broadband_response([], FS) is None
    for name, least, most in (('jump', 2100, FS), ('chirp', 480, 600)):
        f = found[name].frequency
        assert least < f[-1] < most
        error = np.abs(found[name].response / RESONANT.response(f, FS) - 1.0)
        assert np.quantile(error[np.abs(f - 2000) > 100], 0.9) < 0.15
    assert np.abs(found['jump'].frequency - 2000).min() < 20


@pytest.mark.filterwarnings('error')
def test_silence_is_no_division_by_zero_and_a_few_samples_will_do():
    zero, some = np.zeros(5000), np.random.default_rng(0).standard_normal(5000)
    for u, y in ((zero, zero), (zero, some), (some, zero)):
        est = frequency_response(u, y, FS)
        assert np.all(np.isfinite(est.coherence))
        assert np.all(np.isfinite(est.response))
    assert frequency_response(some[:20], some[:20], FS).frequency.size > 0
