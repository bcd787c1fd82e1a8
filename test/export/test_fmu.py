# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The FMU is valid, and what FMPy compiles and runs of it is what Python predicts."""

from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys

from c_compiler import needs_compiler
from effect_table import VISIBLE
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.model.stage_model import EffectSetting
import pytest
from random_models import random_modes_model, random_voltages

fmpy = pytest.importorskip('fmpy', reason='FMPy is not installed (extra fmu)')

NAMES = ('creep', 'rate_dependent_hysteresis', 'cross_coupling', 'thermal_drift')
MODEL = replace(PAPER, effects=tuple(EffectSetting(name, VISIBLE[name]) for name in NAMES))
TIME, DISPLACEMENT, VOLTAGE, OTHER = range(4)
#: the second axis also moves by a share of the first, with all effects of the first
PATH = {'channel': 'motion', 'gain': 0.02 / PAPER.scaling.Y, 'frequency': 1000.0}
SECOND = replace(
    PAPER,
    effects=(EffectSetting('cross_coupling', PATH),),
    scaling=replace(PAPER.scaling, range=(1.0, 10.0)),
)
CHAINS = pi.MultiAxisModel({'y': MODEL, 'y_b': SECOND})


def test_it_is_valid_and_the_same_each_time(tmp_path):
    from fmpy.validation import validate_fmu

    one, two = tmp_path / 'one.fmu', tmp_path / 'two.fmu'
    pi.export_fmu(MODEL, one)
    pi.export_fmu(MODEL, two)
    assert validate_fmu(str(one)) == []
    assert one.read_bytes() == two.read_bytes()
    about = fmpy.read_model_description(str(one))
    assert [(x.name, x.causality, x.unit) for x in about.modelVariables] == [
        ('time', 'independent', 's'),
        ('displacement', 'output', 'm'),
        ('voltage', 'input', 'V'),
        ('x_other_axis', 'input', None),
    ]
    assert float(about.coSimulation.fixedInternalStepSize) == 1.0 / FS
    pi.export_fmu(PAPER, two)
    other = fmpy.read_model_description(str(two))
    assert other.instantiationToken != about.instantiationToken


