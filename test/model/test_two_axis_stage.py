# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated stage of two axes does what its equations say."""

from dataclasses import replace
import itertools
from pathlib import Path

import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import load_yaml
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.two_axis_stage import load_stage, two_axis_stage_from_dict
import pytest

STAGE = replace(pi.TwoAxisStage.load('two_axes'), noise_rms=0.0)
LINEAR = replace(STAGE, hysteresis=(0.0, 0.4, 10.0), creep_gain=np.zeros(2))
SHAPE = STAGE.shape


def response(stage, v):
    return stage.run(np.random.default_rng(0)).process(v)


def test_a_stream_gives_the_bits_of_the_whole_wherever_it_is_cut():
    v = np.random.default_rng(1).uniform(0, 10, (3000, 2))
    stage = replace(STAGE, noise_rms=1e-9)
    run = stage.run(np.random.default_rng(2))
    whole = stage.run(np.random.default_rng(2)).process(v)
    cuts = (0, 1, 60, 61, 1500, 3000)
    parts = [run.process(v[a:b]) for a, b in itertools.pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_both_axes_pull_at_one_another_and_a_reading_comes_before_its_command():
    v = np.zeros((4000, 2))
    v[10:, 0] = 1.0
    y = response(LINEAR, v)
    assert not y[:11].any() and y[11].any()
    # at rest the modes add up to Phi^T Phi
    np.testing.assert_allclose(y[-1], LINEAR.gain * (SHAPE.T @ SHAPE)[0], rtol=1e-6)


def test_one_axis_creeps():
    v = np.ones((8000, 2))
    early, late = (response(replace(STAGE, hysteresis=(0.0, 0.4, 1.0)), v)[k] for k in (900, -1))
    crept = (late - early) / STAGE.gain
    assert abs(crept[0]) < 1e-6
    assert crept[1] == pytest.approx(0.01 * np.exp(-0.9), rel=0.02)


def test_gain_grows_and_resonance_falls_with_the_amplitude_and_loops_stay_open():
    t = np.arange(4000) / STAGE.sample_rate
    gains, lags = [], []
    for amplitude in (0.5, 2.0, 4.0):
        v = np.zeros((t.size, 2))
        v[:, 0] = amplitude * np.sin(2 * np.pi * 5.0 * t)
        y = response(replace(STAGE, creep_gain=np.zeros(2)), v)[2000:, 0]
        line = 2 * np.mean(y * np.exp(-2j * np.pi * 5.0 * t[2000:])) * 1j
        linear = response(LINEAR, v)[2000:, 0]
        line /= 2 * np.mean(linear * np.exp(-2j * np.pi * 5.0 * t[2000:])) * 1j
        gains.append(abs(line) - 1)
        lags.append(-np.angle(line))
    # in proportion to the amplitude, as Rayleigh's law has it
    assert gains[0] < gains[1] < gains[2]
    assert lags[1] / lags[0] == pytest.approx(4.0, rel=0.15)
    assert lags[2] / lags[1] == pytest.approx(2.0, rel=0.15)


def test_a_record_holds_both_axes_with_signals_of_their_own():
    program = pi.Program.load('two_axes')
    record = STAGE.play(replace(program, entries=program.entries[:1]))
    axes = pi.Axes.of(record.pieces[0])
    assert (axes.input_names, axes.output_names) == (('v', 'v_b'), ('y', 'y_b'))
    for segment in record.pieces[0].find('multisine'):
        u = axes.inputs[segment.start : segment.stop].reshape(3, 2048, 2)
        assert np.ptp(u, axis=0).max() < 1e-12
        assert abs(np.corrcoef(u[0].T)[0, 1]) < 0.1


@pytest.mark.parametrize(
    ('key', 'value', 'said'),
    [
        ('axes', ['a', 'b'], r"axes = \['a', 'b'\]"),
        (
            'modes',
            {'frequency': [1, 2], 'damping': [1, 2], 'shape': [[1, 1], [1, 1]]},
            'rows of shape',
        ),
        ('hysteresis', {'share': 1.5, 'field': 0, 'scale': 1}, 'share < 1'),
        ('sample_rate', 400, r'sample_rate = 400 Hz .*\d Hz,'),
        ('creep', {'axis': 'c', 'gain': [], 'time_constant': []}, r"creep.axis = 'c'"),
        ('colour', 1, 'keys colour'),
        ('gain', float('nan'), ': gain '),
        ('noise_rms', float('nan'), ': noise_rms '),
        ('seed', float('nan'), 'seed .*nan'),
        ('seed', 1.5, r'seed .*1\.5'),
    ],
)
def test_numbers_that_no_stage_has_are_refused(key, value, said):
    data = load_yaml(find_config('two_axes', 'stage'))
    with pytest.raises(ConfigError, match=said):
        two_axis_stage_from_dict({**data, key: value})


def test_either_kind_of_stage_is_loaded_and_shapes_are_checked():
    assert isinstance(load_stage('paper'), SimulatedStage)
    assert load_stage('two_axes').axes == ('', 'b')
    with pytest.raises(DataError, match=r'\(5,\).*\(n, 2\)'):
        response(STAGE, np.zeros(5))


def test_the_verb_writes_both_axes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('p.yaml').write_text(
        'limits: [0, 10]\nsegments:\n  - {signal: noise, bias: 5, amplitude: 1, cutoff: 500, '
        'duration: 0.5}\n'
    )
    main(['simulate', '--config', 'two_axes', '--program', 'p.yaml', 'r.csv'])
    axes = pi.Axes.of(pi.read('r.csv').pieces[0])
    assert axes.outputs.shape[1] == 2 and axes.sample_rate == pytest.approx(2000.0)
