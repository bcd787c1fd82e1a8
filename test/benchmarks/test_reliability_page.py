# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The page of all that was tried is made of the rows, and every row can be run again."""

import json
from pathlib import Path

import build
import pytest
from rows import KEYS

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(build.ROWS.glob('*.json'))


def test_the_page_is_that_of_the_rows():
    cure = 'run: python benchmarks/reliability/build.py'
    assert (ROOT / 'docs/reliability.md').read_text(encoding='utf-8') == build.page(), cure


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.stem)
def test_rows_have_all_they_need(path):
    rows = json.loads(path.read_text(encoding='utf-8'))
    assert rows
    for row in rows:
        # a study may keep more of its own beside
        assert all(isinstance(row.get(key), str) and row[key].strip() for key in KEYS)
        words = row['command'].split()
        scripts = [w for w in words if w.endswith('.py')]
        assert scripts or words[0] == 'make', row['command']
        for script in scripts:
            assert (ROOT / script).is_file(), row['command']
