# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The demo without nodes: the page, and what it leads to; and what make installs for it."""

from dataclasses import replace
import functools
import html
import importlib
import json
import os
from pathlib import Path
import re
import runpy
import shlex
import shutil
import subprocess
import sys

import piezo_ident as pi
import pytest

ROOT = Path(__file__).resolve().parents[2]
#: what becomes of times, periods and slopes of the programs
LESS = {'duration': lambda x: 0.4 * x, 'periods': lambda x: 1, 'slope': lambda x: 2.5 * x}


@pytest.fixture
def short_demo(monkeypatch, blank_pictures):
    """Have the demo without rclpy try few effects, orders and thresholds on shorter motions."""

    def load_less(name, load=pi.Program.load):
        program = load(name)
        entries = (
            replace(e, options={k: LESS[k](x) if k in LESS and x else x for k, x in options})
            for e in program.entries
            for options in [e.options.items()]
        )
        return replace(program, entries=tuple(entries))

    few = pi.DiagnosisSettings(effects=('creep', 'rate_dependent_hysteresis'))
    monkeypatch.setattr(pi, 'diagnose', functools.partial(pi.diagnose, settings=few))
    quick = functools.partial(pi.identify, settings=pi.Settings(max_order=8, thresholds=12))
    monkeypatch.setattr(pi, 'identify', quick)
    monkeypatch.setattr(pi.Program, 'load', load_less)
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    monkeypatch.syspath_prepend(str(ROOT / 'examples'))


@pytest.mark.slow
@pytest.mark.filterwarnings('error::UserWarning', 'error::RuntimeWarning')
def test_the_demo_finds_what_is_hidden_and_its_page_leads_to_the_rest(
    short_demo, tmp_path, monkeypatch, capsys
):
    out = tmp_path / 'out'
    monkeypatch.setattr(sys, 'argv', ['demo.py', '--out', str(out)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / 'examples/demo.py'), run_name='__main__')
    done = capsys.readouterr()
    # numba compiles where its cache is cold
    said = [line for line in done.err.splitlines() if not line.startswith('compiling the')]
    assert (ended.value.code, said) == (0, [])
    # one line says what is missing
    assert 'the nodes cannot run here' in done.out.splitlines()[0]
    before, after = (
        float(re.search(rf'^{word}: +(\d+) nm', done.out, re.M)[1]) for word in ('before', 'after')
    )
    assert after < 0.3 * before
    # mean included
    estimate = re.search(r'^estimate after: \d+ nm \(([\d.]+) % of stroke', done.out, re.M)
    assert float(estimate[1]) <= 0.02
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


@pytest.fixture
def demo_page(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'examples'))
    return importlib.import_module('demo_page')


@pytest.fixture
def recorded(demo_page, tmp_path):
    """Return a recording as it should be."""
    bag = tmp_path / 'my bags' / 'after'
    bag.mkdir(parents=True)
    (bag / 'after.mcap').touch()
    return demo_page.Recorded(
        bag=bag,
        model=tmp_path / 'model.yaml',
        blocks={'/voltage': (82, 8200, True), '/displacement': (82, 8200, True)},
        differences={'live and replayed': 0.0, 'live and offline': 2.5e-16},
        rate=4.0,
        stroke=1e-5,
        commands=('ros2 service call /excitation/start std_srvs/srv/Trigger',),
    )


def test_the_page_shows_the_motions_the_residual_the_bag_the_commands_and_plotjuggler(
    demo_page, recorded, tmp_path
):
    motions = pi.Program.load(demo_page.MOTIONS).build()
    # fewer samples are drawn faster
    t, v = motions.t[::50], motions.v[::50]
    motion = demo_page.Motion(t, v, 1e-6 * v, 1.01e-6 * v, 1.002e-6 * v)
    diagnosis = {'sentence': 'Creep explains it.'}
    diagnosis['error'] = {when: {'overall': 0.5} for when in ('before', 'after')}
    (tmp_path / 'reports/diagnosis').mkdir(parents=True)
    (tmp_path / 'reports/diagnosis/diagnosis.json').write_text(json.dumps(diagnosis))
    session = demo_page.Session(motion, motion, recorded)
    assert session.problems == []
    file = demo_page.write_page(tmp_path, session, ['0 s'])
    page = html.unescape(file.read_text(encoding='utf-8'))
    # in this order
    wanted = ('id="loops"', 'id="traces"', 'id="residual"', '/my bags/after', '/displacement')
    wanted += ('2.50e-16', 'sine:120Hz', 'ros2 service call /excitation/start')
    places = [page.rindex(text) if 'id=' in text else page.index(text) for text in wanted]
    assert places == sorted(places)
    assert page.index('2.5e-16 of stroke') < places[0]
    # prediction and estimate, both with their size
    assert motion.text in page and page.count(motion.estimate_text) == 2
    # a path with a blank can be pasted
    line = next(line for line in page.splitlines() if 'plotjuggler --layout' in line)
    _, _, command = line.rpartition('<pre>')
    words = shlex.split(command.removesuffix('</pre>'))
    layout, bag = (Path(words[words.index(o) + 1]) for o in ('--layout', '--datafile'))
    assert layout.is_file()
    assert bag.name == 'after.mcap'
    assert bag.is_file()


def test_what_differs_is_a_problem_and_what_was_lost_is_not_compared(recorded):
    altered = {'/voltage': (82, 8200, True), '/displacement': (82, 8200, False)}
    differ = replace(recorded, blocks=altered, differences={'live and replayed': 1.1e-12})
    bag, run = differ.problems
    assert '/displacement' in bag
    assert '1.1e-12' in run
    lossy = replace(differ, lost='3 of 8200 samples of /prediction')
    assert lossy.problems == []
    assert '3 of 8200 samples of /prediction' in lossy.verdict


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
