# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a verdict says beside the names: how much was judged, and what would part look-alikes."""

from types import SimpleNamespace

import numpy as np
from piezo_ident.diagnosis.messages import part_judged
from piezo_ident.diagnosis.next_experiment import LOOK_ALIKES, separating_experiment
from piezo_ident.effects import catalogue, find_effect
import pytest


def test_how_much_was_judged_is_said():
    run = SimpleNamespace(piece=SimpleNamespace(n=1000, sample_rate=100.0))
    keep = np.arange(200) >= 120
    (said,) = part_judged(SimpleNamespace(m=5, runs=(run,), keep=(keep,)))
    assert said.startswith('4 of 10 s were judged')
    assert part_judged(SimpleNamespace(m=5, runs=(run,), keep=(keep | True,))) == []


@pytest.mark.parametrize('group', LOOK_ALIKES)
def test_look_alikes_come_with_an_experiment(group):
    assert set(group) <= set(catalogue())
    assert len(separating_experiment(group)) > 20
    assert separating_experiment(group[:2]) == separating_experiment(group[1::-1])


def test_a_pair_that_no_rule_speaks_of_says_what_each_needs():
    pair = ('cross_coupling', 'slew_limit')
    assert separating_experiment(pair) == '; and '.join(find_effect(name).needs for name in pair)
