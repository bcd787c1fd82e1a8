# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Parts of H that run side by side."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.operators.parts import columns_of_parts, in_groups, SIDE_BY_SIDE
import pytest


@pytest.mark.parametrize('plays', [1, 2, 11])
@pytest.mark.parametrize('name', ['plays', 'square', 'bias', 'preisach', 'duhem', 'any'])
def test_each_part_is_what_it_makes_alone(name, plays):
    rng = np.random.default_rng(3)
    law = HysteresisLaw(name, np.linspace(0.05, 0.9, plays), (-0.1, 1.1))
    v = np.cumsum(rng.normal(0.0, 0.05, 2000)) % 1.0
    start = v[0] - rng.random(plays) * law.thresholds
    parts = [(h, start[own]) for h, own in law.parts(range(law.size))]
    alone = [h(v, memory) for h, memory in parts]
    assert_allclose(list(columns_of_parts(v, parts)), alone, rtol=1e-12, atol=1e-14)
    # some alone, and in another order
    some = rng.permutation(law.size)[: law.size // 2]
    found = list(columns_of_parts(v, [parts[i] for i in some]))
    assert_allclose(found, [alone[i] for i in some], rtol=1e-12, atol=1e-14)


def test_parts_of_another_form_or_state_run_apart():
    v = np.array([0.5, 0.6, 0.3, 0.9])
    play = Hysteresis([0.2], [1.0], 0.0, 0.0)
    others = [replace(play, p2=0.5), replace(play, bias=[0.3]), replace(play, curves=[[0.4]])]
    others.append(replace(play, p2=0.5, curves=[[0.4]]))
    hs = [play, *others, play, Hysteresis([0.2], [0.5], 0.0, 0.0, curves=[[0.1]])]
    parts = [(h, np.array([start])) for h in hs for start in (0.3, 0.5)]
    alone = [h(v, start) for h, start in parts]
    assert_allclose(list(columns_of_parts(v, parts)), alone, rtol=1e-12)


def test_parts_of_the_same_plays_run_together():
    law = HysteresisLaw('duhem', np.linspace(0.05, 0.9, 11))
    parts = [(h, np.zeros(int(own.sum()))) for h, own in law.parts(range(law.size))]
    groups = list(in_groups(parts))
    assert [part for group in groups for part in group] == parts
    curved = [group for group in groups if group[0][0].curves is not None]
    assert [len(group) for group in curved] == [SIDE_BY_SIDE] * 5
    for group in groups:
        assert all(np.array_equal(h.thresholds, group[0][0].thresholds) for h, _ in group)


def test_lags_begin_where_the_stage_rested():
    v = np.array([0.5, 0.6, 0.3, 0.9])
    lags = [[2.0, 1.0, 0.0, 0.0], [2.0, 0.0, 1.0, 0.0], [4.0, 0.0, 0.0, 1.0]]
    hs = [Hysteresis([], [], 0.0, 0.0, relaxations=[row]) for row in lags]
    found = list(columns_of_parts(v, [(h, np.zeros(0)) for h in hs], rest=0.8))
    assert_allclose(found, [h.follow(v, h.settled(0.8))[0] for h in hs], rtol=1e-12)
    assert abs(found[0][0] - hs[0](v)[0]) > 0.01
