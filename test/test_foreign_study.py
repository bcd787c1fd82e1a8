# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stages of another family and the rules by which a diagnosis of them is counted."""

import ast
from dataclasses import replace
import importlib
from itertools import pairwise
from pathlib import Path
import sys

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / 'benchmarks'


@pytest.fixture(scope='module')
def load():
    """Return a function that imports a file of the benchmarks."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module
    sys.path.remove(str(FOLDER))


def test_stages_know_nothing_of_what_is_judged():
    for path in (FOLDER / 'foreign').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or '']
            else:
                continue
            assert not [n for n in names if n.startswith('piezo_ident')], path.name


def test_preisach_operator_is_the_sum_of_its_relays(load, monkeypatch):
    cores = load('foreign.cores')
    cells = 30
    monkeypatch.setattr(cores, 'CELLS', cells)

    def density(a, b):
        return np.exp(-3 * (a - b)) * (1.0 + 0.8 * (a + b - 1.0))

    rng = np.random.default_rng(4)
    levels = np.concatenate([[0.0], rng.uniform(0.0, 1.0, 60), [1.0, 0.5]])
    u = np.concatenate([np.linspace(x, y, 4) for x, y in pairwise(levels)])
    found = cores.preisach(density)(u)
    # much finer relays, each with the density of its cell; half of those on the diagonal
    fine = 20 * cells
    a, b = np.meshgrid(np.arange(fine), np.arange(fine), indexing='ij')
    middle = (np.arange(cells) + 0.5) / cells
    weight = density(middle[a // 20], middle[b // 20]) * (a >= b) / fine**2
    weight *= np.where(a == b, 0.5, 1.0)
    up = np.zeros(a.shape, dtype=bool)
    a, b = (a + 0.5) / fine, (b + 0.5) / fine
    expected = []
    for x in u:
        up = (up | (x >= a)) & (x > b)
        expected.append(weight[up].sum())
    assert found == pytest.approx(np.array(expected), abs=1.0 / fine)


@pytest.mark.parametrize('group', ['tuning', 'final'])
def test_cores_are_those_of_piezos(load, group):
    families, cores = load('foreign.families'), load('foreign.cores')
    make_core = load('foreign.stage').make_core
    for name in dict.fromkeys(families.SETS[group]):
        core = make_core(name, np.random.default_rng(5))
        _, rise, fall = cores.steady_loop(core)
        assert [rise[0], rise[-1]] == pytest.approx([0.0, 1.0], abs=1e-6)
        assert np.diff(rise).min() > 0
        assert np.diff(fall).min() > 0
        # the stage lags
        assert 0.0799 < (fall - rise).max() < 0.1801
        assert 0.0005 < cores.unlike_plays(core) < 0.01


def stage_of(load, law):
    """Return a stage of a core without noise."""
    module = load('foreign.stage')
    stage = module.make_stage('preisach', 3)
    core = replace(stage.core, law=law, line=0.6, share=0.4, level=0.0)
    return replace(stage, core=core, rate=10_000.0, noise='white', noise_rms=0.0)


def test_plays_reach_a_stage_of_plays(load):
    references, cores = load('foreign.references'), load('foreign.cores')
    motion = load('foreign.motion')
    stage = stage_of(load, lambda u: cores.play(u, 0.2) + 0.5 * cores.play(u, 0.6))
    records = {}
    for name in ('identification', 'diagnosis', 'unseen'):
        moved = motion.record_motion(
            name, stage.rate, np.random.default_rng(1), labelled=False, first=400.0
        )
        v = stage.limits[0] + np.ptp(stage.limits) * moved.u
        records[name] = v, stage.respond(v, name, clean=True)
    found = references.references(stage, records, ('ten plays', 'forty plays'))
    assert found['ten plays'].unseen < 0.01
    assert found['forty plays'].unseen < 0.02


def test_linear_part_has_gain_one_and_its_delay(load):
    module = load('foreign.stage')
    linear = module.Linear(((300.0, 0.05, 0.9), (700.0, 0.05, 0.1)), 2000.0, 2.5e-4)
    rate, n = 10_000.0, 10_000
    y = linear(np.where(np.arange(n) < 100, 0.0, 1.0), rate)
    assert y[-1] == pytest.approx(1.0, abs=1e-6)
    x = np.sin(2 * np.pi * 40.0 * np.arange(n) / rate)
    late = linear(x, rate, later=1e-4 / 3)[5000:] - linear(x, rate)[5000:]
    slope = np.cos(2 * np.pi * 40.0 * np.arange(n) / rate).std() * 2 * np.pi * 40.0
    assert late.std() == pytest.approx(slope * 1e-4 / 3, rel=0.05)


def test_offset_and_gain_are_no_effect(load):
    size_of = load('foreign.sizes').size_of
    y = np.random.default_rng(0).uniform(0, 1, 1000)
    assert size_of(0.3 * y - 2.0, y) == pytest.approx(0.0, abs=1e-9)
    assert size_of(0.01 * np.sin(np.arange(1000.0)), y) == pytest.approx(0.707, rel=0.02)


def test_blocks_of_cases_hold_every_kind(load):
    case = load('foreign.case')
    for group in case.CASES:
        cases = [case.draw(group, k) for k in range(case.CASES[group])]
        assert len({c.key for c in cases}) == len(cases)
        for k in range(0, len(cases), case.BLOCK):
            kinds = [c.kind for c in cases[k : k + case.BLOCK]]
            assert [kinds.count(x) for x in ('none', 'pair', 'fault')] == [6, 2, 2]
        labelled = sum(c.labelled for c in cases)
        assert labelled == 2 * len(cases) // 3


@pytest.mark.parametrize(
    ('said', 'truth', 'expected'),
    [
        ({'verdict': 'named', 'effects': ('creep',)}, {'creep': 1.0}, 'named'),
        ({'verdict': 'named', 'effects': ('creep', 'backlash')}, {'creep': 1.0}, 'false'),
        ({'verdict': 'partly_explained', 'effects': ('creep',)}, {'creep': 1.0}, 'named'),
        ({'verdict': 'partly_explained', 'effects': ('creep',)}, {'backlash': 1.0}, 'false'),
        (
            {'verdict': 'class', 'effects': ('creep',), 'group': ('creep', 'backlash')},
            {'backlash': 1.0},
            'class',
        ),
        (
            {'verdict': 'class', 'effects': ('creep',), 'group': ('creep', 'saturation')},
            {'backlash': 1.0},
            'false',
        ),
        ({'verdict': 'refitted', 'group': ('backlash',)}, {'backlash': 1.0}, 'hidden'),
        ({'verdict': 'refitted'}, {'backlash': 1.0}, 'abstained'),
        ({'verdict': 'unexplained'}, {'backlash': 1.0}, 'abstained'),
        ({'verdict': 'none'}, {'backlash': 0.1}, 'none'),
        ({'verdict': 'none'}, {'periodic_disturbance': 0.1}, 'abstained'),
        ({'verdict': 'named', 'effects': ('backlash',)}, {'backlash': 0.1}, 'small'),
        ({'verdict': 'named', 'effects': ('backlash',)}, {}, 'false'),
        ({'verdict': 'none'}, {}, 'none'),
        (
            {'verdict': 'named', 'effects': ('creep',)},
            {'creep': 1.0, 'backlash': 1.0},
            'part',
        ),
    ],
)
def test_outcome_of_a_row(load, said, truth, expected):
    study = load('study_foreign')
    row = study.Row('tuning-000 preisach x labelled', misfit=0.5, truth=truth, **said)
    assert study.outcome(row) == expected


def test_faults_of_the_data_are_named_by_the_record(load):
    study = load('study_foreign')
    row = study.Row('k', 'none', fault='stuck', faults=('stuck', 'timing_jitter'), misfit=0.5)
    assert study.outcome(row) == 'named'
    assert study.false_faults(row) == ('timing_jitter',)
    assert study.outcome(replace(row, effects=('creep',))) == 'false'
    assert study.outcome(replace(row, faults=())) == 'abstained'
