# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmarks' contract and the page that is made of them; no time is judged here."""

import ast
from pathlib import Path

import bench_growth as growth
import bench_peers_arx as arx
import bench_peers_swarm as swarm
import numpy as np
import pytest
import run_all
from side_by_side import seconds, take_turns, Turn

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / 'benchmarks'


GOOD = """
def sections(quick: bool = False) -> list[tuple[str, str]]:
    print('progress goes anywhere')
    return [('Quick' if quick else 'Long', '| a |\\n|---|\\n| 1 |'), ('Second', 'text')]
"""
LACKING = """
import no_such_library_anywhere


def sections(quick: bool = False) -> list[tuple[str, str]]:
    return []
"""
ENDLESS = """
import time


def sections(quick: bool = False) -> list[tuple[str, str]]:
    time.sleep(600)
    return []
"""
NONE = 'def main():\n    pass\n'


def write(folder, **modules):
    for name, text in modules.items():
        (folder / f'bench_{name}.py').write_text(text)
    return folder


def test_every_benchmark_keeps_the_contract():
    found = {path.stem for path in run_all.benchmarks()}
    assert {'bench_growth', 'bench_peers_arx', 'bench_peers_hysteresis'} <= found
    assert 'bench_live' not in found
    for path in run_all.benchmarks():
        tree = ast.parse(path.read_text(encoding='utf-8'))
        (function,) = (
            node
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and node.name == 'sections'
        )
        assert [a.arg for a in function.args.args] == ['quick'], path.name
        assert [ast.unparse(d) for d in function.args.defaults] == ['False'], path.name
        assert ast.unparse(function.returns) == 'list[tuple[str, str]]', path.name
        guards = [node for node in tree.body if isinstance(node, ast.If)]
        assert any('__main__' in ast.unparse(node.test) for node in guards), path.name


def test_page_of_one_benchmark_that_works_and_one_that_does_not(tmp_path, capsys):
    folder = write(tmp_path, zebra=GOOD, ape=LACKING, cow=NONE)
    out = tmp_path / 'docs' / 'page.md'
    code = run_all.main(['--out', str(out), '--quick'], folder)
    text = out.read_text(encoding='utf-8')
    assert code == 1
    assert '## Quick\n\n| a |\n|---|\n| 1 |\n\n## Second' in text
    assert '## Long' not in text
    assert '## `bench_ape` failed' in text
    assert "No module named 'no_such_library_anywhere'" in text
    assert 'cow' not in text
    # the machine, the versions, the command and what else was going on
    assert f'numpy {np.__version__}' in text
    assert f'--out {out} --quick' in text
    assert 'Load average before' in text
    assert not list(out.parent.glob('.*'))
    capsys.readouterr()
    assert run_all.main(['--out', str(out), '--only', 'zebra'], folder) == 0
    text = out.read_text(encoding='utf-8')
    assert '## Long' in text
    assert 'ape' not in text


def test_unknown_benchmark_is_refused(tmp_path, capsys):
    folder = write(tmp_path, zebra=GOOD)
    with pytest.raises(SystemExit, match='2'):
        run_all.main(['--out', str(tmp_path / 'page.md'), '--only', 'zebu'], folder)
    assert 'no benchmark zebu; there are zebra' in capsys.readouterr().err


def test_a_benchmark_that_does_not_end_is_ended(tmp_path):
    write(tmp_path, slow=ENDLESS)
    outcome = run_all.run(tmp_path / 'bench_slow.py', quick=True, limit=0.5)
    assert outcome.sections == ()
    assert outcome.reason == 'it took more than 0.5 s'
    assert outcome.seconds < 60.0


def test_turns_are_taken_in_order():
    called = []

    def work(name):
        return lambda k: called.append((name, k)) or (name, k)

    turns = take_turns({'a': work('a'), 'b': work('b')}, 2, warm=['a'])
    assert called == [('a', 0), ('a', 0), ('b', 0), ('a', 1), ('b', 1)]
    assert turns['a'].results == [('a', 0), ('a', 1)]
    assert len(turns['b'].times) == 2
    assert turns['a'].over(turns['a']) == 1.0


def test_ratio_of_two_works_is_the_median_over_pairs_and_times_have_their_unit():
    one, other = Turn([2.0, 30.0, 4.0]), Turn([1.0, 10.0])
    assert one.over(other) == pytest.approx(2.5)
    assert one.median == 4.0
    texts = [seconds(t) for t in (2.345, 0.0123, 4.5e-6, 1.234e-8, 1234.4)]
    assert texts == ['2.35 s', '12.3 ms', '4.5 µs', '12.3 ns', '1234 s']


def test_exponent_is_the_slope_at_the_large_end():
    sizes = [1.0, 10.0, 100.0, 1000.0]
    # a fixed cost bends the small end alone
    assert growth.exponent(sizes, [5.0, 1e2, 1e4, 1e6]) == pytest.approx(2.0)
    assert np.isnan(growth.exponent([1.0], [1.0]))


def test_growth_measures_in_a_process_of_its_own(tmp_path):
    took, n, peak = growth.measured('stream', 2.0, tmp_path)
    assert took > 0.0
    assert n == 40_000
    assert 10.0 < peak < 4000.0
    with pytest.raises(RuntimeError, match=r'read of 2 s failed: .*short'):
        growth.measured('read', 2.0, tmp_path)


def test_order_search_is_judged_on_data_of_its_own():
    data = arx.data_of(0)
    assert data.u.size == 16_000
    assert data.u_test.size == data.y_test.size == 4_000
    found = arx.ours(data, 4)
    assert np.isfinite(data.error(found))
    assert data.error((np.ones(1), np.array([-1.1]))) == float('inf')


def test_swarm_problem_is_that_of_the_identification():
    task = swarm.problem()
    assert task.A.shape[1] == task.box.shape[0] == 11
    cost = swarm.Cost(task)
    middle = task.box.mean(axis=1)
    assert cost(middle[None])[0] == pytest.approx(task.loss(middle))
    assert task.loss(middle) > task.optimum


@pytest.mark.parametrize('path', sorted(FOLDER.rglob('*.py')), ids=lambda p: p.stem)
def test_what_a_benchmark_takes_from_the_package_is_there(path):
    # most of them run for minutes, and seldom
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('piezo_ident.'):
            exec(compile(ast.Module([node], []), path, 'exec'), {})
