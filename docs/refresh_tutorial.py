# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs the Python of the tutorial, and writes what comes out into the page and the gallery.

    python docs/refresh_tutorial.py

The page is the source.  The text block behind a block of Python becomes the output of that block,
the picture behind one becomes its figure, and ``examples/tutorial.ipynb`` becomes the page without
outputs, for a reader to run.  The gallery has pictures of the two reports, and the README one of
a third.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
from pathlib import Path
import re
import sys
import tempfile
from typing import Any

from markdown_it import MarkdownIt
from matplotlib.figure import Figure
import nbformat
from nbformat import v4
import numpy as np
import piezo_ident as pi
from piezo_ident.record.record import Piece, Record
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'benchmarks'))
from truths import make_stage

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs/tutorial.md'
NOTEBOOK = ROOT / 'examples/tutorial.ipynb'
DATA = ROOT / 'examples/tutorial_data.zip'
#: the records of two axes
SCANNER = ROOT / 'examples/tutorial_xy.zip'

GALLERY = ROOT / 'docs/gallery.md'
IN_GALLERY = re.compile(r'\]\(images/(report|diagnosis)_(\w+\.png)\)')
PICTURE = re.compile(r'!\[.*\]\((.*\.png)\)')


def _blocks(text: str) -> list[tuple[str, str]]:
    """Return the page in a row: the language of each block, or nothing for prose, and its text."""
    lines, blocks, at = text.splitlines(), [], 0
    for token in MarkdownIt().parse(text):
        if token.type == 'fence' and token.map:
            start, stop = token.map
            blocks += [('', '\n'.join(lines[at:start])), (token.info, token.content.rstrip('\n'))]
            at = stop
    return [*blocks, ('', '\n'.join(lines[at:]))]


def code_blocks(text: str, kind: str = 'python') -> list[str]:
    """Return the blocks of one language."""
    return [block for name, block in _blocks(text) if name == kind]


def outputs(text: str) -> list[str]:
    """Return the output that the page shows of each block of Python; empty without one."""
    shown: list[str] = []
    for kind, block in _blocks(text):
        if kind == 'python':
            shown.append('')
        elif kind == 'text':
            shown[-1] = block
    return shown


def notebook(text: str) -> Any:
    """Return the page as a notebook: Python as code, the rest as Markdown without outputs."""
    cells: list[Any] = [v4.new_code_cell('%matplotlib inline')]
    prose: list[str] = []

    def write_prose() -> None:
        joined = re.sub(r'\n{3,}', '\n\n', '\n\n'.join(prose)).strip()
        if joined:
            cells.append(v4.new_markdown_cell(joined))
        prose.clear()

    for kind, block in _blocks(text):
        if kind == 'python':
            write_prose()
            cells.append(v4.new_code_cell(block))
        elif kind == '':
            block = PICTURE.sub('', block)
            prose.append(re.sub(r'\]\((\w+\.md)', r'](../docs/\1', block))
        elif kind != 'text':
            prose.append(f'```{kind}\n{block}\n```')
    write_prose()
    for number, cell in enumerate(cells):
        cell.id = f'tutorial-{number}'
    return v4.new_notebook(
        cells=cells,
        metadata={
            'kernelspec': {'display_name': 'Python 3', 'language': 'python', 'name': 'python3'}
        },
    )


def _run(code: str, names: dict[str, Any]) -> tuple[str, Figure | None]:
    """Run a block as a notebook does: return what it prints and shows, and its figure."""
    body = ast.parse(code).body
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), '<page>', 'exec'), names)
        value = (
            eval(compile(ast.Expression(last.value), '<page>', 'eval'), names) if last else None
        )
    if isinstance(value, Figure):
        return '', value
    return printed.getvalue() + ('' if value is None else str(value)), None


def _refreshed(text: str, names: dict[str, Any]) -> str:
    out, figure, output = [], None, ''
    for kind, block in _blocks(text):
        if kind == 'python':
            output, figure = _run(block, names)
        picture = PICTURE.search(block)
        if kind == '' and picture and figure is not None:
            figure.savefig(PAGE.parent / picture[1], dpi=80)
            figure = None
        if kind == 'text':
            block = output.rstrip()
        out.append(f'```{kind}\n{block}\n```' if kind else block)
    return '\n'.join(out) + '\n'


def _draw_gallery(identification: pi.Identification) -> None:
    """Copy the pictures of the reports that the gallery shows, with fewer colours."""
    pi.write_report(identification, 'report')
    for folder, name in IN_GALLERY.findall(GALLERY.read_text(encoding='utf-8')):
        _copied(Path(folder, name), f'{folder}_{name}')


def _draw_readme() -> None:
    """Identify a stage with a density of plays, and copy the picture of its loops."""
    played = pi.Program.load('identification').build()
    t, v = np.arange(played.n) / played.sample_rate, played.v
    y = make_stage('creep', 0.3, 1, noise='white').respond(t, v, changed=False)
    piece = Piece(v, y, played.sample_rate, segments=tuple(played.segments))
    pi.write_report(pi.identify(Record((piece,), 'identification')), 'plays')
    _copied(Path('plays/loops.png'), 'loops.png')


def _copied(picture: Path, name: str) -> None:
    """Copy a picture to those of the pages, with fewer colours."""
    few = Image.open(picture).convert('RGB').quantize(64)
    few.save(GALLERY.parent / 'images' / name, optimize=True)


def main() -> None:
    """Run the page in an empty folder, and write page, pictures and notebook."""
    text = PAGE.read_text(encoding='utf-8')
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for archive in (DATA, SCANNER):
            Path(archive.name).symlink_to(archive)
        names: dict[str, Any] = {}
        text = _refreshed(text, names)
        _draw_gallery(names['identification'])
        _draw_readme()
        os.chdir(before)
    PAGE.write_text(text, encoding='utf-8')
    nbformat.write(notebook(text), NOTEBOOK)


if __name__ == '__main__':
    main()
