# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Volts and metres that no stage has are refused when a record is assembled."""

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.assemble import assemble
import pytest


@pytest.mark.parametrize(
    ('v', 'y', 'words'),
    [
        (1e-320, 1e-6, 'no voltage'),
        (1e13, 1e-6, 'no voltage'),
        (1.0, 1e-320, 'no piezo stage'),
        (1.0, float('1e300'), 'no piezo stage'),
    ],
)
def test_scales_that_are_none(v, y, words):
    k = np.arange(100.0)
    with pytest.raises(DataError, match=words):
        assemble(k / 1000, v * np.sin(k), y * np.sin(k), name='r')


@pytest.mark.parametrize('column', ['v', 'y'])
def test_digits_that_an_offset_has_used_up(column):
    k = np.arange(100.0)
    columns = {'v': np.sin(k), 'y': 1e-6 * np.sin(k)}
    x = columns[column]
    assemble(k / 1000, **{**columns, column: x + 100 * np.ptp(x)}, name='r')
    columns[column] = x + 1e11 * np.ptp(x)
    with pytest.raises(DataError, match=f'{column} lies at .* used up by the offset'):
        assemble(k / 1000, **columns, name='r')
