# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tutorial: its cells give what the page shows, and its commands are understood."""

import importlib.util
from pathlib import Path
import re
import shlex
import zipfile

from piezo_ident.cli.main import cli
import pytest

nbformat = pytest.importorskip('nbformat')
pytest.importorskip('markdown_it')

ROOT = Path(__file__).resolve().parents[2]
#: options that name a file to write
OUTPUTS = ('--model', '--out', '--report')


def numbers(text):
    """Return the numbers in a text."""
    return [float(word) for word in re.findall(r'(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?', text)]


@pytest.fixture(scope='module')
def tutorial():
    path = ROOT / 'docs/refresh_tutorial.py'
    spec = importlib.util.spec_from_file_location('refresh_tutorial', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notebook_is_the_page_and_the_data_are_small(tutorial):
    stored = nbformat.read(tutorial.NOTEBOOK, as_version=4)
    page = tutorial.notebook(tutorial.PAGE.read_text(encoding='utf-8'))
    assert stored.cells == page.cells, 'run python docs/refresh_tutorial.py'
    assert tutorial.DATA.stat().st_size < 300_000
    assert tutorial.SCANNER.stat().st_size < 200_000


@pytest.mark.slow
def test_the_cells_give_what_the_page_shows(tutorial, tmp_path, monkeypatch, blank_pictures):
    monkeypatch.chdir(tmp_path)
    for archive in (tutorial.DATA, tutorial.SCANNER):
        (tmp_path / archive.name).symlink_to(archive)
    page, names, shown, figures = tutorial.PAGE.read_text(encoding='utf-8'), {}, [], 0
    for cell, expected in zip(tutorial.code_blocks(page), tutorial.outputs(page), strict=True):
        said, figure = tutorial._run(cell, names)
        shown.append(said)
        figures += figure is not None
        if expected:
            # other processors, and another number of threads, round otherwise: 0.040 or 0.045 %
            stale = f'run python docs/refresh_tutorial.py:\n{expected}\n{said}'
            assert numbers(said) == pytest.approx(numbers(expected), rel=0.2, abs=2e-3), stale
    # results and pictures show themselves, and the story is that of the page
    assert figures >= 5
    assert any(said.startswith('Slew limit explains') for said in shown)
    before, after = (names[when].errors.percent_without_offset for when in ('before', 'after'))
    assert before > 0.5 and after < 0.1
    # and of the two axes: each path is found, and the raster is predicted better with it
    (paths,) = (said for said in shown if 'cross_coupling' in said)
    assert 'motion_b' in paths.splitlines()[0] and 'motion' in paths.splitlines()[1]
    (raster,) = (said for said in shown if 'of the raster' in said)
    errors = re.findall(r'([0-9.]+) %', raster)
    for alone, both in zip(errors[:2], errors[2:], strict=True):
        assert float(both) < 0.5 * float(alone) and float(both) < 0.4


def test_the_commands_of_the_page_are_understood_and_read_what_is_there(tutorial):
    (block,) = tutorial.code_blocks(tutorial.PAGE.read_text(encoding='utf-8'), 'console')
    unpack, *commands = block.replace('$ ', '').splitlines()
    assert unpack == 'python -m zipfile -e examples/tutorial_data.zip .'
    with zipfile.ZipFile(tutorial.DATA) as archive:
        there = set(archive.namelist())
    for command in commands:
        program, *words = shlex.split(command)
        given = cli.main(words, program, standalone_mode=False)
        verb, *inputs = (word for word in words if not word.startswith('-'))
        made = [words[i + 1] for i, word in enumerate(words) if word in OUTPUTS]
        assert given.verb == verb and made
        assert set(inputs) - set(made) <= there, command
        there.update(made)
