# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The page on stages that change counts what it says."""

from dataclasses import replace

import numpy as np
from paper_stage import PAPER
from piezo_ident.model.observer import HORIZON
import pytest
import stays_right as study
from truths.linear import RATE


def test_what_a_lab_does_today_subtracts_the_mean_of_the_last_second():
    n = round(4 * RATE)
    free = np.sin(np.arange(n) / 300.0)
    off = np.where(np.arange(n) < n // 2, 1.0, 3.0)
    late = np.concatenate([np.full(HORIZON, np.nan), free + off])[:n]
    late[round(3.5 * RATE) :] = np.nan
    added = study.last_second(free, late) - free
    assert added[:HORIZON].max() == 0.0
    assert added[n // 2] == pytest.approx(1.0)
    assert added[n // 2 + HORIZON + round(0.5 * RATE)] == pytest.approx(2.0, abs=1e-3)
    # it stays when the sensor is cut off
    assert added[-1] == pytest.approx(3.0)


@pytest.mark.parametrize('change', study.CHANGES[1:])
def test_each_change_begins_when_it_is_said_to(change, monkeypatch):
    for name, value in {'AT': 0.8, 'CUT': 1.0, 'HORIZONS': (0.1, 0.2)}.items():
        monkeypatch.setattr(study, name, value)
    stage = study.make_stage('creep', 1.0, study.SEEDS[0])
    same = study.case_of(stage, 'nothing').y
    off = study.case_of(stage, change).y - same
    at = round(study.AT * RATE)
    assert not off[:at].any() and np.abs(off[at:]).max() > 1e-8


def test_a_model_that_is_the_stage_errs_by_what_changed_alone(monkeypatch):
    for name, value in {'AT': 2.5, 'JUDGED': 1.0, 'CUT': 9.5, 'HORIZONS': (0.2, 0.5)}.items():
        monkeypatch.setattr(study, name, value)
    model = replace(PAPER, identification={'errors': {'held_out': 0.01}})

    class Same:
        base = None

        def respond(self, t, v, clean):
            return model.simulate(v)

    row = study.judged('paper', Same(), model, 'gain step')
    assert row.before[0] == 0.0 and max(row.before[2:]) < 0.01
    ignored, subtracted, _, *followed = row.after
    assert ignored > 2.0 > subtracted > 0.5
    assert len(followed) == 3 and max(followed) < 0.02
    rows = [replace(row, change=change) for change in study.CHANGES]
    page = study.page(rows)
    assert all(page.count(change) >= 5 for change in study.CHANGES)
    (axes,) = study.picture(rows).axes
    assert axes.get_legend_handles_labels()[1] == list(study.HEADS)
