# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The study of tracking counts what it says: where the model is the stage, nothing is left."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.model.stage_model import EffectSetting
import study_tracking as study

BENT = replace(PAPER, effects=(EffectSetting('sensor_nonlinearity', {'square': 0.02}),))


def test_errors_are_of_the_models_that_they_name():
    # a sensor with another zero than the models know
    stage = study.Stage(
        name='bent sensor',
        play=lambda v: BENT.simulate(v) + 3e-6,
        rate=FS,
        limits=(0.0, 10.0),
        identified=PAPER,
        diagnosis=SimpleNamespace(model=BENT),
    )
    motions = dict(study.wanted_motions(stage))
    assert len(motions) == 7
    reach = np.ptp(PAPER.simulate(np.linspace(0.0, 10.0, 20_000)))
    for wanted in motions.values():
        assert not wanted[:100].any() and np.ptp(wanted) < 0.95 * reach
        assert np.abs(np.diff(wanted)).max() < 0.05 * reach
    scaled, identified, refined, learned = study.errors_of(stage, motions['50 Hz'])
    assert scaled > 2.0 > identified > 0.2
    assert refined < 0.01 and learned <= refined


def test_its_picture_has_every_stage_and_way():
    errors = np.array([5.0, 1.0, 0.1, 0.01])
    rows = [
        study.Row(stage, 'creep', 0.1, motion, 70e-6, tuple(errors * factor))
        for stage in ('one', 'two')
        for motion, factor in (('1 Hz', 1.0), ('10 Hz', 2.0))
    ]
    (axes,) = study.picture(rows).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ['one', 'two']
    assert axes.get_legend_handles_labels()[1] == list(study.HEADS)
    assert rows[0].cells()[4:6] == ['5 (3.500 µm)', '1 (700.0 nm)']
