# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What can be asked for, and what a result says of itself."""

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.identification.results import ErrorRow, Identification, Steps
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.step1_delay import DelayResult, StepDelay
import pytest

WRONG = {
    'thresholds': (1, 401),
    'solver': ('magic',),
    'max_order': (0, 51),
    'order': ((0, 1), (1, 51), (2,), (2.5, 2), 2, (2, 2, 2)),
    'delay': (-1, 10_001),
    'hold_out': (0.0, float('nan'), float('inf')),
    'seed': (-1,),
    'swarm_size': (1,),
    'swarm_iterations': (0,),
}


@pytest.mark.parametrize(
    ('name', 'value', 'says'),
    [
        *((name, x, name) for name in WRONG for x in WRONG[name]),
        ('thresholds', 3.5, r'thresholds must be a whole number, got 3\.5'),
        ('thresholds', 'x', "thresholds must be a whole number, got 'x'"),
        ('seed', None, 'seed must be a whole number, got None'),
        ('hold_out', '5', "hold_out must be a number, got '5'"),
    ],
)
def test_what_cannot_be_followed_is_refused(name, value, says):
    with pytest.raises(ConfigError, match=says):
        Settings(**{name: value})


def step(samples):
    return StepDelay(samples, 0.3, 4, 0.0, 0.0, np.zeros(1, dtype=int), np.zeros(1))


def test_steps_and_scan_agree_within_a_sample():
    assert DelayResult(3, 0.3, 'steps', step(3), scan=4).agree is True
    assert DelayResult(3, 0.3, 'steps', step(3), scan=5).agree is False
    assert DelayResult(3, 0.3, 'steps', step(3)).agree is None
    assert DelayResult(3, 0.3, 'scan', step(None), scan=3).agree is None


ROWS = (
    ErrorRow('r', 'a', 3.0, 6.0, 0, 100, 'held out'),
    ErrorRow('r', 'b', 1.0, 2.0, 0, 300, 'held out'),
    ErrorRow('r', 'idle', 0.0, 90.0, 0, 600, 'held out'),
    ErrorRow('r', 'b', 50.0, 0, 0, 300, 'fitted'),
)


def result_of(*rows):
    return Identification(None, None, None, None, rows, None, '', 1.0, (), (), Settings())


def test_error_over_rows_is_weighted_by_samples():
    result = result_of(*ROWS)
    assert result.error('held out') == pytest.approx(np.sqrt((9 * 100 + 300) / 400))
    assert np.isnan(result.error('selection'))


def test_headline_takes_both_errors_over_the_same_samples_of_the_record_for_validation():
    headline = result_of(*ROWS).headline
    assert (headline.data, headline.records, headline.n) == ('held out', ('r',), 400)
    assert headline.percent == pytest.approx(np.sqrt((9 * 100 + 300) / 400))
    assert headline.static_percent == pytest.approx(2 * headline.percent)
    further = ErrorRow('other', '', 4.0, 5.0, 0, 10, 'validation')
    headline = result_of(*ROWS, further).headline
    assert (headline.data, headline.records) == ('validation', ('other',))
    assert (headline.percent, headline.static_percent) == (4.0, 5.0)
    assert np.isnan(result_of().headline.percent)


def test_steps_beside_another_delay_are_taken_again():
    found = Steps(DelayResult(3, 0.3, 'steps'))
    given = Steps(DelayResult(3, float('inf'), 'given'))
    assert found.beside(None) is found
    assert found.beside(3) is found
    assert given.beside(3) is given
    for steps, delay in ((found, 5), (given, 5), (given, None), (Steps(), 5)):
        assert steps.beside(delay).delay is None