def compiled(model, folder):
    """Export a model, let FMPy compile the FMU, and return the folder of its files."""
    path = folder / 'stage.fmu'
    pi.export_fmu(model, path)
    command = [sys.executable, '-m', 'fmpy', 'compile', '--all-warnings', '--warning-as-error']
    # cmake is installed beside this interpreter
    env = {**os.environ, 'PATH': f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'}
    done = subprocess.run([*command, str(path)], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return fmpy.extract(str(path), unzipdir=str(folder / 'unzipped'))


def begun(folder, numbers, values, token='', time=0.0):
    """Start an FMU under inputs, which have these numbers."""
    from fmpy.fmi3 import FMU3Slave

    fmu = FMU3Slave(
        guid=token or fmpy.read_model_description(folder).instantiationToken,
        unzipDirectory=folder,
        modelIdentifier='stage',
        instanceName='one',
    )
    fmu.instantiate()
    fmu.enterInitializationMode(startTime=time)
    fmu.setFloat64(numbers, values)
    fmu.exitInitializationMode()
    return fmu


def test_a_channel_may_have_any_name(tmp_path):
    values = {**VISIBLE['cross_coupling'], 'channel': 'heat <"a" & b>'}
    model = replace(PAPER, effects=(EffectSetting('cross_coupling', values),))
    pi.export_fmu(model, tmp_path / 'stage.fmu')
    about = fmpy.read_model_description(str(tmp_path / 'stage.fmu'))
    assert about.modelVariables[-1].name == 'x_heat <"a" & b>'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return compiled(MODEL, tmp_path_factory.mktemp('fmu'))


@pytest.fixture
def start(folder):
    """Return what starts the FMU under inputs."""
    return lambda *values, **options: begun(folder, [VOLTAGE, OTHER], values, **options)


def displacement(fmu):
    return fmu.getFloat64([DISPLACEMENT])[0]


@needs_compiler
def test_it_predicts_what_python_does_and_goes_back(start):
    rng = np.random.default_rng(3)
    v = np.clip(5.0 + np.cumsum(rng.standard_normal(2000)), 0.0, 10.0)
    other = np.cumsum(rng.standard_normal(v.size)) / 20.0
    expected = MODEL.simulate(v, channels={'other_axis': other})
    fmu = start(v[0], other[0])
    y, saved, k = [displacement(fmu)], None, 1
    while k < v.size:
        fmu.doStep((k - 1) / FS, 1.0 / FS)
        fmu.setFloat64([VOLTAGE, OTHER], [v[k], other[k]])
        y.append(displacement(fmu))
        k += 1
        if k == 1000:
            saved = fmu.serializeFMUState(fmu.getFMUState())
    assert_allclose(y, expected, rtol=0, atol=1e-12 * np.ptp(expected))
    fmu.setFMUState(fmu.deserializeFMUState(saved))
    assert displacement(fmu) == y[999]
    fmu.terminate()
    fmu.freeInstance()


@needs_compiler
def test_steps_of_any_size_take_the_samples_that_are_due(start):
    v = np.full(301, 2.0)
    v[1:] = 7.0
    expected = MODEL.simulate(v, channels={'other_axis': np.zeros(v.size)})
    fmu = start(2.0, 0.0)
    fmu.doStep(0.0, 1.0 / FS)
    fmu.setFloat64([VOLTAGE], [7.0])
    edges = np.append(np.sort(np.random.default_rng(1).uniform(1.0, 300.0, 50)), 300.0) / FS
    for before, after in zip(np.append(1.0 / FS, edges), edges, strict=False):
        fmu.doStep(before, after - before)
        k = int(np.floor(after * FS + 1e-6))
        assert abs(displacement(fmu) - expected[k]) < 1e-12 * np.ptp(expected)
    assert fmu.getFloat64([TIME])[0] == pytest.approx(300.0 / FS)


@needs_compiler
def test_what_is_no_number_or_another_model_is_refused(start):
    fmu = start(2.0, 0.0)
    for bad in ([VOLTAGE], [np.nan]), ([DISPLACEMENT], [0.0]), ([9], [0.0]):
        with pytest.raises(Exception, match='fmi3SetFloat64'):
            fmu.setFloat64(*bad)
    with pytest.raises(Exception, match='instantiate'):
        start(2.0, 0.0, token='another')


@needs_compiler
def test_fmpy_simulates_it(folder):
    result = fmpy.simulate_fmu(folder, stop_time=0.01, start_values={'voltage': 4.0})
    still, none = np.full(len(result), 4.0), np.zeros(len(result))
    expected = MODEL.simulate(still, channels={'other_axis': none})
    assert len(result) > 100
    assert_allclose(result['displacement'], expected, rtol=1e-9)


def played(fmu, numbers, inputs, outputs, time=0.0):
    """Return what an FMU answers to inputs, shape (samples, inputs)."""
    answers = [fmu.getFloat64(outputs)]
    for k, row in enumerate(inputs[1:]):
        fmu.doStep(time + k / FS, 1.0 / FS)
        fmu.setFloat64(numbers, row)
        answers.append(fmu.getFloat64(outputs))
    return np.array(answers)


@pytest.fixture(scope='module')
def chains(tmp_path_factory):
    return compiled(CHAINS, tmp_path_factory.mktemp('chains'))


@needs_compiler
def test_variables_have_the_names_of_their_axes(chains):
    from fmpy.validation import validate_fmu

    assert validate_fmu(chains) == []
    about = fmpy.read_model_description(chains)
    assert [x.name for x in about.modelVariables] == [
        *('time', 'displacement', 'displacement_b', 'voltage', 'voltage_b', 'x_other_axis')
    ]
    assert [x.variable.name for x in about.outputs] == ['displacement', 'displacement_b']
    still = fmpy.simulate_fmu(chains, stop_time=0.01, start_values={'voltage': 4.0})
    # a voltage that nobody sets is the lowest of the axis
    one = np.ones(len(still))
    y = CHAINS.simulate({'v': 4.0 * one, 'v_b': one}, channels={'other_axis': 0.0 * one})
    for axis, name in (('y', 'displacement'), ('y_b', 'displacement_b')):
        assert_allclose(still[name], y[axis], rtol=1e-9)


@needs_compiler
def test_chains_of_several_axes_feel_one_another_from_any_time_on(chains):
    rng, time = np.random.default_rng(5), 3.0
    v = np.clip(5.0 + np.cumsum(rng.standard_normal((2000, 2)), axis=0), 0.0, 10.0)
    other = np.cumsum(rng.standard_normal(len(v))) / 20.0
    t = time + np.arange(len(v)) / FS
    # drift follows the time of the simulation
    first = MODEL.stream().process(v[:, 0], t, {'other_axis': other})
    second = SECOND.stream().process(v[:, 1], t, {'motion': first})
    inputs = np.column_stack([v, other])
    fmu = begun(chains, [3, 4, 5], inputs[0], time=time)
    y = played(fmu, [3, 4, 5], inputs, [1, 2], time)
    assert_allclose(y, np.column_stack([first, second]), rtol=0, atol=1e-12 * np.ptp(first))
    first = MODEL.stream().process(v[:, 0], t - time, {'other_axis': other})
    assert np.abs(first - y[:, 0]).max() > 1e-3 * np.ptp(first)


@needs_compiler
def test_shared_modes_are_those_of_python_to_the_last_bit(tmp_path):
    rng = np.random.default_rng(6)
    made = random_modes_model(rng, creeps=True)
    # the order of the axes is not that of the alphabet
    model = pi.MultiAxisModel(dict(zip(('y_b', 'y'), made.axes.values(), strict=True)), made.modes)
    v = random_voltages(rng, model.modes, 2000)
    y = model.simulate({'v_b': v[:, 0], 'v': v[:, 1]})
    folder = compiled(model, tmp_path)
    about = fmpy.read_model_description(folder)
    assert [x.name for x in about.modelVariables][1:] == [
        *('displacement_b', 'displacement', 'voltage_b', 'voltage')
    ]
    fmu = begun(folder, [3, 4], v[0])
    assert_array_equal(played(fmu, [3, 4], v, [1, 2]), np.column_stack([y['y_b'], y['y']]))
    saved, time = fmu.serializeFMUState(fmu.getFMUState()), (len(v) - 1) / FS
    later = played(fmu, [3, 4], v[::-1], [2], time)
    fmu.setFMUState(fmu.deserializeFMUState(saved))
    assert_array_equal(played(fmu, [3, 4], v[::-1], [2], time), later)
