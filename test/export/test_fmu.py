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
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.model.stage_model import EffectSetting
import pytest

fmpy = pytest.importorskip('fmpy', reason='FMPy is not installed (extra fmu)')

NAMES = ('creep', 'rate_dependent_hysteresis', 'cross_coupling', 'thermal_drift')
MODEL = replace(PAPER, effects=tuple(EffectSetting(name, VISIBLE[name]) for name in NAMES))
TIME, DISPLACEMENT, VOLTAGE, OTHER = range(4)


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


@pytest.fixture(scope='module')
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp('fmu') / 'stage.fmu'
    pi.export_fmu(MODEL, path)
    command = [sys.executable, '-m', 'fmpy', 'compile', '--all-warnings', '--warning-as-error']
    # cmake is installed beside this interpreter
    env = {**os.environ, 'PATH': f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'}
    done = subprocess.run([*command, str(path)], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return path


@pytest.fixture
def start(path, tmp_path):
    """Return what starts the FMU under inputs."""
    from fmpy.fmi3 import FMU3Slave

    about = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path), unzipdir=str(tmp_path / 'unzipped'))

    def started(voltage, other, token=about.instantiationToken):
        fmu = FMU3Slave(
            guid=token, unzipDirectory=folder, modelIdentifier='stage', instanceName='one'
        )
        fmu.instantiate()
        fmu.enterInitializationMode(startTime=0.0)
        fmu.setFloat64([VOLTAGE, OTHER], [voltage, other])
        fmu.exitInitializationMode()
        return fmu

    return started


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
def test_fmpy_simulates_it(path):
    result = fmpy.simulate_fmu(str(path), stop_time=0.01, start_values={'voltage': 4.0})
    still, none = np.full(len(result), 4.0), np.zeros(len(result))
    expected = MODEL.simulate(still, channels={'other_axis': none})
    assert len(result) > 100
    assert_allclose(result['displacement'], expected, rtol=1e-9)
