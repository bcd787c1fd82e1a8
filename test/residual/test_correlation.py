# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bands and bounds hold what they promise for coloured residuals; a lag in the model is seen."""

import numpy as np
from piezo_ident.record.record import Piece
from piezo_ident.residual import ResidualPart
from piezo_ident.residual.correlation import coherence, cross_correlation
import pytest
from scipy.signal import lfilter

N, RATE = 8000, 1000.0
TIME = np.arange(N) / RATE


def drives():
    rng = np.random.default_rng(0)
    return {
        'sine': np.sin(2 * np.pi * 3 * TIME),
        'steps': np.repeat(rng.uniform(0, 1, 16), 500),
        'noise': lfilter([0.1], [1, -0.9], rng.standard_normal(N)),
    }


def part(v, e):
    return ResidualPart('r', Piece(v, v + e, RATE), e)


def related(found) -> bool:
    return bool(np.any(np.abs(found.correlation) > found.band))


@pytest.mark.parametrize('pole', [0.0, 0.9, 0.99])
@pytest.mark.parametrize('name', ['sine', 'steps', 'noise'])
def test_false_alarms_of_the_cross_correlation(pole, name):
    v = drives()[name]
    rng = np.random.default_rng(1)
    plain = alarms = 0.0
    for _ in range(40):
        e = lfilter([1], [1, -pole], rng.standard_normal(N + 2000))[2000:]
        found = cross_correlation([part(v, e)])
        plain += np.mean(np.abs(found.correlation) > 2.58 / np.sqrt(N)) / 40
        alarms += related(found) / 40
    # nominal 1 % for all lags together, of which 40 series tell only the order of magnitude
    assert alarms <= 0.05
    if pole:
        assert plain > 0.3


def test_false_alarms_of_the_coherence():
    v = drives()['noise']
    rng = np.random.default_rng(2)
    bound = [coherence([part(v, rng.standard_normal(N))]) for _ in range(40)]
    above = np.mean([np.mean((c.coherence > c.bound)[c.tested]) for c in bound])
    assert 0.003 < above < 0.02
    assert np.mean([c.share for c in bound]) < 0.02


def test_a_late_model_is_seen_at_its_lag():
    v = drives()['noise']
    rng = np.random.default_rng(4)
    e = 0.2 * np.roll(v, 7) + 0.05 * rng.standard_normal(N)
    found = cross_correlation([part(v, e)])
    assert related(found)
    assert found.lag[np.argmax(found.correlation)] == pytest.approx(7 / RATE)
    assert related(cross_correlation([part(v, e)], 'dv/dt'))
    # known shares: what is coherent is all but the noise
    share = 0.04 * v.var() / (0.04 * v.var() + 0.0025)
    assert coherence([part(v, e)]).share == pytest.approx(share, abs=0.1)


def test_too_little_data_give_nothing():
    short = part(np.arange(40.0), np.zeros(40))
    assert cross_correlation([short]) is None
    assert coherence([short]) is None


def test_the_band_does_not_depend_on_the_unit():
    v = drives()['noise']
    e = lfilter([1], [1, -0.9], np.random.default_rng(5).standard_normal(N))
    one, other = cross_correlation([part(v, e)]), cross_correlation([part(1e3 * v, 1e-9 * e)])
    np.testing.assert_allclose(one.band, other.band)
    np.testing.assert_allclose(one.correlation, other.correlation, atol=1e-12)
