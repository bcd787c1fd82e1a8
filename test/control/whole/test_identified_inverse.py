# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The inverse of models as they come from identification and diagnosis, and what they expect."""

from dataclasses import replace
import re

import numpy as np
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.control import linear_inverse
from piezo_ident.control.linear_inverse import smoothed
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.results import Settings
from piezo_ident.model.metrics import expected_error, worst_error
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.play import play_columns
from programs import identification_program
import pytest

CREEP = EffectSetting('creep', {'gain': [0.01, 0.02], 'time_constant': [0.05, 0.5]})
TRUTH = replace(PAPER, effects=(CREEP,))
STAGE = replace(pi.SimulatedStage.load('paper'), model=TRUTH)
HOLDS = """
limits: [0, 10]
sample_rate: 20000
slew: 100
segments:
  - {signal: idle, duration: 0.3}
  - {signal: triangle, slope: 30}
  - {signal: hold, level: 8, duration: 1.2}
  - {signal: hold, level: 2, duration: 0.6}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 20, duration: 0.5}
  - {signal: idle, duration: 0.6}
"""


@pytest.fixture(scope='module')
def record():
    text = identification_program(slew=100, steps=8, hold=0.02, cycles=4, noise=0.3, slope=100)
    program = parse_program(text)
    return STAGE.play(program, np.random.default_rng(0))


@pytest.fixture(scope='module')
def labelled(record):
    return pi.identify(record, Settings(max_order=6)).model


@pytest.fixture(scope='module')
def unlabelled(record):
    pieces = tuple(replace(piece, segments=()) for piece in record.pieces)
    settings = Settings(order=(4, 4), thresholds=6, delay=3)
    return pi.identify(replace(record, pieces=pieces), settings).model


@pytest.fixture(scope='module')
def refined(labelled):
    holds = STAGE.play(parse_program(HOLDS), np.random.default_rng(1))
    result = pi.diagnose(labelled, holds, pi.DiagnosisSettings(effects=('creep',)))
    assert [effect.name for effect in result.model.effects] == ['creep']
    return result.model


@pytest.mark.parametrize('name', ['labelled', 'unlabelled', 'refined'])
def test_an_identified_model_brings_the_stage_where_it_is_told(name, request):
    model = request.getfixturevalue(name)
    t = np.arange(4000) / FS
    soft = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.05)
    # from where nothing has crept yet
    wanted = 2e-6 + 25e-6 * soft * (1.0 - np.cos(2 * np.pi * 30 * t))
    drive = pi.invert(model, wanted)
    assert drive.error < 0.01
    # a model that knows creep tells what is left of it
    assert all(name == 'refined' and 'creeps' in warning for warning in drive.warnings)
    assert 0.0 < drive.expected < 1.0
    y = TRUTH.simulate(drive.v)[drive.lead :]
    error = 100.0 * np.sqrt(np.mean((y - wanted) ** 2)) / np.ptp(wanted)
    assert error < (3.0 if name == 'refined' else 10.0) * drive.expected
    if name == 'refined':
        assert drive.expected < 0.5 * request.getfixturevalue('labelled').inverse(wanted).expected
    header = pi.export_c(model)
    assert 'stage_feedforward_step' in header and 'stage_step' in header


def test_an_identified_model_with_a_wide_law_is_inverted_and_exported():
    rate = 400.0
    t = np.arange(1200) / rate
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * t) * (1.0 - 0.3 * np.floor(t))
    y = v + 0.06 * v**2 + play_columns(v, np.array([2.0, 5.0]), np.zeros(2)).sum(axis=0)
    y = 1e-6 * (y + 5e-3 * np.random.default_rng(0).standard_normal(v.size))
    record = pi.Record.from_arrays(v, y, sample_rate=rate)
    result = pi.identify(record, Settings(thresholds=6, max_order=2))
    assert result.hysteresis.law != 'plays'
    wanted = 1e-6 * (8.0 - 4.0 * np.cos(2.0 * np.pi * np.arange(800) / 400.0))
    drive = pi.invert(result.model, wanted)
    assert drive.error < 0.1
    reached = result.model.simulate(drive.v)[drive.lead :]
    assert 100.0 * np.sqrt(np.mean((reached - wanted) ** 2)) / np.ptp(wanted) < 0.1
    assert 'stage_feedforward_step' in pi.export_c(result.model)


