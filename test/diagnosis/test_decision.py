# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The decision, on made-up errors of blocks: what is admissible, taken, and a class."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.decision import Candidates, decide, FittedSet
from piezo_ident.diagnosis.verdict import _hidden
import pytest

N, NOISE = 4000, 1e-8
#: mean square of 1 % of stroke
WHOLE = 1e-4


def fit(left, kinds=None, size=3, retuning=(), name='creep'):
    """Return a fit that leaves these mean squares beyond the noise, of blocks and of kinds."""
    blocks, kinds = (np.array([N * (x + NOISE)]) for x in (left, left if kinds is None else kinds))
    return SimpleNamespace(
        errors=blocks,
        transfer=kinds,
        mean_square=blocks.sum() / N,
        parameters=(None,) * size,
        state=SimpleNamespace(retuning=retuning),
        name=name,
    )


def found(*names, left, way='wide', chance=0.0, before=WHOLE, **how):
    this = SimpleNamespace(before=fit(before), chance={names[-1]: chance})
    own = fit(left, name=names[-1], **how)
    return FittedSet(tuple(sorted(names)), way, own, this)


def without(left=WHOLE, way='wide', **how):
    return FittedSet((), way, fit(left, **how))


@pytest.fixture
def given():
    """Return what the model leaves as given and refitted, on a stroke of one."""
    rows = SimpleNamespace(
        n=N,
        passes=9.0,
        kinds=('sine', 'steps'),
        percent=lambda square: 100.0 * np.sqrt(max(square, 0.0)),
        square=lambda size: (size / 100.0) ** 2,
    )
    return Candidates(rows, NOISE, 0.0, (without(2.0 * WHOLE, 'given'), without()))


def taken(candidates):
    best = decide(candidates).best
    return () if best is None else best.effects


@pytest.mark.parametrize(('share', 'names'), [(0.39, ('creep',)), (0.41, ())])
def test_an_effect_takes_most_of_what_the_best_h_leaves(given, share, names):
    assert taken(given.and_these([found('creep', left=share * WHOLE)])) == names


def test_blocks_and_kinds_of_motion_count_alike_but_kinds_alone_beside_another_effect(given):
    own = found('creep', left=0.1 * WHOLE, kinds=1.5 * WHOLE)
    assert given.left(own) == pytest.approx(np.sqrt(0.15) * WHOLE, rel=1e-2)
    assert taken(given.and_these([own])) == ('creep',)
    assert taken(given.and_these([replace(own, fitted=fit(0.1 * WHOLE, 2.0 * WHOLE))])) == ()
    one = given.and_these([found('creep', left=0.3 * WHOLE)])
    kinds = found('creep', 'backlash', left=0.15 * WHOLE, kinds=0.05 * WHOLE)
    assert taken(one.and_these([kinds])) == ('creep',)


def test_it_is_larger_than_the_smallest_effect(given):
    least = given.rows.square(criteria.SMALLEST_EFFECT)
    small = replace(given, all=(without(1.2 * least, 'given'), without(0.9 * least)))
    assert taken(small.and_these([found('creep', left=0.1 * least)])) == ('creep',)
    assert taken(small.and_these([found('creep', left=0.25 * least)])) == ()


def test_each_of_a_pair_takes_most_of_the_rest_also_where_no_single_one_does(given):
    one = given.and_these([found('creep', left=0.3 * WHOLE), found('backlash', left=0.9 * WHOLE)])
    assert taken(one.and_these([found('creep', 'backlash', left=0.13 * WHOLE)])) == ('creep',)
    both = one.and_these([found('creep', 'backlash', left=0.11 * WHOLE)])
    assert taken(both) == ('backlash', 'creep')
    alone = [found('creep', left=0.6 * WHOLE), found('backlash', left=0.7 * WHOLE)]
    assert taken(given.and_these(alone)) == ()
    both = [*alone, found('creep', 'backlash', left=0.1 * WHOLE)]
    assert taken(given.and_these(both)) == ('backlash', 'creep')


def test_of_those_alike_the_one_with_fewest_parameters_is_taken(given):
    rich = found('creep', left=0.02 * WHOLE, size=9)
    for left, name in ((0.025, 'backlash'), (0.03, 'creep')):
        both = given.and_these([rich, found('backlash', left=left * WHOLE, size=1)])
        assert taken(both) == (name,)


