# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A small effect beside a large one, which moves the hysteresis by more than the small one is."""

from diagnosis_examples import played, with_effects
from piezo_ident import diagnose
from programs import slow_model

EFFECTS = {
    'creep': {'gain': [0.03, 0.025], 'time_constant': [0.1, 1.0]},
    'rate_dependent_hysteresis': {'gain': 4e-4, 'exponent': 1.0, 'cutoff': 500.0},
}


def test_both_are_named():
    result = diagnose(slow_model(), played(with_effects(**EFFECTS), 'both'))
    assert result.verdict == 'named'
    shares = {effect.name: effect.share for effect in result.effects}
    assert shares.keys() == EFFECTS.keys()
    assert 0.02 < shares['rate_dependent_hysteresis'] < 0.2
    assert result.after.overall < 0.02 * result.before.overall
