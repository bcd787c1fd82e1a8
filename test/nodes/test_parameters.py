# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The declarations of parameters, the YAML and launch files, and docs/graph.md agree."""

import ast
import json
import os

from graph_page import ROOT, table
from piezo_ident.nodes import main
from piezo_ident.nodes.parameters import NODES
import pytest
import yaml


def row(d):
    """Return the row of a declaration in docs/graph.md."""
    value = ', '.join(d.default) if isinstance(d.default, tuple) else str(d.default)
    unit = f' {d.unit}' if d.unit not in ('', '1') else ''
    about = f'{d.description}: {" or ".join(d.choices)}' if d.choices else d.description
    fixed = ' (read-only)' if d.read_only else ''
    return [d.name, f'{value}{unit}', f'{about}{fixed}']


@pytest.mark.parametrize('node', NODES)
def test_the_page_has_a_row_for_every_parameter(node):
    rows = table(f'parameters {node}')
    for name, nodes, *others in table('parameters of several nodes'):
        if node in nodes.split(', '):
            rows.append([name, *others])
    assert sorted(rows) == sorted(row(d) for d in NODES[node])


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
    scripts = {path.name: path for path in (ROOT / 'launch/nodes').iterdir()}
    assert set(scripts) == set(NODES) == set(main.NODES)
    for name, path in scripts.items():
        assert os.access(path, os.X_OK)
        assert path.read_text(encoding='utf-8').endswith(f"\n    start('{name}')\n")
    for path in (ROOT / 'launch').glob('*.launch.py'):
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        for call in calls:
            if getattr(call.func, 'id', '') == 'node':
                assert call.args[0].value in scripts


def test_foxglove_labels_a_path_by_what_the_preview_holds():
    layout = json.loads((ROOT / 'config/foxglove.json').read_text(encoding='utf-8'))
    quantities = ('voltage', 'displacement', 'prediction', 'residual', 'estimate')
    names = [f'{quantity}/{what}' for quantity in quantities for what in ('mean', 'min', 'max')]
    paths = [p for panel in layout['configById'].values() for p in panel.get('paths', ())]
    shown = {p['label']: p['value'] for p in paths if p['value'].startswith('/preview')}
    assert shown
    for label, path in shown.items():
        assert path == f'/preview.position[{names.index(label)}]'


def test_the_picture_of_the_graph_shows_all_nodes_and_topics():
    drawn = (ROOT / 'docs/images/graph.svg').read_text(encoding='utf-8')
    topics = [name for name, *_ in table('topics') if '/' not in name]
    assert [name for name in (*NODES, *topics) if f'>{name}</text>' not in drawn] == []
