# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The front door: every public name is there and documented, and every example runs."""

import ast
import doctest
import importlib
import inspect
import json
from pathlib import Path
import pkgutil
import sys

import numpy as np
import piezo_ident as pi
from piezo_ident.model.multi_axis import EachAxis
import pytest

NAMES = [name for name in pi.__all__ if name != '__version__']
SOURCE = Path(pi.__file__).read_text(encoding='utf-8')
#: all that need no ROS
MODULES = [
    info.name
    for info in pkgutil.walk_packages(pi.__path__, 'piezo_ident.')
    if '.nodes' not in info.name and not info.name.endswith('__main__')
]


def test_every_name_has_a_home_and_a_type():
    (block,) = (
        node
        for node in ast.parse(SOURCE).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING'
    )
    typed = {
        alias.asname or alias.name
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == set(NAMES) == set(pi._HOMES)
    assert dir(pi) == sorted(pi.__all__)


def test_a_name_that_is_not_there():
    with pytest.raises(AttributeError, match="'identifi'"):
        _ = pi.identifi  # type: ignore[attr-defined]


@pytest.mark.parametrize('name', NAMES)
def test_every_public_name_has_a_docstring_with_an_example(name):
    thing = getattr(pi, name)
    assert inspect.getdoc(thing)
    if isinstance(thing, type) and issubclass(thing, Exception):
        return
    home = sys.modules[getattr(thing, '__module__', thing.__name__)]
    # `test_examples` runs what is found so
    assert home.__name__ in MODULES
    (test,) = (
        test
        for test in doctest.DocTestFinder(recurse=False).find(thing, name, module=home)
        if test.name == name
    )
    assert test.examples, f'{name} has no example'


@pytest.mark.parametrize('name', MODULES)
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_arguments_of_another_kind_cost_one_line(tmp_path):
    model = pi.SimulatedStage.load('paper').model
    record = pi.Record.from_arrays([0, 1, 2], [0, 1e-6, 2e-6], sample_rate=20e3)
    for call, where, kind in (
        (lambda: pi.identify('record.csv'), 'identify', 'str'),
        (lambda: pi.identify([record, 'record.csv']), 'identify', 'str'),
        (lambda: pi.identify(record, record), 'identify, settings', 'Record'),
        (lambda: pi.free_run(record, model), 'free_run, first', 'Record'),
        (lambda: pi.free_run(model, 'record.csv'), 'free_run, second', 'str'),
        (lambda: pi.diagnose(record, model), 'diagnose, second', 'StageModel'),
        (lambda: pi.diagnose(model, model), 'diagnose, second', 'StageModel'),
        (lambda: pi.diagnose(model, record, record), 'diagnose, settings', 'Record'),
        (lambda: pi.export_c('model.yaml'), 'export, first', 'str'),
        (lambda: pi.export_fmu(record, tmp_path / 'stage.fmu'), 'export, first', 'Record'),
        (lambda: pi.write_report(record, tmp_path / 'report'), 'write_report', 'Record'),
        (lambda: model.simulate('voltage.csv'), 'simulate, voltage', '<U11'),
    ):
        with pytest.raises(pi.DataError, match=f'^{where}.* got {kind};'):
            call()


@pytest.fixture(scope='module')
def results():
    """Return a result of each verb, of one axis and of two."""
    model = pi.SimulatedStage.load('paper').model
    v = 5 - 5 * np.cos(2 * np.pi * 50 * np.arange(4000) / 20e3)
    record = pi.Record.from_arrays(v, model.simulate(v), sample_rate=20e3)
    one = {
        'identify': pi.identify(record, pi.Settings(thresholds=4, delay=3, order=(1, 1))),
        'free_run': pi.free_run(model, record),
        'diagnose': pi.diagnose(model, record, pi.DiagnosisSettings(effects=('saturation',))),
        'invert': pi.invert(model, np.linspace(20e-6, 30e-6, 500)),
    }
    two = {
        f'{verb}, two axes': EachAxis({'y': one[verb], 'y_b': one[verb]})
        for verb in ('identify', 'free_run', 'diagnose')
    }
    wanted = {'y': np.linspace(20e-6, 30e-6, 500)}
    stage = pi.MultiAxisModel({'y': model, 'y_b': model})
    return {**one, **two, 'invert, two axes': pi.invert(stage, wanted)}


@pytest.mark.parametrize('axes', ['', ', two axes'])
@pytest.mark.parametrize('verb', ['identify', 'free_run', 'diagnose', 'invert'])
def test_every_result_has_the_same_members(results, verb, axes):
    result = results[verb + axes]
    model, pictures = result.model, result.plot()
    assert isinstance(model, pi.MultiAxisModel if axes else pi.StageModel)
    assert result.errors
    assert all(isinstance(text, str) for text in result.warnings)
    for picture in pictures.values() if axes else [pictures]:
        assert picture.axes
    json.dumps(result.to_json(), allow_nan=False)
    assert len(repr(result).splitlines()) > 1


def test_the_catalogue_of_effects_is_printed():
    lines = repr(pi.effects).splitlines()
    assert [line.split()[0] for line in lines] == sorted(pi.effects.catalogue())
