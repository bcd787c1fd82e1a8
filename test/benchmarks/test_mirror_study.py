# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the study of the measured mirror rests on."""

import axes_stage as stage
import numpy as np
from piezo_ident.axes.explain import Rival
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.periodic import Periodicity, periodicity
import pytest
import study_mirror as study


def test_the_records_that_do_not_repeat_are_found():
    folder = study.data_folder()
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    tested = periodicity(study.load(folder, 'train'))
    assert [t.name for t in tested if t.suspicious] == [
        '100 mV, realisation 1',
        '100 mV, realisation 2',
    ]
    assert max(t.difference for t in tested if not t.suspicious) < 2


def test_noise_is_that_of_one_period_of_records_that_repeat():
    tested = [
        Periodicity('100 mV, realisation 0', 2.0, 1.0, None),
        Periodicity('100 mV, realisation 1', 8.0, 0.1, (0.0, 2000.0)),
        Periodicity('200 mV, realisation 0', 1.0, 1.0, None),
    ]
    assert study.noise_by_group(tested) == '1.4 / 0.7'


def test_spectra_hold_the_whole_error():
    rng = np.random.default_rng(1)
    truth = stage.loop_stage()
    records = stage.records(truth, rng, (1.0,), count=2, noise=0.01)
    linear = LoopModel.of(stage.linear_stage())
    found = study.spectra(records, Rival('linear', {'1': linear}, {}, 0.0))
    error = study.scores({'1': linear}, records)['1'].pooled
    # lines between the ends stand for two
    assert 100 * np.sqrt(found.sum()) == pytest.approx(error, rel=0.01)
    edges = np.array([0.0, 400.0, 3200.0])
    assert np.hypot(*study.in_bands(found, edges)) == pytest.approx(error, rel=0.01)


def test_modes_are_followed_through_the_amplitudes():
    rng = np.random.default_rng(4)
    found = study.amplitude_dependence(
        stage.linear_stage(), stage.records(stage.loop_stage(plays=0.0), rng, count=3)
    )
    assert found.groups == ('0.5', '1', '1.5')
    assert found.voltage == pytest.approx([0.5, 1.0, 1.5], rel=1e-6)
    # softening takes 4 % of the stiffness at s = 1.5 and gives it back at 0.5
    for i, frequency in enumerate((190.0, 310.0)):
        assert found.frequency[1, i] == pytest.approx(frequency, rel=0.01)
        assert (np.diff(found.frequency[:, i]) < 0).all()
