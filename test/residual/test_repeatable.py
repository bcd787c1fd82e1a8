# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What repeats of a residual: a misfit does, noise and hum do not."""

import numpy as np
from piezo_ident.record.record import Piece, Segment
from piezo_ident.residual import all_stretches, repeatability, ResidualPart
import pytest

RATE = 5000.0


def part(e_of, *, labelled: bool = True) -> ResidualPart:
    """Sines and triangles, five periods and more of each."""
    t = np.arange(20_000) / RATE
    sine = 5 - 5 * np.cos(2 * np.pi * 2.5 * t[:10_000])
    triangle = 10 * np.abs((4 * t[10_000:]) % 1 * 2 - 1)
    v = np.concatenate([sine, triangle])
    segments = (Segment('sine:2.5Hz', 0, 10_000), Segment('triangle', 10_000, 20_000))
    e = e_of(v, t)
    return ResidualPart('r', Piece(v, 7e-6 * v + e, RATE, 0.0, segments if labelled else ()), e)


@pytest.mark.parametrize('labelled', [True, False])
def test_a_misfit_repeats_and_noise_does_not(labelled):
    noise = 1e-8 * np.random.default_rng(0).standard_normal(20_000)
    one = part(lambda v, t: 3e-8 * np.sin(v) + noise, labelled=labelled)
    found = repeatability([one], all_stretches([one]))
    assert found.unrepeatable == pytest.approx(1e-8, rel=0.05)
    assert found.repeatable == pytest.approx(float(np.std(one.e - noise)), rel=0.05)
    assert found.seconds > 3.0


def test_hum_does_not_repeat():
    one = part(lambda v, t: 1e-8 * np.sin(2 * np.pi * 50.9 * t))
    assert repeatability([one], all_stretches([one])).share < 0.05


def test_unknown_where_nothing_repeats():
    v = np.cumsum(np.random.default_rng(1).standard_normal(5000))
    one = ResidualPart('r', Piece(v, v, RATE), v)
    found = repeatability([one], all_stretches([one]))
    assert found.share is None
    assert found.source.startswith('floor unknown')
