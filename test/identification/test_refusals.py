# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What is no answer to a voltage is refused, and nothing else."""

import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.refusals import held_out_errors, refuse_delay, refuse_undriven
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record
import pytest

FS = 400.0
T = np.linspace(0.0, 1.0, 401)
#: one cycle up, down, and back [V]
TRIANGLE = 1400.0 * np.interp(T, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0])


def butterfly(v):
    """Return the strain of a ferroelectric that switches: even in the polarisation."""
    play = play_columns(v, np.array([600.0]), np.array([300.0]))[0] + 300.0
    return 1e-9 * np.abs(v - 1.8 * (v - play))


def record(v, y):
    return Record((Piece(v, y, FS),), 'mine')


def test_a_loop_of_little_coherence_is_an_answer():
    y = butterfly(TRIANGLE)
    driven, resting = held_out_errors(Piece(TRIANGLE, y, FS))
    assert driven < 0.9 * resting
    refuse_undriven([record(TRIANGLE, y)])


def test_a_butterfly_is_identified_and_what_h_misses_is_told():
    y = butterfly(TRIANGLE)
    result = pi.identify(record(TRIANGLE, y), pi.Settings(thresholds=10, max_order=2))
    assert np.isfinite(result.model.simulate(TRIANGLE)).all()
    # a result of which the half that H can hold is explained at most
    assert result.headline.percent > 5.0
    (even,) = (said for said in result.warnings if 'even in the voltage about 0 V' in said)
    assert int(even.partition('%')[0]) > 80


@pytest.mark.parametrize(
    'drift',
    [np.zeros(401), T, np.log(1.0 + 50.0 * T), np.exp(-7.0 * T), T**2 - T],
    ids=['none', 'line', 'logarithm', 'decay', 'square'],
)
def test_a_dead_channel_is_no_answer_and_a_clean_voltage_is_not_called_noise(drift):
    y = 1e-6 * drift + 1e-8 * np.random.default_rng(0).standard_normal(T.size)
    with pytest.raises(IdentificationError, match=r'-1400 .. 1400 V') as caught:
        refuse_undriven([record(TRIANGLE, y)])
    assert 'noise' not in str(caught.value)
    # both errors that were compared are named
    driven, resting = held_out_errors(Piece(TRIANGLE, y, FS))
    assert driven >= 0.9 * resting
    assert f'{driven:.3g} %' in str(caught.value)
    assert f'{resting:.3g} %' in str(caught.value)


def test_a_voltage_whose_means_rest_is_no_division_by_zero():
    v = np.tile([0.0, 1.0], 1000)
    y = 1e-9 * np.random.default_rng(0).standard_normal(v.size)
    assert np.isfinite(held_out_errors(Piece(v, y, FS))).all()


def test_a_delay_that_leaves_no_record_is_refused():
    pieces = [Piece(TRIANGLE, 1e-9 * TRIANGLE, FS)]
    for delay in (None, 0, 200):
        refuse_delay(pieces, delay)
    with pytest.raises(IdentificationError, match=r'201 samples.*401'):
        refuse_delay(pieces, 201)
