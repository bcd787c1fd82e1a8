# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Weights of causes: they sum to one, follow the errors, and leave room for none of them."""

import math

import numpy as np
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.results import UNNAMED
from piezo_ident.effects import catalogue
from piezo_ident.uncertainty.weights import _prior, FURTHER, NONE, NOTHING, weights_of
import pytest

PAIR = ('backlash', 'creep')


def level(kinds=8, none=1.0, **errors):
    """Return sets of one effect, and none, that err alike on all kinds of motion."""
    sets = {(): none, **{(name,): x for name, x in errors.items()}}
    return {effects: [x] * kinds for effects, x in sets.items()}


@pytest.mark.parametrize('kinds', [1, 3, 8])
def test_weights_sum_to_one_and_fall(kinds):
    rng = np.random.default_rng(kinds)
    errors = {(name,): rng.uniform(0.1, 1.0, kinds) for name in catalogue()}
    errors[()] = np.ones(kinds)
    weights = list(weights_of(errors).values())
    assert sum(weights) == pytest.approx(1.0)
    assert weights == sorted(weights, reverse=True) and min(weights) >= 0.0


def test_a_set_that_leaves_little_has_the_weight_and_rivals_share_it():
    alone = weights_of(level(creep=0.1, backlash=0.9))
    assert alone['creep'] > 0.99
    shared = weights_of(level(creep=0.1, backlash=0.1))
    assert shared['creep'] == pytest.approx(shared['backlash']) and shared['creep'] > 0.45


def test_without_a_difference_the_prior_of_the_whole_catalogue_stays():
    m = len(catalogue()) + len(UNNAMED)
    assert weights_of({(): [1.0] * 8}) == {NOTHING: 1.0}
    one = (1.0 - NONE) * (1.0 - FURTHER) / m
    two = one * m * FURTHER / math.comb(m, 2)
    weights = weights_of({**level(creep=1.0), PAIR: [1.0] * 8})
    assert weights['creep'] == pytest.approx(one / (NONE + one + two))
    assert weights['backlash+creep'] == pytest.approx(two / (NONE + one + two))
    # the spring with hysteresis contains a change of the mode
    wider = weights_of(level(loop_hysteresis=1.0))
    assert wider['loop_hysteresis'] == pytest.approx(two / (NONE + two))


def test_the_priors_of_all_sets_sum_to_one():
    m = len(catalogue()) + len(UNNAMED)
    some = (_prior(('creep',) * n) * math.comb(m, n) for n in range(m + 1))
    assert sum(some) == pytest.approx(1.0, abs=1e-6)


def test_a_further_effect_must_take_more():
    assert next(iter(weights_of({**level(creep=0.3), PAIR: [0.25] * 8}))) == 'creep'
    assert next(iter(weights_of({**level(creep=0.3), PAIR: [0.1] * 8}))) == 'backlash+creep'


@pytest.mark.parametrize('change', UNNAMED)
def test_a_refit_counts_as_a_change_without_a_name(change):
    errors = level(creep=0.3)
    weights = weights_of({**errors, (change,): [0.3] * 8, ('creep', change): [0.25] * 8})
    assert set(weights) == {NOTHING, 'creep'} and sum(weights.values()) == pytest.approx(1.0)
    assert weights['creep'] < 0.6 < 0.99 < weights_of(errors)['creep']


def test_more_kinds_of_motion_tell_more():
    few, many = (weights_of(level(n, creep=0.3, backlash=0.4))['creep'] for n in (3, 12))
    assert few < many


def test_a_kind_on_which_sets_err_alike_does_not_tell_them_apart():
    # the pooled mean square falls to a hundredth by one kind alone
    one = {(): [10.0] + [1.0] * 7, ('creep',): [1.0] * 8}
    assert weights_of(one)['creep'] < 0.5
    # kinds that contradict each other give a milder weight than kinds that agree
    mixed, same = [0.06, 1.5] * 4, [0.3] * 8
    apart, agreed = (weights_of({(): [1.0] * 8, ('creep',): x})['creep'] for x in (mixed, same))
    assert 0.5 < apart < agreed


def test_errors_below_the_accuracy_of_a_law_are_alike_and_those_of_zero_have_weights():
    weights = weights_of(level(creep=0.1 * SMALLEST_EFFECT, backlash=0.2 * SMALLEST_EFFECT))
    assert weights['backlash'] > 0.4
    assert sum(weights_of(level(creep=0.0)).values()) == pytest.approx(1.0)
