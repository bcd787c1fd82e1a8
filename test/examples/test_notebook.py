# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The notebook runs from top to bottom, and is stored without outputs."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip('nbformat')
nbclient = pytest.importorskip('nbclient')

NOTEBOOK = Path(__file__).resolve().parents[2] / 'examples' / 'first_steps.ipynb'


@pytest.mark.slow
def test_first_steps():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == 'code']
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    nbclient.NotebookClient(
        notebook, timeout=None, resources={'metadata': {'path': str(NOTEBOOK.parent)}}
    ).execute()
    assert 'creep' in cells[-1].outputs[-1]['data']['text/plain']
    # results and pictures show themselves
    shown = [set(output.get('data', ())) for cell in cells for output in cell.outputs]
    assert sum('text/html' in kinds for kinds in shown) >= 3
    assert sum('image/png' in kinds for kinds in shown) >= 3
