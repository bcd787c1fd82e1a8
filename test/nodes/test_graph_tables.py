# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Declarations, YAML files, launch files and documentation of the graph say the same."""

import ast
from pathlib import Path

from piezo_ident.nodes.interfaces import rewritten, SERVICES, TOPICS
from piezo_ident.nodes.parameters import NODES
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def test_tables_of_the_documentation_are_those_of_the_declarations():
    page = (ROOT / 'docs/graph.md').read_text(encoding='utf-8')
    assert rewritten(page) == page, 'run: python -m piezo_ident.nodes.interfaces docs/graph.md'
    for node in NODES:
        assert f'<!-- table: parameters {node} -->' in page


@pytest.mark.parametrize('node', NODES)
def test_declarations_are_complete_and_hold_their_own_ranges(node):
    names = [d.name for d in NODES[node]]
    assert len(set(names)) == len(names)
    for d in NODES[node]:
        assert d.description
        assert not d.description.endswith('.')
        if isinstance(d.default, (int, float)) and not isinstance(d.default, bool):
            assert d.unit, f'{node}.{d.name} is a number without a unit'
            assert d.low <= d.default <= d.high
        if d.choices:
            assert d.default in d.choices


@pytest.mark.parametrize('node', NODES)
def test_every_key_of_the_yaml_files_is_declared(node):
    path = ROOT / f'config/{node}.yaml'
    data = yaml.safe_load(path.read_text(encoding='utf-8'))
    (parameters,) = [block['ros__parameters'] for block in data.values()]
    declared = {d.name: d for d in NODES[node]}
    assert set(parameters) <= set(declared)
    for name, value in parameters.items():
        default = declared[name].default
        kind = list if isinstance(default, tuple) else type(default)
        assert isinstance(value, kind), f'{node}.{name}: {value!r} is no {kind.__name__}'


def test_executables_of_launch_files_are_installed():
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    for path in (ROOT / 'launch').glob('*.launch.py'):
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        for call in calls:
            if getattr(call.func, 'id', '') == 'node':
                assert f"'{call.args[0].value} = piezo_ident.nodes." in setup
    for node in NODES:
        assert f"'{node} = piezo_ident.nodes.{node}:main'" in setup


def test_services_and_topics_belong_to_nodes():
    assert {s.node for s in SERVICES} <= set(NODES)
    for t in TOPICS:
        assert set(t.publishers) | set(t.subscribers) <= set(NODES) | {'every node'}
