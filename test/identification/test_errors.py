# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What counts as an error of fast motion."""

import numpy as np
from piezo_ident.identification.errors import fast_error, Prediction
from piezo_ident.identification.prepare import runs_of, scaling_of
from piezo_ident.record.record import Record
import pytest

RATE = 10_000.0


def prediction(error):
    t = np.arange(20_000) / RATE
    v, y = 50 + 40 * np.sin(2 * np.pi * t), 10e-6 * (0.5 + 0.5 * np.sin(2 * np.pi * t))
    pieces = Record.from_arrays(v, y, sample_rate=RATE).pieces
    [run] = runs_of([Record(pieces)], RATE, scaling_of(pieces))
    y_hat = y - 10e-6 * error(t)
    return Prediction(run, y_hat, y_hat, run.use)


def test_slow_errors_do_not_count():
    # an offset, a drift and 1 Hz, all of 1 % of stroke
    for slow in (lambda t: 0.01, lambda t: 0.01 * t, lambda t: 0.01 * np.sin(2 * np.pi * t)):
        assert fast_error([prediction(slow)]) < 0.02


def test_fast_errors_count():
    made = prediction(lambda t: 0.01 * np.sin(2 * np.pi * 300 * t))
    assert fast_error([made]) == pytest.approx(1 / np.sqrt(2), rel=0.02)
