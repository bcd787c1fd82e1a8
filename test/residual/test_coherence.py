# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The coherence of voltage and residual: its bound and its share."""

import numpy as np
from piezo_ident.record.record import Piece
from piezo_ident.residual import ResidualPart
from piezo_ident.residual.coherence import coherence
import pytest
from scipy.signal import lfilter

N, RATE = 8000, 1000.0


def noise():
    return lfilter([0.1], [1, -0.9], np.random.default_rng(0).standard_normal(N))


def part(v, e):
    return ResidualPart('r', Piece(v, v + e, RATE), e)


def test_false_alarms_of_the_coherence():
    v = noise()
    rng = np.random.default_rng(2)
    bound = [coherence([part(v, rng.standard_normal(N))]) for _ in range(40)]
    above = np.mean([np.mean((c.coherence > c.bound)[c.tested]) for c in bound])
    assert 0.003 < above < 0.02
    assert np.mean([c.share for c in bound]) < 0.02


def test_the_coherent_share_is_all_but_the_noise():
    v = noise()
    e = 0.2 * np.roll(v, 7) + 0.05 * np.random.default_rng(4).standard_normal(N)
    share = 0.04 * v.var() / (0.04 * v.var() + 0.0025)
    assert coherence([part(v, e)]).share == pytest.approx(share, abs=0.1)


def test_too_little_data_give_nothing():
    assert coherence([part(np.arange(40.0), np.zeros(40))]) is None
