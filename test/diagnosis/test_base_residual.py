# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a file says that its model missed, and what that means for other motion."""

from types import SimpleNamespace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.base_residual import missed_now, missed_then
import pytest

RATE = 5000.0


@pytest.mark.parametrize(
    ('errors', 'missed'),
    [
        ({'unit': '%', 'fitted': 0.1, 'selection': 0.2, 'fast_motion': 0.05}, 0.05),
        ({'fitted': 0.1, 'selection': 0.2, 'held_out': 0.3, 'fast_motion': 0.05}, 0.05),
        # of records without labels
        ({'unit': '%', 'fitted': 0.1, 'held_out': 0.2, 'fast_motion': 0.05}, 0.05),
        # an older file
        ({'unit': '%', 'fitted': 0.1, 'held_out': 0.2}, 0.2),
        (None, 0.0),
    ],
)
def test_what_a_model_missed_is_read_from_its_file(errors, missed):
    assert missed_then(SimpleNamespace(identification={'errors': errors})) == missed


def data_of(amplitude, identification):
    """Return data of a fast sine, a sudden fault left out, and a slow sweep."""
    t = np.arange(20_000) / RATE
    x = amplitude * np.sqrt(2.0) * np.sin(2.0 * np.pi * 400.0 * t) + 0.5 * np.sin(t)
    use = np.ones(x.size, dtype=bool)
    use[:1000] = False
    use[9900:11_000] = False
    x[10_000:10_003] = 50.0
    run = SimpleNamespace(x=x, use=use, piece=SimpleNamespace(sample_rate=RATE))
    return SimpleNamespace(
        model=SimpleNamespace(identification=identification), rows=SimpleNamespace(runs=[run])
    )


@pytest.mark.parametrize(('amplitude', 'times'), [(0.01, 1.0), (0.04, 2.0), (0.12, 6.0)])
def test_what_g_misses_grows_with_the_motion(amplitude, times):
    known = {'errors': {'fast_motion': 0.05}, 'fast_displacement': {'percent_of_stroke': 1.0}}
    assert times == max(1.0, criteria.IN_PROPORTION * 100.0 * amplitude)
    assert missed_now(data_of(amplitude, known)) == pytest.approx(0.05 * times, rel=0.01)


@pytest.mark.parametrize('known', [{}, {'fast_displacement': {'percent_of_stroke': 0.0}}])
def test_without_the_motion_of_then_it_is_what_was_missed(known):
    data = data_of(0.12, known | {'errors': {'fast_motion': 0.05}})
    assert missed_now(data) == 0.05
