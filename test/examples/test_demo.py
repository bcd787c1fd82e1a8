# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The demo without nodes, which have tests of their own: the page, and all that it leads to."""

import json
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: runs a script as if rclpy were not installed
BLOCKED = 'import runpy, sys; sys.modules["rclpy"] = None; del sys.argv[0]; '
BLOCKED += 'sys.path.insert(0, "examples"); runpy.run_path(sys.argv[0], run_name="__main__")'


@pytest.mark.slow
def test_the_demo_finds_what_is_hidden_and_its_page_leads_to_the_rest(tmp_path):
    out = tmp_path / 'out'
    done = subprocess.run(
        [sys.executable, '-c', BLOCKED, 'examples/demo.py', '--out', str(out)],
        cwd=ROOT,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, '')
    # one line says what is missing
    assert 'the nodes cannot run here' in done.stdout.splitlines()[0]
    before, after = (
        float(re.search(rf'^{word}: +(\d+) nm', done.stdout, re.M)[1])
        for word in ('before', 'after')
    )
    assert after < 0.3 * before
    diagnosis = json.loads((out / 'reports' / 'diagnosis' / 'diagnosis.json').read_text())
    assert 'creep' in [effect['name'] for effect in diagnosis['effects']]
    page = (out / 'index.html').read_text(encoding='utf-8')
    assert diagnosis['sentence'].split(';')[0] in page
    links = set(re.findall(r'(?:href|src)="([^"]+)"', page))
    assert {'residual.png', 'reports/report.html', 'reports/diagnosis/report.html'} <= links
    assert [link for link in links if not (out / link).is_file()] == []
