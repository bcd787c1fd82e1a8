# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One comparison: least error, effects that pay, fewest parameters among those alike."""

from types import SimpleNamespace

import numpy as np
from piezo_ident.fitting.stretch import Stretch
from piezo_ident.selection.comparison import ALIKE, best_of, EFFECT, RatedFit, shown_effect
from piezo_ident.selection.motion_kinds import interleaved, motion_kinds


def one(name, error, size=3, effects=0):
    fit = SimpleNamespace(stage=SimpleNamespace(size=size))
    return RatedFit(name, fit, error, error, effects)


def test_the_least_error_wins_and_of_those_alike_the_smaller():
    assert best_of([one('a', 1.0), one('b', 0.5)]).name == 'b'
    assert best_of([one('a', 1.0), one('b', 0.99)]).name == 'b'
    assert best_of([one('large', 1.0, 9), one('small', 0.99 * ALIKE, 2)]).name == 'small'
    assert best_of([one('large', 1.0, 9), one('small', 1.01 * ALIKE, 2)]).name == 'large'
    # both ways of holding out count
    assert RatedFit('x', None, 4.0, 1.0).error == 2.0


def test_an_effect_has_to_take_most_of_what_is_left():
    plain = one('plain', 1.0)
    assert best_of([plain, one('creep', 1.05 * EFFECT, 5, 1)]).name == 'plain'
    assert best_of([plain, one('creep', 0.9 * EFFECT / ALIKE, 5, 1)]).name == 'creep'


def test_rounding_does_not_decide():
    assert best_of([one('plays', 3e-32, 30), one('wide', 1e-32, 20)]).name == 'plays'
    assert best_of([one('plays', 3e-32, 30), one('creep', 0.0, 20, 1)]).name == 'plays'
    assert best_of([one('line', 1e-12, 3), one('plays', 1e-32, 30)]).name == 'plays'


def test_an_effect_that_helps_too_little_to_be_taken_is_shown():
    plain = one('plain', 1.0)
    little, much = one('little', 0.99 / ALIKE, 5, 1), one('hardly', 1.01 / ALIKE, 5, 1)
    assert best_of([plain, little]) is plain
    assert shown_effect([plain, little], plain) is little
    assert shown_effect([plain, much], plain) is None
    assert shown_effect([plain], plain) is None


def stretch(parts, rate=1000.0):
    u = np.concatenate(parts)
    block = np.arange(u.size) // 100
    return Stretch(u, u, np.ones(u.size, dtype=bool), block, rate)


def test_blocks_of_one_motion_are_one_kind_and_edges_are_none():
    t = np.arange(100) / 1000.0
    # the least and the most of mean, size and frequency come first
    levels = [(0.2, 0.01, 10), (0.8, 0.2, 50), (0.4, 0.05, 20), (0.5, 0.1, 30), (0.6, 0.03, 40)]
    parts = [m + a * np.sin(2 * np.pi * f * t) for m, a, f in levels * 8]
    kinds = motion_kinds([stretch(parts)], 40).reshape(8, 5)
    assert (kinds == kinds[0]).all()
    assert kinds[0, :2].tolist() == [-1, -1]
    assert len({*kinds[0, 2:], -1}) == 4


def test_one_kind_of_motion_has_no_kinds():
    t = np.arange(2000) / 1000.0
    for n in (400, 2000):
        assert motion_kinds([stretch([np.sin(2 * np.pi * 50.0 * t[:n])])], n // 100) is None
    assert set(interleaved(10)) == set(range(5))
