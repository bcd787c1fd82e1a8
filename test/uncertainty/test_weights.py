# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Weights of causes: they sum to one, follow the errors, and leave room for none of them."""

import numpy as np
from piezo_ident.effects import catalogue
from piezo_ident.uncertainty.weights import NONE, NOTHING, weights_of
import pytest


@pytest.mark.parametrize('kinds', [0, 3, 8])
def test_weights_sum_to_one_and_fall(kinds):
    rng = np.random.default_rng(kinds)
    errors = {(name,): x for name, x in zip(catalogue(), rng.uniform(0.1, 1.0, 9), strict=False)}
    errors[()] = 1.0
    weights = list(weights_of(errors, kinds).values())
    assert sum(weights) == pytest.approx(1.0)
    assert weights == sorted(weights, reverse=True) and min(weights) >= 0.0


def test_a_set_that_leaves_little_has_the_weight_and_rivals_share_it():
    alone = weights_of({(): 1.0, ('creep',): 0.1, ('backlash',): 0.9}, 8)
    assert alone['creep'] > 0.99
    shared = weights_of({(): 1.0, ('creep',): 0.1, ('backlash',): 0.1}, 8)
    assert shared['creep'] == shared['backlash'] == pytest.approx(0.5, abs=0.01)


def test_effects_that_take_nothing_leave_it_to_none_of_these():
    pair = ('backlash', 'creep')
    weights = weights_of({(): 1.0, ('creep',): 0.98, ('backlash',): 0.99, pair: 0.97}, 8)
    assert weights[NOTHING] > 0.9
    # without a difference and without data the prior stays
    assert weights_of({(): 1.0}, 8) == {NOTHING: 1.0}
    level = {(): 1.0, ('creep',): np.sqrt(0.4), ('backlash',): np.sqrt(0.4)}
    assert weights_of(level, 8)[NOTHING] == pytest.approx(NONE)


def test_a_further_or_a_wider_effect_must_take_as_much_again():
    pair = ('backlash', 'creep')
    errors = {(): 1.0, ('creep',): 0.3, pair: 0.25}
    assert next(iter(weights_of(errors, 8))) == 'creep'
    assert next(iter(weights_of({**errors, pair: 0.1}, 8))) == 'backlash+creep'
    # the spring with hysteresis contains a change of the mode
    errors = {(): 1.0, ('changed_dynamics',): 0.3, ('loop_hysteresis',): 0.25}
    assert next(iter(weights_of(errors, 8))) == 'changed_dynamics'
    errors['loop_hysteresis',] = 0.1
    assert next(iter(weights_of(errors, 8))) == 'loop_hysteresis'


def test_more_kinds_of_motion_tell_more():
    errors = {(): 1.0, ('creep',): 0.3, ('backlash',): 0.4}
    few, many = (weights_of(errors, n)['creep'] for n in (3, 12))
    assert few < many


def test_errors_of_zero_have_weights():
    assert sum(weights_of({(): 0.0, ('creep',): 0.0}, 8).values()) == pytest.approx(1.0)
    assert weights_of({}, 8) == {}
