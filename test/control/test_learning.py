# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Learning: the error of a motion that is repeated falls, and never the limits."""

from dataclasses import replace

import numpy as np
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.model.stage_model import EffectSetting
import pytest

T = np.arange(6000) / FS
RASTER = 35e-6 + 15e-6 * np.sin(2 * np.pi * 20 * T) ** 3 * np.minimum(1.0, T / 0.05)


def repeated(stage, learning, rng=None, noise=0.0, most=8):
    """Return the errors of repetitions until the learning is done."""
    errors = []
    while not learning.is_done and len(errors) < most:
        y = stage.simulate(learning.drive.v)
        if noise:
            y = y + noise * rng.standard_normal(y.size)
        errors.append(learning.take(y))
    return errors


def test_the_error_of_effects_that_the_model_lacks_falls_and_the_best_is_kept():
    effects = (
        EffectSetting('creep', {'gain': [0.01, 0.02], 'time_constant': [0.05, 0.5]}),
        EffectSetting('sensor_nonlinearity', {'square': 0.02}),
        EffectSetting('saturation', {'high': 0.9, 'knee': 0.1}),
    )
    learning = pi.Learning(PAPER, RASTER)
    errors = repeated(replace(PAPER, effects=effects), learning)
    assert errors[0] > 0.5
    assert errors[2] < 0.1 * errors[0]
    assert learning.best.error == min(errors) < 0.01


def test_it_ends_at_the_noise():
    rng = np.random.default_rng(5)
    learning = pi.Learning(PAPER, RASTER)
    effects = (EffectSetting('sensor_nonlinearity', {'square': 0.02}),)
    errors = repeated(replace(PAPER, effects=effects), learning, rng, 20e-9)
    floor = 100.0 * 20e-9 / np.ptp(RASTER)
    assert learning.is_done and len(errors) < 8
    assert floor < learning.best.error < 1.3 * floor


def test_limits_are_never_left():
    stage = replace(PAPER, effects=(EffectSetting('saturation', {'high': 0.5}),))
    limits = (1.0, 8.0)
    learning = pi.Learning(PAPER, RASTER, limits=limits, slew=5000.0)
    errors = repeated(stage, learning)
    assert min(errors) <= errors[0]
    for repetition in learning.repetitions:
        v = repetition.drive.v
        assert v.min() >= limits[0] and v.max() <= limits[1]
        assert np.abs(np.diff(v)).max() <= 5000.0 / FS * (1 + 1e-9)


def test_what_was_not_measured_is_refused():
    learning = pi.Learning(PAPER, RASTER)
    with pytest.raises(DataError, match='nothing was measured'):
        _ = learning.best
    with pytest.raises(DataError, match='3 measured samples for 60'):
        learning.take([0.0, 1.0, 2.0])
    with pytest.raises(DataError, match='finite'):
        learning.take(np.full(learning.drive.v.size, np.nan))
