# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A quick part of the study of any record: short records, the best peer, and the inverse."""

from dataclasses import replace
import warnings

import any_record as study
import bouc_wen
import numpy as np
from paper_stage import with_mode
from piezo_ident.identification.results import Settings
from piezo_ident.operators.dynamics import Dynamics
import pytest
from scipy.signal import butter, sosfiltfilt

SECONDS = 0.6


@pytest.fixture(scope='module')
def identified():
    """Return case and model of records that differ in kind and in law."""
    cases = (('preisach', 'noise, small'), ('duhem', 'triangles'))
    drawn = [study.draw(law, kind, 3, SECONDS) for law, kind in cases]
    return [(case, study.program(case.fit)) for case in drawn]


def test_no_peer_errs_clearly_less(identified):
    for case, model in identified:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', UserWarning)
            own = study.percent(model.simulate, case.judge)
            peers = [study.percent(peer(case.fit), case.judge) for peer in study.PEERS]
        assert own <= 1.05 * min(peers), case.kind


@pytest.fixture(scope='module')
def quick():
    """Return models of further kinds of record, of half a second and a low order."""
    kinds = (
        ('turning-curves', 'sine'),
        ('preisach', 'growing sine'),
        ('bouc-wen', 'random binary'),
    )
    few = Settings(max_order=2, thresholds=10)
    drawn = [study.draw(law, kind, 3, 0.5) for law, kind in kinds]
    return [(case, study.program(case.fit, few)) for case in drawn]


@pytest.mark.parametrize('seed', range(3))
def test_H_rises_and_the_inverse_asks_for_no_jump(identified, quick, seed):
    for case, model in identified + quick:
        assert study.drive_fault(model, np.random.default_rng(seed)) == '', case.kind


def test_a_bad_model_is_a_fault():
    rng, sound = np.random.default_rng(0), with_mode(300.0)
    h = sound.hysteresis
    falls = replace(h, p2=h.p2 - h.lowest_slope() - 1e-3)
    assert study.drive_fault(sound, rng) == ''
    assert study.drive_fault(replace(sound, hysteresis=falls), rng) == 'H falls'
    # lags at 100 and at 30 Hz, which a motion of up to 200 Hz has the drive make up for
    for pole, words in ((0.97, 'drive 1'), (0.99, 'refuses: ')):
        lag = Dynamics([-pole], [1.0 - pole])
        fault = study.drive_fault(replace(sound, dynamics=lag), np.random.default_rng(0))
        assert fault.startswith(words), fault


def test_a_slow_motion_holds_nothing_fast_with_its_ends():
    model = study.pi.SimulatedStage.load('paper').model
    wanted = study.slow_motion(model, np.random.default_rng(0))
    rests = np.pad(wanted, wanted.size, mode='edge')
    step = 1e-3 * np.ptp(wanted)
    mode = min(m.frequency for m in model.dynamics.modes(model.sample_rate))
    sos = butter(4, mode, 'highpass', fs=model.sample_rate, output='sos')
    assert np.abs(sosfiltfilt(sos, rests - rests[0])).max() < step
    # with a corner at its beginning the drive has to jump
    late = wanted[np.argmax(np.diff(wanted)) :]
    drives = [np.abs(np.diff(model.inverse(y).v)).max() for y in (wanted, late)]
    assert drives[1] > 2.0 * drives[0]


def test_the_bouc_wen_spring_is_that_of_the_benchmark():
    u, y = bouc_wen.records(1)['multisine']
    # published: 50 N rms make 0.67 mm rms
    assert u.std() == pytest.approx(50.0, rel=0.01)
    assert y[bouc_wen.PERIOD :].std() == pytest.approx(6.7e-4, rel=0.05)
