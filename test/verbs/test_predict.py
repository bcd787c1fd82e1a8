# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A prediction refuses what it cannot follow, before it begins."""

from axes_scanner import play, scanner
import numpy as np
from paper_stage import FS, PAPER
import piezo_ident as pi
import pytest


def test_an_unknown_axis_and_an_interval_of_another_type_are_refused():
    v = 5 - 5 * np.cos(np.arange(500) / 50)
    record = pi.Record.from_arrays(v, PAPER.simulate(v), sample_rate=FS)
    with pytest.raises(pi.DataError, match=r'axes: .* z; .* y$'):
        pi.free_run(PAPER, record, axes=['z'])
    assert pi.free_run(PAPER, record, axes=['y']).errors.percent < 0.01
    with pytest.raises(pi.DataError, match=r'axes: .* z; .* y, y_b$'):
        pi.free_run(scanner(), play(v, v), axes=['y', 'z'])
    with pytest.raises(pi.DataError, match=r'interval: .* str; '):
        pi.free_run(PAPER, record, '0.9')
