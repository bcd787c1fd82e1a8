# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Spectra are those of SciPy; the coherence of voltage and residual, its bound and its share."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.record.record import Piece
from piezo_ident.residual.coherence import coherence, cross_spectra
from piezo_ident.residual.stretches import ResidualPart
import pytest
from scipy import signal

N, RATE = 8000, 1000.0


def noise():
    return signal.lfilter([0.1], [1, -0.9], np.random.default_rng(0).standard_normal(N))


def part(v, e):
    return ResidualPart('r', Piece(v, v + e, RATE), e)


@pytest.mark.parametrize(('n', 'records'), [(N, 40), (256, 400)])
def test_false_alarms_of_the_coherence(n, records):
    v = noise()[:n]
    rng = np.random.default_rng(2)
    bound = [coherence([part(v, rng.standard_normal(n))]) for _ in range(records)]
    above = np.mean([np.mean((c.coherence > c.bound)[c.tested]) for c in bound])
    assert 0.003 < above < 0.02
    assert np.mean([c.share for c in bound]) < 0.02


def test_the_coherent_share_is_all_but_the_noise_and_too_little_data_give_none():
    v = noise()
    e = 0.2 * np.roll(v, 7) + 0.05 * np.random.default_rng(4).standard_normal(N)
    share = 0.04 * v.var() / (0.04 * v.var() + 0.0025)
    assert coherence([part(v, e)]).share == pytest.approx(share, abs=0.1)
    for n in (N, 256):
        assert coherence([part(v[:n], 3.0 * v[:n])]).share == pytest.approx(1.0, abs=1e-6)
    assert coherence([part(np.arange(40.0), np.zeros(40))]) is None


@pytest.mark.parametrize('linear', [True, False])
@pytest.mark.parametrize('size', [64, 65])
def test_spectra_are_those_of_scipy(size, linear):
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal((2, 1000)) + np.linspace(2, 5, 1000)
    how = {'nperseg': size, 'detrend': 'linear' if linear else 'constant'}
    ours, pairs = cross_spectra(u, y, size, linear=linear), ((u, u), (y, y), (u, y))
    # twice the power but for the mean and, at an even size, half the sampling rate
    for found, pair in zip(ours, pairs, strict=True):
        theirs = signal.csd(*pair, **how)[1][1:-1]
        assert_allclose(found[1:-1] / theirs, (found[1:-1] / theirs)[0], rtol=1e-9)
    scale = [(a / signal.csd(*p, **how)[1])[1] for a, p in zip(ours, pairs, strict=True)]
    assert_allclose(scale, scale[0], rtol=1e-9)
