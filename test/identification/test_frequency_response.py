# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Welch's estimate against a filter that is known."""

import numpy as np
from piezo_ident.identification.step2_dynamics import _straightened, frequency_response
from piezo_ident.operators.dynamics import Dynamics, filter_arx
import pytest
from scipy import signal

FS = 20_000.0
# a resonance at 2 kHz with 5 % damping
POLE = np.exp(2 * np.pi * 2000 / FS * (-0.05 + 1j * np.sqrt(1 - 0.05**2)))
G = Dynamics(np.real(np.poly([POLE, np.conj(POLE)]))[1:], [0.3, 0.1])


def estimate(noise, seed=0, n=400_000, **options):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n)
    y = filter_arx(G.a, G.b, u, at_rest=False)
    return frequency_response(u, y + noise * y.std() * rng.standard_normal(n), FS, **options)


def test_known_filter_is_found_within_its_uncertainty():
    est = estimate(0.3)
    truth = G.response(est.frequency, FS)
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
    assert est.averages >= 15


def test_drift_of_both_is_taken_away():
    rng = np.random.default_rng(3)
    u = rng.standard_normal(100_000)
    t = np.linspace(0, 1, u.size)
    est = frequency_response(u, 0.5 * u + 1000 * t, FS)
    assert np.abs(est.response - 0.5).max() < 0.01


@pytest.mark.filterwarnings('error')
def test_silence_is_no_division_by_zero():
    zero, some = np.zeros(5000), np.random.default_rng(0).standard_normal(5000)
    for u, y in ((zero, zero), (zero, some), (some, zero)):
        est = frequency_response(u, y, FS)
        assert np.all(np.isfinite(est.coherence))
        assert np.all(np.isfinite(est.response))


@pytest.mark.filterwarnings('error')
def test_a_few_samples_will_do():
    some = np.random.default_rng(0).standard_normal(20)
    assert frequency_response(some, some, FS).frequency.size > 0


def test_trends_are_taken_away_as_scipy_does():
    x = np.random.default_rng(4).standard_normal((3, 2, 64)) + np.linspace(2, 5, 64)
    assert np.abs(_straightened(x) - signal.detrend(x)).max() < 1e-12
