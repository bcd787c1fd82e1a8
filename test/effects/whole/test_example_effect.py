# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A lab's own effect comes in as an entry point: the package in example_effect/ does it."""

import ast
import configparser
import json
import os
from pathlib import Path
import re
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import Mock

from effect_table import PAPER, rich
import numpy as np
from piezo_ident import effects
from piezo_ident.effects import catalogue
from piezo_ident.model.files import model_to_dict
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = Path(__file__).parents[2] / 'example_effect'

#: in a fresh interpreter: what the catalogue has, and what a model file with the effect predicts
SCRIPT = """
import json
import sys
import numpy as np
from piezo_ident.effects import catalogue, View
from piezo_ident.model.files import load

model = load(sys.argv[1])
view = View(20_000.0, 0.0, 1.0, np.array([1.0, 10.0]), 1.0)
effect = catalogue()['soft_stop']
print(json.dumps({
    'names': sorted(catalogue()),
    'y': model.stream().process(np.load(sys.argv[2])).tolist(),
    'trials': [[dict(t.values), list(t.moves), list(t.steps)] for t in effect.trials(view)],
}))
"""


def install(folder: Path) -> None:
    """Put the example and its metadata where an installer would, without the network."""
    config = configparser.ConfigParser()
    config.read(EXAMPLE / 'setup.cfg')
    name, version = config['metadata']['name'], config['metadata']['version']
    (module,) = config['options']['py_modules'].split()
    text = (EXAMPLE / f'{module}.py').read_text(encoding='utf-8')
    (folder / f'{module}.py').write_text(text, encoding='utf-8')
    info = folder / f'{name.replace("-", "_")}-{version}.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n')
    groups = config['options.entry_points'].items()
    (info / 'entry_points.txt').write_text(
        '\n'.join(f'[{group}]{points}' for group, points in groups), encoding='utf-8'
    )


def run(folder: Path, *args: object) -> str:
    paths = [str(folder), str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])]
    done = subprocess.run(
        [sys.executable, *map(str, args)],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp('site')
    install(folder)
    return folder


def test_an_installed_effect_is_in_the_catalogue_and_in_models(site, tmp_path):
    data, v = model_to_dict(PAPER), rich()
    data['effects'] = [{'name': 'soft_stop', 'parameters': {'gain': 0.5, 'stop': 0.6}}]
    (tmp_path / 'model.yaml').write_text(yaml.safe_dump(data), encoding='utf-8')
    np.save(tmp_path / 'v.npy', v)
    found = json.loads(run(site, '-c', SCRIPT, tmp_path / 'model.yaml', tmp_path / 'v.npy'))
    assert set(found['names']) == {*catalogue(), 'soft_stop'}
    x = PAPER.stream().process(v) / 75e-6
    law = x - 0.5 * np.maximum(0.0, x - 0.6)
    np.testing.assert_allclose(np.array(found['y']) / 75e-6, law, atol=1e-12)
    # nothing was written for it: it is a candidate all the same
    assert found['trials'] == [
        [{'gain': 0.0, 'stop': stop}, [['gain', None]], [0.01]] for stop in (0.5, 0.7, 0.9)
    ]


def test_the_effect_has_as_many_lines_as_its_page_says():
    tree = ast.parse((EXAMPLE / 'example_effect.py').read_text(encoding='utf-8'))
    (effect,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    page = (ROOT / 'docs/effect.md').read_text(encoding='utf-8')
    said = re.search(r'An effect is a class of (\d+) lines', page)
    assert int(said[1]) == effect.end_lineno - effect.lineno + 1 <= 30


@pytest.mark.parametrize(
    'loaded', [ImportError('no module'), SyntaxError('bad'), dict, len, catalogue()['creep']]
)
def test_a_broken_plug_in_is_skipped_with_a_warning(monkeypatch, loaded):
    own = dict(catalogue())
    # raises what is an error, and returns the rest
    entry = SimpleNamespace(value='lab:Mine', load=Mock(side_effect=[loaded]))
    monkeypatch.setattr(effects, 'entry_points', lambda group: [entry])
    catalogue.cache_clear()
    try:
        with pytest.warns(UserWarning, match='lab:Mine'):
            assert catalogue() == own
    finally:
        monkeypatch.undo()
        catalogue.cache_clear()
