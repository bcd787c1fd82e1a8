# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers that cannot be trusted end in a refusal that says why, or in finite numbers and a warning.

`benchmarks/reliability/untrusted.py` prints the table.
"""

from pathlib import Path
import sys

import numpy as np
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.model.files import model_from_dict, model_to_dict
from piezo_ident.model.free_run import free_run
from piezo_ident.record.assemble import assemble
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'benchmarks'))
from reliability import untrusted  # noqa: E402

sys.path.remove(str(ROOT / 'benchmarks'))


@pytest.mark.parametrize('case', untrusted.CASES)
def test_the_outcome_is_the_stated_one(tmp_path, case):
    said = untrusted.outcomes(case, tmp_path)
    for (verb, x), start in zip(said.items(), untrusted.EXPECTED[case], strict=True):
        assert x.startswith(start), verb
        # nor does NumPy complain
        assert 'Warning' not in x


def test_every_case_has_a_stated_outcome():
    assert list(untrusted.EXPECTED) == list(untrusted.CASES)


def test_a_model_that_overflows_is_no_prediction():
    data = model_to_dict(untrusted.stage().model)
    data['output']['Y'] = 1e308
    data['hysteresis']['p2'] = 1e10
    with np.errstate(over='ignore'), pytest.raises(ModelError, match='diverges'):
        free_run(model_from_dict(data), untrusted.measured(untrusted.CHECK))


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
