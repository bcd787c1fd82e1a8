# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The law of H that stays, from what each leaves of data that were not fitted."""

from types import SimpleNamespace

import numpy as np
from piezo_ident.diagnosis import base_refit
import pytest


def fit(name, left, in_sample=0.0):
    """Return a fit that leaves so much of held-out blocks and kinds, and of what was fitted."""
    square = np.array([left**2])
    return SimpleNamespace(
        name=name, errors=square, transfer=square, e=np.array([in_sample]), state=None
    )


@pytest.mark.parametrize(
    ('plays', 'between', 'widest', 'kept'),
    [
        (1.0, 0.95, 0.92, 'plays'),
        (1.0, 0.80, 0.75, 'between'),
        (1.0, 0.80, 0.60, 'widest'),
        # lags along the path do worse under other motion than the law without them
        (1.0, 0.85, 0.95, 'between'),
        (1.0, 0.95, 0.88, 'between'),
        (1.0, 1.20, 0.88, 'widest'),
    ],
)
def test_the_narrowest_law_that_no_wider_one_beats_stays(
    monkeypatch, plays, between, widest, kept
):
    monkeypatch.setattr(base_refit, 'refit_of', lambda *_: fit('between', between))
    chosen = base_refit._narrowest(None, fit('plays', plays), fit('widest', widest))
    assert chosen.name == kept


def test_a_law_that_cannot_win_is_not_fitted():
    # the widest law fits these data no better than plays predict them
    wide = fit('widest', 1.1, in_sample=0.95)
    assert base_refit._narrowest(None, fit('plays', 1.0), wide).name == 'plays'
