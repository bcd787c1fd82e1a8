# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The demo without nodes: the page, and what it leads to; and what make installs for it."""

import json
import os
from pathlib import Path
import re
import shutil
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
    files = {link for link in links if not link.startswith('data:image/png')}
    assert {'reports/report.html', 'reports/diagnosis/report.html'} <= files
    assert [link for link in files if not (out / link).is_file()] == []
    # measured against predicted first, then the residual, and no bag where nobody recorded one
    shown = [page.find(f'<figure id="{name}">') for name in ('loops', 'traces', 'residual')]
    assert shown == sorted(shown)
    assert shown[0] > 0
    assert 'plotjuggler' not in page
    assert 'rclpy' in page


#: stand for Python, which makes environments, and for pip and Python there; all write what they do
SCRIPTS = {
    'python': """#!/bin/sh
echo "python $*" >> log
for last; do :; done
if [ "$2" = venv ]; then rm -rf "$last"; mkdir -p "$last/bin"; cp pip python "$last/bin/"; fi
""",
    'pip': """#!/bin/sh
echo "pip $*" >> log
case "$*" in *[[]ros*) exit ${NO_WHEELS:-0};; esac
""",
}


@pytest.fixture
def make_demo(tmp_path):
    """Return what runs `make demo` with settings, and returns what was run and what was said."""
    shutil.copy(ROOT / 'Makefile', tmp_path)
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml'):
        (tmp_path / name).touch()
    for name, script in SCRIPTS.items():
        (tmp_path / name).write_text(script)
        (tmp_path / name).chmod(0o755)
    foreign = ('ROS_DISTRO', 'AMENT_PREFIX_PATH', 'MAKEFLAGS', 'MAKELEVEL')
    environment = {k: v for k, v in os.environ.items() if k not in foreign}

    def run(**settings):
        log = tmp_path / 'log'
        log.unlink(missing_ok=True)
        done = subprocess.run(
            ['make', 'demo', 'PYTHON=./python'],
            cwd=tmp_path,
            env={**environment, **settings},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        lines = log.read_text().splitlines()
        assert lines.pop() == 'python examples/demo.py --out demo_report'
        return lines, done.stdout

    return run


def test_make_installs_without_the_wheels_where_there_are_none(make_demo):
    lines, said = make_demo(NO_WHEELS='1')
    assert [line.rpartition('-e ')[2] for line in lines[1:]] == ['.[ros]', '.']
    assert 'without them' in said
    # pip is not asked again each time
    assert make_demo()[0] == []


def test_make_takes_the_wheels_or_a_sourced_ros_and_never_both(make_demo):
    wheels, _ = make_demo()
    assert 'system-site-packages' not in wheels[0]
    assert wheels[1].endswith('-e .[ros]')
    for name in ('ROS_DISTRO', 'AMENT_PREFIX_PATH'):
        sourced, said = make_demo(**{name: 'jazzy'})
        # an environment that held wheels is made anew
        assert ['--clear --system-site-packages' in line for line in sourced] == [True, False]
        assert sourced[1].endswith('numpy<2 -e .')
        assert 'PYTHONPATH' in said
        assert make_demo(**{name: 'jazzy'})[0] == []
        assert make_demo()[0] == wheels