def test_a_model_holds_its_error_on_the_motion_that_it_knows_least(labelled, refined):
    for model in (labelled, refined):
        assert 1.1 * expected_error(model) < worst_error(model) < 10.0 * expected_error(model)
    assert worst_error(refined) < 0.5 * worst_error(labelled)


@pytest.fixture(scope='module')
def behind_amplifier():
    """Return a stage whose amplifier lags, and the model that has the lag in its G."""
    lag = EffectSetting('amplifier_lag', {'time_constant': 8e-5})
    stage = replace(pi.SimulatedStage.load('paper'), model=replace(PAPER, effects=(lag,)))
    record = stage.play(parse_program(identification_program()), np.random.default_rng(0))
    return stage.model, pi.identify(record, Settings(max_order=10)).model


def scan(frequency, corners=0.0):
    """Return lines of a scan [m], their corners rounded over a time [s], and a rise to them."""
    t = np.arange(6000) / FS
    lines = 1 - np.abs(1 - 2 * ((frequency * t) % 1.0))
    rise = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, 2000))
    y = 1e-6 * np.concatenate([20 * rise, 20 + 40 * lines])
    return smoothed(y, 0.37 / corners, FS) if corners else y


def test_corners_of_a_scan_are_not_made_up_for_in_full(behind_amplifier, monkeypatch):
    truth, model = behind_amplifier

    def missed(wanted):
        drive = pi.invert(model, wanted)
        error = truth.simulate(drive.v)[drive.lead :] - wanted
        return 100 * np.sqrt(np.mean(error**2)) / np.ptp(wanted)

    careful = missed(scan(60.0))
    monkeypatch.setattr(linear_inverse, 'FROM_DATA', linear_inverse.EXACT)
    assert careful < 0.12
    # 0.2 % as of an exact model
    assert careful < 0.6 * missed(scan(60.0))


def test_corners_that_ring_are_told(behind_amplifier):
    _, model = behind_amplifier
    (warning,) = pi.invert(model, scan(60.0)).warnings
    assert re.match(r'\S+ % of the motion lie above \d+ Hz, where the stage rings', warning)
    assert not pi.invert(model, scan(60.0, corners=2e-3)).warnings
    # of a model that is exact nothing is unknown
    assert not pi.invert(PAPER, scan(60.0)).warnings


def test_what_is_expected_is_as_many_metres_for_small_motion(behind_amplifier):
    _, model = behind_amplifier
    soft = scan(5.0, corners=4e-3)
    large, small = (pi.invert(model, soft * part) for part in (1.0, 0.1))
    assert large.expected_rms == pytest.approx(0.01 * worst_error(model) * abs(model.scaling.Y))
    assert small.expected_rms == pytest.approx(large.expected_rms)
    assert small.expected == pytest.approx(10.0 * large.expected, rel=1e-3)
    assert large.expected * np.ptp(soft) == pytest.approx(100 * large.expected_rms, rel=1e-3)
    # a motion that stands still has no span
    still = pi.invert(model, np.full(2000, 20e-6))
    assert still.expected == pytest.approx(worst_error(model))
    assert pi.invert(PAPER, scan(5.0)).expected_rms is None


def test_a_motion_in_micrometres_taken_for_metres_is_doubted_where_it_is_refused(behind_amplifier):
    _, model = behind_amplifier
    with pytest.raises(DataError, match=r'samples .* um.* metres'):
        pi.invert(model, 1e-6 * scan(5.0) - 1e-10)


def test_a_motion_of_a_few_samples_is_inverted(behind_amplifier):
    _, model = behind_amplifier
    assert pi.invert(model, np.linspace(20e-6, 21e-6, 5), clip=True).v.size >= 5
