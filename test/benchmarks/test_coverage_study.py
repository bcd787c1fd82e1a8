# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tables of the study of bands: coverage by kind, weights, and draws of the noise."""

import numpy as np
from parameter_draws import Draw, REFERENCE, table, todo_draws
import pytest
from study_coverage import Covered, page, picture
from truths import draw

INSIDE = (0.5, 0.7, 0.8, 0.9, 0.95)


def rows():
    cells = (('sine', INSIDE, 0.3, 0.1, 0.0), ('idle', (), np.nan, np.nan, 1.0))
    known = [
        Covered(f'diagnosed {k}', cells, weight=0.1 * k, is_right=k > 4, other=(0.2, None))
        for k in range(10)
    ]
    return [Covered('identified 0', cells, (0.1, 0.2), (0.3, 0.1), 1.2), *known]


def test_the_page_holds_what_the_rows_say(tmp_path):
    text = page(rows(), [], 0)
    assert '| sine | 1 | 50 | 70 | 80 | 90 | 95 | 3.00 | 3.00 | 0% |' in text
    assert '| identified | 1 | 0.50 \\| 0.50 | 3.00 \\| 3.00 |' in text
    # five bins of two: off by 0.05, 0.25, 0.05, 0.35 and 0.15
    assert 'calibration error 0.17' in text and '5 of 10' in text
    # weights of 0 and 1 that hold never err
    sure = [Covered(f'diagnosed {k}', weight=k % 2, is_right=k < 3) for k in range(6)]
    assert 'error 0.67 (wanted 0.07; weights that hold have 0.00' in page(sure, [], 0)
    picture(rows(), tmp_path / 'coverage.png')
    assert (tmp_path / 'coverage.png').stat().st_size > 1000


def test_draws_are_judged_by_their_reference():
    todo = todo_draws(400, 1, draw('known', 0))
    assert len(todo) == 4 + 8 * 400 and len({one.key for one in todo}) == len(todo)
    rng = np.random.default_rng(0)

    def values(one):
        if one.number == REFERENCE:
            return ('H loop width at 25% of the range', 1.0, np.nan)
        # the deviation is half of the scatter, and the bias is one scatter
        return ('H loop width at 25% of the range', 1.02 + 0.02 * rng.standard_normal(), 0.01)

    found = table({one.key: Draw(one.key, (values(one),)) for one in todo}, todo)
    assert len(found) == 8
    for one in found:
        assert one.kind == 'loop width' and one.draws == 400
        assert one.ratio == pytest.approx(2.0, rel=0.1)
        assert one.bias == pytest.approx(1.0, abs=0.25)
        # P(|z| < 1), and P(-2 < z < 0)
        assert one.beside == pytest.approx(0.683, abs=0.1)
        assert one.held == pytest.approx(0.477, abs=0.1)