@pytest.mark.parametrize(('times', 'names'), [(1.5, ('creep', 'thermal_drift')), (1.7, ())])
def test_what_leaves_hardly_more_is_a_rival(given, times, names):
    some = [found('creep', left=0.02 * WHOLE), found('thermal_drift', left=times * 0.02 * WHOLE)]
    assert decide(given.and_these(some)).names == names


def test_what_all_rivals_have_is_no_class(given):
    pairs = [
        found('creep', 'backlash', left=0.01 * WHOLE),
        found('creep', 'saturation', left=0.012 * WHOLE),
    ]
    assert decide(given.and_these(pairs)).names == ('backlash', 'saturation')


def test_a_retuned_g_is_a_change_of_g(given):
    # it does what a change of the delay does, and takes nothing from another effect
    some = given.and_these(
        [
            without(0.05 * WHOLE, retuning=(0.1,)),
            found('delay_change', left=0.04 * WHOLE),
            found('backlash', left=0.04 * WHOLE, retuning=(0.1,)),
        ]
    )
    assert taken(some) == ('delay_change',)
    assert decide(some).names == ()


@pytest.mark.parametrize(('missed', 'names'), [(0.9, ('delay_change',)), (1.0, ())])
def test_a_change_of_g_exceeds_what_g_missed_before(given, missed, names):
    # of 1 % it takes all but a hundredth of the square
    some = replace(given, missed=missed).and_these([found('delay_change', left=0.01 * WHOLE)])
    assert taken(some) == names


def test_a_branch_that_was_passed_once_and_what_gains_as_much_on_surrogates_name_nothing(given):
    once = SimpleNamespace(**{**vars(given.rows), 'passes': 2.0})
    assert taken(replace(given, rows=once).and_these([found('creep', left=0.0)])) == ()
    assert taken(given.and_these([found('backlash', left=0.1 * WHOLE, chance=0.7 * WHOLE)])) == ()
    # a drift fits a shifted residual as well
    drift = found('thermal_drift', left=0.1 * WHOLE, chance=0.7 * WHOLE)
    assert taken(given.and_these([drift])) == ('thermal_drift',)


def beside_given(name, left):
    return found(name, left=left, way='given')


def test_what_has_set_in_since_does_most_of_what_a_refit_does(given):
    # the refit leaves 1, the model as given 2
    assert taken(given.and_these([beside_given('backlash', 1.39 * WHOLE)])) == ('backlash',)
    assert taken(given.and_these([beside_given('backlash', 1.41 * WHOLE)])) == ()
    assert decide(given.and_these([beside_given('backlash', 1.2 * WHOLE)])).set_in
    # what goes with the speed is told beside the refit
    assert taken(given.and_these([beside_given('creep', 1.1 * WHOLE)])) == ()
    # what a material has, too
    some = [beside_given('noncongruent_minor_loops', 1.1 * WHOLE)]
    assert taken(given.and_these([*some, beside_given('backlash', 1.2 * WHOLE)])) == ()


def test_without_labels_nothing_is_said_to_have_set_in(given):
    some = given.and_these([beside_given('backlash', 1.1 * WHOLE)])
    unlabelled = SimpleNamespace(**{**vars(given.rows), 'kinds': ()})
    assert taken(replace(some, rows=unlabelled)) == ()
    assert [c.effects for c in some.like_refit()] == [('backlash',)]


def test_others_that_have_set_in_are_rivals(given):
    some = [beside_given('backlash', 0.8 * WHOLE), beside_given('saturation', 1.2 * WHOLE)]
    assert decide(given.and_these(some)).names == ('backlash', 'saturation')
    # an effect beside a retuned G is no rival of itself
    retuned = found('backlash', left=1.2 * WHOLE, way='given', retuning=(0.1,))
    both = given.and_these([some[0], retuned])
    assert decide(both).names == ()
    assert _hidden(both).names == ('backlash', 'saturation')


@pytest.mark.parametrize(('left', 'is_class'), [(0.2, True), (0.01, False)])
def test_what_takes_most_of_a_part_is_not_told_from_it(given, left, is_class):
    # the one leaves a part, or little; the other takes three quarters of what the one takes
    one, other = left * WHOLE, (1.0 - 0.75 * (1.0 - left)) * WHOLE
    both = given.and_these([found('creep', left=one), found('gain_drift', left=other)])
    decision = decide(both)
    assert decision.best.effects == ('creep',)
    assert decision.names == (('creep', 'gain_drift') if is_class else ())
