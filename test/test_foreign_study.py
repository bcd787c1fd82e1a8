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


@pytest.mark.parametrize('group', ['tuning', 'known', 'final'])
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


def test_laws_of_the_final_set_are_in_no_other(load):
    sets = load('foreign.families').SETS
    assert not set(sets['final']) & {*sets['tuning'], *sets['known']}


def tour(levels, count=400, bend=1.0):
    """Return u from level to level, and where it is at each."""
    way = np.linspace(0.0, 1.0, count + 1)[1:] ** bend
    u = np.concatenate([levels[:1], *(a + (b - a) * way for a, b in pairwise(levels))])
    return u, np.arange(len(levels)) * count


#: a full cycle, and a loop from 0.6 to 0.3 on the way up
ROUND = [0.0, 1.0, 0.0, 0.6, 0.3, 0.6, 1.0, 0.0]


def test_final_laws_know_no_time(load):
    families = load('foreign.families')
    levels = [*ROUND, *np.random.default_rng(2).uniform(0.0, 1.0, 20)]
    for name in dict.fromkeys(families.SETS['final']):
        law = families.LAWS[name](np.random.default_rng(5))
        (slow, at), (fast, then) = tour(levels, 1200), tour(levels, 150, 1.7)
        z = law(slow)[at]
        assert law(fast)[then] == pytest.approx(z, abs=1e-5 * np.ptp(z)), name


def test_moving_relays_are_classical_ones_in_their_own_field(load):
    cores, unseen = load('foreign.cores'), load('foreign.unseen_cores')
    table, diagonal = cores.everett_table(lambda a, b: np.exp(-4.0 * (a - b)) * (1.4 - a - b) ** 2)
    table, diagonal = table / table[-1, 0], diagonal / table[-1, 0]
    u, at = tour([*ROUND, 0.8, 0.3, 0.6, 0.3])
    for feedback in (-0.3, 0.5):
        h = unseen.moving_of(feedback, table, diagonal)(u)
        field = (u + feedback * h) / (1.0 + feedback)
        classical = unseen.moving_of(0.0, table, diagonal)
        assert classical(field) == pytest.approx(h, abs=1e-9)
        # a loop that is closed is forgotten
        assert h[at[5]] == pytest.approx(h[at[3]], abs=1e-9)
        # loops over the same range rise unequally on the two branches
        rises = h[at[[5, 10]]] - h[at[[4, 9]]]
        assert abs(rises[1] - rises[0]) > 5e-4
        equal = classical(u)
        assert equal[at[5]] - equal[at[4]] == pytest.approx(equal[at[10]] - equal[at[9]])


def test_a_contact_slides_at_its_load(load):
    contacts_of = load('foreign.unseen_cores').contacts_of
    one = np.array([1.0])
    u, at = tour(ROUND)
    x = contacts_of(20.0 * one, 0.1 * one, 1.5 * one, 0.5, 0.0, 0.0)(u)
    # u - x = 0.5 x +- 0.1 (1 + 1.5 x)
    rise, fall = (u - 0.1) / 1.65, (u + 0.1) / 1.35
    assert x[at[2] + 200 : at[3]] == pytest.approx(rise[at[2] + 200 : at[3]], abs=1e-12)
    assert x[at[1] + 200 : at[2]] == pytest.approx(fall[at[1] + 200 : at[2]], abs=1e-12)
    assert x[at[5]] == pytest.approx(x[at[3]], abs=1e-12)
    # held behind the turn
    start = x[at[3] + 1] - x[at[3]]
    assert start == pytest.approx((u[at[3] + 1] - u[at[3]]) / 21.5)
    stiffer = contacts_of(20.0 * one, 0.1 * one, 1.5 * one, 0.5, 2.0, 0.0)(u)
    balance = u - stiffer - 0.5 * (stiffer + 2.0 * stiffer**3 / 3.0)
    assert np.abs(balance).max() <= 0.1 * (1.0 + 1.5 * stiffer.max()) + 1e-12


def test_cells_in_a_field_that_does_not_turn_are_plays(load):
    cores, unseen = load('foreign.cores'), load('foreign.unseen_cores')
    reach, weight = np.array([0.1, 0.3]), np.array([1.0, 0.5])
    u, at = tour(ROUND)
    straight = unseen.turning_friction_of(0.0, reach, weight, 1e6)(u)
    plays = sum(w * (cores.play(u, 2 * r) + r - 0.5) for r, w in zip(reach, weight, strict=True))
    assert straight[at[1] :] == pytest.approx(plays[at[1] :], abs=1e-9)
    u, at = tour([*ROUND, 0.6, 0.3, 0.6])
    turned = unseen.turning_friction_of(0.6, reach, weight, 1.0)(u)
    # a loop leaves the cells beside where they were
    assert 1e-5 < abs(turned[at[5]] - turned[at[3]]) < 0.05
    # a full cycle brings them back
    again = turned[at[[8, 9, 10]]]
    assert again == pytest.approx(turned[at[[3, 4, 5]]], abs=2e-3)


def test_a_wall_falls_from_well_to_well(load):
    walls_of = load('foreign.unseen_cores').walls_of
    wall = walls_of(np.array([[0.0, 0.6, 1.0]]), np.array([[1.0, 0.5]]))
    # it leaves the first well at 0.6 + 0.5 * 0.6 / 2, the second at 0.6 - 0.5 * 0.4 / 2
    u = np.array([0.0, 0.6, 0.899, 0.901, 1.0, 0.51, 0.49, 0.51])
    first, second = (u + 0.3) / 2.0, (u + 0.5 * 0.8) / 1.5
    expected = np.where([1, 1, 1, 0, 0, 0, 1, 1], first, second)
    assert wall(u) == pytest.approx(expected)
    many = load('foreign.unseen_cores').rugged_walls(np.random.default_rng(5))
    u, at = tour(ROUND)
    z = many(u)
    assert z[at[5]] == pytest.approx(z[at[3]], abs=1e-9)


def test_dipoles_that_hinder_one_another_do_not_come_back(load):
    unseen = load('foreign.unseen_cores')
    rng, strides = np.random.default_rng(7), np.array([1, 30])
    field, coercive = rng.uniform(-0.2, 1.2, 1000), rng.uniform(0.05, 0.4, 1000)
    bonds = 0.3 * rng.standard_normal((2, 1000))
    u, at = tour(ROUND)
    alone = unseen.dipoles_of(field, coercive, 0.0 * bonds, strides)(u)
    up, expected = np.zeros(1000, dtype=bool), []
    for x in u:
        up = (up | (x >= field + coercive)) & (x > field - coercive)
        expected.append(up.mean())
    assert alone == pytest.approx(np.array(expected))
    helped = unseen.dipoles_of(field, coercive, np.abs(bonds), strides)(u)
    assert helped[at[[5, 6]]] == pytest.approx(helped[at[[3, 1]]], abs=1e-12)
    hindered = unseen.dipoles_of(field, coercive, bonds, strides)
    z = hindered(u)
    assert 1e-4 < abs(z[at[6]] - z[at[1]]) < 0.05
    # one flips after another, however long a step is
    assert hindered(u[at])[-1] == z[-1]


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
