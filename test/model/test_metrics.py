# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The error numbers against their formulas."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_stage import PAPER
from piezo_ident.model.metrics import (
    expected_error,
    fit_percent,
    percent_of_stroke,
    runs_against,
    worst_error,
)
import pytest

Y = np.array([0.0, 1.0, 2.0, 4.0])


def test_percent_of_stroke_and_fit_by_hand_and_without_a_stroke():
    # errors 0, 0, 0, 0.4: rms 0.2, stroke 4
    assert percent_of_stroke(Y, Y - [0, 0, 0, 0.4]) == pytest.approx(5.0)
    assert percent_of_stroke(Y, Y - [0, 0, 0, 0.4], stroke=2.0) == pytest.approx(10.0)
    # a prediction by the mean fits by 0 %, a perfect one by 100 %
    assert fit_percent(Y, np.full(4, Y.mean())) == pytest.approx(0.0)
    assert fit_percent(Y, Y) == 100.0
    assert fit_percent(Y, 2 * Y.mean() - Y) == pytest.approx(-100.0)
    still = np.ones(4)
    assert percent_of_stroke(still, still) == 0.0
    assert percent_of_stroke(still, still + 1) == float('inf')
    assert fit_percent(still, still) == 100.0
    assert fit_percent(still, still + 1) == float('-inf')


@settings(deadline=None)
@given(
    st.floats(1e-9, 1e3),
    st.floats(-1e-3, 1e-3),
    st.lists(st.floats(-1, 1), min_size=4, max_size=4),
)
def test_percentages_do_not_depend_on_the_unit(scale, shift, errors):
    e = np.array(errors)
    one, two = (Y, Y + e), (scale * (Y + shift), scale * (Y + e + shift))
    assert percent_of_stroke(*two) == pytest.approx(percent_of_stroke(*one), rel=1e-6, abs=1e-9)
    assert fit_percent(*two) == pytest.approx(fit_percent(*one), rel=1e-6, abs=1e-6)


def test_a_reversed_sign_is_told_from_a_poor_model():
    y_hat = np.sin(np.arange(2000) / 50)
    noise = np.random.default_rng(1).standard_normal(2000)
    assert runs_against([(7.0 - y_hat + 0.3 * noise, y_hat)], 2.0)
    # each piece from a zero of its own
    assert runs_against([(9.0 - y_hat, y_hat), (-9.0 - y_hat, y_hat)], 2.0)
    assert not runs_against([(7.0 + y_hat + 0.3 * noise, y_hat)], 2.0)
    # late by a quarter of a period and more, a wrong reading, rest
    assert not runs_against([(np.sin(np.arange(2000) / 50 - 2.0), y_hat)], 2.0)
    assert not runs_against([(noise, y_hat)], 2.0)
    assert not runs_against([(-y_hat, y_hat)], 200.0)
    assert not runs_against([(0.0 * y_hat, y_hat)], 2.0)
    assert not runs_against([], 2.0)


def of(**identification):
    return expected_error(replace(PAPER, identification=identification))


def test_expected_error_is_that_of_data_as_far_from_the_fit_as_there_are():
    assert of() is None
    assert of(errors='none', diagnosis='none') is None
    errors = {'fitted': 0.1, 'selection': 0.2, 'held_out': 0.3, 'unit': '% of stroke'}
    assert of(errors=errors) == 0.3
    assert of(errors={'fitted': 0.1, 'selection': 0.2}) == 0.2
    assert of(errors={'fitted': 0.1, 'held_out': float('nan')}) == 0.1
    # of a refined model, that of the model that it was no more
    assert of(errors=errors, diagnosis={'errors': {'before': 0.5, 'after': 0.05}}) == 0.05
    assert of(errors=errors, diagnosis={'errors': {'before': 0.5}}) == 0.5
    assert of(errors=errors, diagnosis={'verdict': 'named'}) == 0.3


def test_worst_error_is_that_of_the_kind_of_motion_that_is_known_least():
    def worst(**identification):
        return worst_error(replace(PAPER, identification=identification))

    assert worst() is None
    errors = {'fitted': 0.1, 'held_out': 0.3, 'worst': 0.8}
    assert worst(errors=errors) == 0.8
    assert worst(errors={**errors, 'worst': float('nan')}) == 0.3
    # that of its diagnosis replaces that of the model as given
    assert worst(errors=errors, diagnosis={'errors': {'after': 0.05, 'worst': 0.09}}) == 0.09
    assert worst(errors=errors, diagnosis={'errors': {'after': 0.05}}) == 0.05
