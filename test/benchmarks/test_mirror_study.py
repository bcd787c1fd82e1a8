# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the study of the measured mirror rests on."""

import axes_stage as stage
import numpy as np
from piezo_ident.fitting.modes.periods import PeriodicRecord, periods_of, weighted
from piezo_ident.model.modes.shared_modes import SharedModes
import pytest
import study_mirror as study


def test_the_records_that_do_not_repeat_are_found():
    folder = study.data_folder()
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    records = study.load(folder, 'train')
    odd = [r.name for r in records if r.weight < 1]
    assert odd == ['100 mV, realisation 1', '100 mV, realisation 2']
    assert study.repeats(records)['usual'][1] < 2
    # the package finds the same periods in the records of the study
    found, v0 = periods_of([study.as_record(r) for r in records[::6]])
    assert [r.u.shape for r in found] == [(2, 8192, 3)] * 3
    np.testing.assert_allclose(found[0].u + v0, records[0].u, atol=1e-12)


def test_noise_is_that_of_one_period_of_records_that_repeat():
    rng = np.random.default_rng(2)
    records = stage.records(stage.linear_stage(), rng, (1.0,), count=3, noise=0.01)
    first = records[0]
    y = first.y + 0.1 * first.y.std() * rng.standard_normal(first.y.shape)
    records[0] = PeriodicRecord('odd', first.group, first.rate, first.u, y)
    records = weighted(records)
    found = study.repeats(records)
    assert found['noise'] == '1.0'
    assert found['periodicity'].startswith('- odd: 14')


def test_spectra_hold_the_whole_error():
    rng = np.random.default_rng(1)
    truth = stage.loop_stage()
    records = stage.records(truth, rng, (1.0,), count=2, noise=0.01)
    linear = study.of_groups({'1': SharedModes.of(stage.linear_stage())})
    found = study.spectra(records, linear)
    error = study.errors(linear, records)['1']
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
