# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The examples in the docstrings of every module that needs no ROS."""

import doctest
import importlib
import pkgutil

import piezo_ident
import pytest

MODULES = [
    info.name
    for info in pkgutil.walk_packages(piezo_ident.__path__, 'piezo_ident.')
    if '.nodes' not in info.name and not info.name.endswith('__main__')
]


def test_there_are_modules():
    assert 'piezo_ident.identification.solvers.particle_swarm' in MODULES


@pytest.mark.parametrize('name', MODULES)
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0
