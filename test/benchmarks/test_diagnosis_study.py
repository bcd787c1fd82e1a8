# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stages of another family and the rules by which a diagnosis of them is counted."""

import csv
from dataclasses import replace
from itertools import pairwise
import json
from pathlib import Path

import numpy as np
import pytest
import study_diagnosis as study
from study_rows import read_rows, write_cases
from truths import (
    cases,
    cores,
    families,
    make_family_stage,
    preisach,
    record_motion,
    references,
    sealed,
)
from truths.linear import Linear
from truths.sizes import size_of

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / 'benchmarks'


def test_preisach_operator_is_the_sum_of_its_relays(monkeypatch):
    cells = 30
    monkeypatch.setattr(preisach, 'CELLS', cells)

    def density(a, b):
        return np.exp(-3 * (a - b)) * (1.0 + 0.8 * (a + b - 1.0))

    rng = np.random.default_rng(4)
    levels = np.concatenate([[0.0], rng.uniform(0.0, 1.0, 60), [1.0, 0.5]])
    u = np.concatenate([np.linspace(x, y, 4) for x, y in pairwise(levels)])
    found = preisach.preisach(density)(u)
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
def test_cores_are_those_of_piezos(group):
    for name in dict.fromkeys(cases.SETS[group][2]):
        core = families.make_core(name, np.random.default_rng(5))
        _, rise, fall = families.steady_loop(core)
        assert [rise[0], rise[-1]] == pytest.approx([0.0, 1.0], abs=1e-6)
        assert np.diff(rise).min() > 0
        assert np.diff(fall).min() > 0
        # the stage lags
        assert 0.0799 < (fall - rise).max() < 0.1801
        assert 0.0005 < families.unlike_plays(core) < 0.01


def test_laws_of_the_final_set_are_in_no_other():
    others = {name for group in ('tuning', 'known') for name in cases.SETS[group][2]}
    assert not set(families.SEALED) & others


def tour(levels, count=400, bend=1.0):
    """Return u from level to level, and where it is at each."""
    way = np.linspace(0.0, 1.0, count + 1)[1:] ** bend
    u = np.concatenate([levels[:1], *(a + (b - a) * way for a, b in pairwise(levels))])
    return u, np.arange(len(levels)) * count


#: a full cycle, and a loop from 0.6 to 0.3 on the way up
ROUND = [0.0, 1.0, 0.0, 0.6, 0.3, 0.6, 1.0, 0.0]


def test_laws_of_the_final_set_know_no_time():
    levels = [*ROUND, *np.random.default_rng(2).uniform(0.0, 1.0, 20)]
    for name in families.SEALED:
        law = families.LAWS[name](np.random.default_rng(5))
        (slow, at), (fast, then) = tour(levels, 1200), tour(levels, 150, 1.7)
        z = law(slow)[at]
        assert law(fast)[then] == pytest.approx(z, abs=1e-5 * np.ptp(z)), name


def test_a_moment_follows_its_field_on_a_tractrix():
    one, r, bow, middle = np.ones(1), 0.15, 1.5, 0.4
    u, at = tour(ROUND)
    # a straight way: a play
    z = sealed.dragged_moments_of(middle, r * one, 0.0 * one, one, 1e9)(u)
    expected = families.play(u, 2.0 * r) + r - middle
    assert z[at[1] :] == pytest.approx(expected[at[1] :], abs=1e-9)
    # a bent one: drawn back onto the circle after every small step
    z = sealed.dragged_moments_of(middle, r * one, bow * one, one, 1e9)(u)
    fine = tour(ROUND, 8000)[0]
    x = fine[0] - middle
    moment, expected = np.array([x, bow * x * x]), []
    for x in fine - middle:
        behind = np.array([x, bow * x * x]) - moment
        far = np.hypot(*behind)
        if far > r:
            moment = moment + behind * (1.0 - r / far)
        expected.append(moment[0])
    assert z == pytest.approx(np.array(expected)[::20], abs=2e-4)
    # what was across is not found again
    u, at = tour([0.0, 1.0, 0.4, 1.0, 0.4, 1.0])
    z = sealed.dragged_moments_of(middle, 0.3 * one, bow * one, one, 1e9)(u)
    assert z[at[5]] - z[at[3]] > 1e-3
    # a step that is lost to rounding is none
    tiny = np.repeat(u, 2)
    tiny[1::2] += 1e-18
    assert sealed.dragged_moments_of(middle, 0.3 * one, bow * one, one, 1e9)(tiny)[::2] == (
        pytest.approx(z, abs=1e-12)
    )


def rested(u, bias, friction, bonds):
    """Return the share of spins that are up, by trying every spin after every move."""
    up, field, found = np.zeros(bias.size, dtype=bool), u[0], []
    for x in u:
        while True:
            own = bias + bonds @ np.where(up, 1.0, -1.0)
            turn = np.where(up, -own - friction, friction - own)
            over = np.where(up, turn - field, field - turn)
            if over.max() >= 0.0:
                up[np.argmax(over)] ^= True
            elif field == x:
                break
            else:
                ahead = turn[~up].min(initial=x) if x > field else turn[up].max(initial=x)
                field = min(x, ahead) if x > field else max(x, ahead)
        found.append(up.mean())
    return np.array(found)


def test_a_spin_goes_back_where_its_neighbours_come():
    count = sealed.NEAR
    bias, bond = np.full(count, -100.0), np.zeros((count, 1))
    # one between two that are drawn away from it by 0.1, and it from each of them
    bias[:3], bond[:2, 0] = (-0.34, -0.39, -0.36), -0.1
    # it comes at 0.2 and takes theirs to 0.45 and 0.47, where it goes back until 0.6; on the fall
    # they go at 0.25 and 0.23, where it comes again until 0.18
    u = [0.0, 0.19, 0.21, 0.44, 0.46, 0.48, 0.59, 0.61, 0.59, 0.57, 0.26, 0.24, 0.22, 0.17]
    up = [0, 0, 1, 1, 2, 2, 2, 3, 3, 2, 2, 1, 1, 0]
    law = sealed.random_bonds_of(bias, np.full(count, 0.01), bond)
    assert law(np.array(u)) * count == pytest.approx(np.array(up, float))


def test_spins_remember_an_extreme_where_all_bonds_are_for_one_way():
    rng, count = np.random.default_rng(7), 12 * sealed.NEAR
    bias = -rng.uniform(-0.5, 1.5, count)
    friction = 0.1 * np.exp(0.5 * rng.standard_normal(count))
    bond = 0.2 * rng.standard_normal((count, 3))
    u, at = tour([*ROUND, *rng.uniform(0.0, 1.0, 6)], 60)
    moved = {}
    for name, own in (('none', 0.0 * bond), ('one way', 0.1 * abs(bond)), ('both', bond)):
        whole = np.zeros((count, count))
        for d in range(3):
            for i in range(count):
                j = (i + d + 1) % count
                whole[i, j] = whole[j, i] = own[i, d]
        z = sealed.random_bonds_of(bias, friction, own)(u)
        assert z == pytest.approx(rested(u, bias, friction, whole), abs=1e-12), name
        moved[name] = abs(z[at[5]] - z[at[3]])
    assert moved['none'] == moved['one way'] == 0.0
    assert moved['both'] > 0.0


def test_a_slider_slips_where_its_load_lets_it():
    one, stiff, limit, lean, bend = np.ones(1), 1.5, 0.12, 0.5, 0.2
    u, at = tour(ROUND)
    law = sealed.loaded_sliders_of(stiff * one, limit * one, lean, bend)
    x = law(u)
    most = limit * (1.0 + lean * (2.0 * x - 1.0))
    force = u - x - bend * (x * x - x)
    assert np.all(abs(force) <= most + 1e-9)
    rise, fall = slice(0, at[1] + 1), slice(at[1], at[2] + 1)
    held = np.minimum(stiff * x[rise], most[rise])
    assert force[rise] == pytest.approx(held, abs=1e-9)
    held = np.maximum(force[at[1]] + stiff * (x[fall] - x[at[1]]), -most[fall])
    assert force[fall] == pytest.approx(held, abs=1e-9)
    # every loop closes, and the next rise goes on as if there were none
    assert x[at[5]] == pytest.approx(x[at[3]], abs=1e-9)
    whole = law(tour([0, 1, 0, 1])[0])
    assert x[at[6]] == pytest.approx(whole[-1], abs=1e-9)


def test_a_slope_is_shared_by_the_gap_ahead():
    middle, apart, broad, wider = 0.5, 0.2, 0.8, 1.05
    law = cores.law_of(sealed._gap_shares, middle, apart, broad, wider)

    def limiting(u):
        lower = (u - middle - 0.5 * apart) / broad
        upper = (u - middle + 0.5 * apart) / (broad * wider)
        return lower / np.sqrt(1.0 + lower**2), upper / np.sqrt(1.0 + upper**2)

    # a branch that has come to its limiting one stays there
    u, at = tour([0.0, 3.0, -0.3, 1.5], 4000)
    z = law(u)
    lower, upper = limiting(u)
    assert np.all(z[at[1] :] <= upper[at[1] :] + 1e-6)
    assert np.all(z[at[1] :] >= lower[at[1] :] - 1e-6)
    on = law(np.array([0.0, 3.0, 1.5, 1.0, 0.5, 0.0]))[2:]
    assert on == pytest.approx(limiting(np.array([1.5, 1.0, 0.5, 0.0]))[1], abs=1e-3)
    # else it has its slope by the share of the gap
    for way, aim, other in ((slice(at[2], at[3]), 1, 0), (slice(at[1], at[2]), 0, 1)):
        ends = limiting(u[way])
        slope = np.gradient(ends[other], u[way])
        share = (ends[aim] - z[way]) / (ends[aim] - ends[other])
        found = np.gradient(z[way], u[way])
        assert found[5:-5] == pytest.approx((slope * share)[5:-5], abs=2e-3)
    # every loop goes on
    u, at = tour(ROUND)
    z = law(u)
    assert abs(z[at[5]] - z[at[3]]) > 1e-3


def stage_of(law):
    """Return a stage of a core without noise."""
    stage = make_family_stage('preisach', 3)
    core = replace(stage.core, law=law, line=0.6, share=0.4, level=0.0)
    return replace(stage, core=core, rate=10_000.0, noise='white', noise_rms=0.0)


def test_plays_reach_a_stage_of_plays():
    stage = stage_of(lambda u: families.play(u, 0.2) + 0.5 * families.play(u, 0.6))
    records = {}
    for name in ('identification', 'diagnosis', 'unseen'):
        moved = record_motion(
            name, stage.rate, np.random.default_rng(1), labelled=False, first=400.0
        )
        v = stage.limits[0] + np.ptp(stage.limits) * moved.u
        records[name] = v, stage.respond(v, name, clean=True)
    found = references(stage, records, ('ten plays', 'forty plays'))
    assert found['ten plays'] < 0.01
    assert found['forty plays'] < 0.02


def test_linear_part_has_gain_one_and_its_delay():
    linear = Linear(((300.0, 0.05, 0.9), (700.0, 0.05, 0.1)), 2000.0, 2.5e-4)
    rate, n = 10_000.0, 10_000
    y = linear(np.where(np.arange(n) < 100, 0.0, 1.0), rate)
    assert y[-1] == pytest.approx(1.0, abs=1e-6)
    x = np.sin(2 * np.pi * 40.0 * np.arange(n) / rate)
    late = linear(x, rate, later=1e-4 / 3)[5000:] - linear(x, rate)[5000:]
    slope = np.cos(2 * np.pi * 40.0 * np.arange(n) / rate).std() * 2 * np.pi * 40.0
    assert late.std() == pytest.approx(slope * 1e-4 / 3, rel=0.05)


def test_offset_and_gain_are_no_effect():
    y = np.random.default_rng(0).uniform(0, 1, 1000)
    assert size_of(0.3 * y - 2.0, y) == pytest.approx(0.0, abs=1e-9)
    assert size_of(0.01 * np.sin(np.arange(1000.0)), y) == pytest.approx(0.707, rel=0.02)


def test_blocks_of_cases_hold_every_kind():
    for group in cases.CASES:
        drawn = [cases.draw(group, k) for k in range(cases.CASES[group])]
        assert len({c.key for c in drawn}) == len(drawn)
        for k in range(0, len(drawn), cases.BLOCK):
            kinds = [c.kind for c in drawn[k : k + cases.BLOCK]]
            assert [kinds.count(x) for x in ('none', 'pair', 'fault')] == [6, 2, 2]
        labelled = sum(c.labelled for c in drawn)
        assert labelled == 2 * len(drawn) // 3


@pytest.mark.parametrize(
    ('verdict', 'effects', 'group', 'truth', 'expected'),
    [
        ('named', 'creep', '', {'creep': 1.0}, 'named'),
        ('named', 'creep backlash', '', {'creep': 1.0}, 'false'),
        ('named', 'backlash', '', {'backlash': 0.1}, 'small'),
        ('named', 'backlash', '', {}, 'false'),
        ('named', 'creep', '', {'creep': 1.0, 'backlash': 1.0}, 'part'),
        ('partly_explained', 'creep', '', {'creep': 1.0}, 'named'),
        ('partly_explained', 'creep', '', {'backlash': 1.0}, 'false'),
        ('class', 'creep', 'creep backlash', {'backlash': 1.0}, 'class'),
        ('class', 'creep', 'creep saturation', {'backlash': 1.0}, 'false'),
        ('refitted', '', 'backlash', {'backlash': 1.0}, 'hidden'),
        ('refitted', '', '', {'backlash': 1.0}, 'abstained'),
        ('unexplained', '', '', {'backlash': 1.0}, 'abstained'),
        ('none', '', '', {'backlash': 0.1}, 'none'),
        ('none', '', '', {'periodic_disturbance': 0.1}, 'abstained'),
        ('none', '', '', {}, 'none'),
    ],
)
def test_outcome_of_a_row(verdict, effects, group, truth, expected):
    row = study.Row('tuning-000 preisach x labelled', verdict, misfit=0.5, truth=truth)
    row = replace(row, effects=tuple(effects.split()), group=tuple(group.split()))
    assert study.outcome(row) == expected


def test_faults_of_the_data_are_named_by_the_record():
    row = study.Row('k', 'none', fault='stuck', faults=('stuck', 'timing_jitter'), misfit=0.5)
    assert study.outcome(row) == 'named'
    assert study.false_faults(row) == ('timing_jitter',)
    assert study.outcome(replace(row, effects=('creep',))) == 'false'
    assert study.outcome(replace(row, faults=())) == 'abstained'


def test_the_smallest_dynamics_of_those_that_do_as_well_are_chosen():
    # small loops open less than H says: orders of eleven fit that, for 1 % of the error
    records = study.case_records(cases.draw('known', 48), forms=False)
    model = study.identify(records.identification).model
    assert model.dynamics.a.size <= 4
    ((_, error),) = study.unseen_errors(records.unseen, model)
    assert error < 0.18


def test_the_cases_of_a_page_are_in_the_file_beside_it(tmp_path):
    row = study.Row(
        'final-000 gap-shares creep labelled',
        'class',
        effects=('creep',),
        group=('creep', 'thermal_drift'),
        truth={'creep': 0.4, 'backlash': 0.1},
        left={'creep': 0.3, 'backlash': 0.05},
        misfit=0.2,
    )
    link = write_cases(tmp_path / 'page.md', study.CASE_HEADS, [study.case_line(row)])
    assert '(page.csv)' in link
    with (tmp_path / 'page.csv').open(encoding='utf-8', newline='') as file:
        (found,) = csv.DictReader(file)
    assert found['class'] == 'creep, thermal_drift'
    assert found['size (left by a refit)'] == '0.40 (0.30), 0.10 (0.05)'
    assert found['outcome'] == study.outcome(row)


def test_rows_that_were_kept_before_are_counted(tmp_path):
    (case,) = (c for c in cases.sum_cases('first-sums') if c.key == 'one creep 0.3 1 white')
    kept = {'key': case.key, 'verdict': 'named', 'found': ['creep'], 'group': [], 'size': 0.31}
    (tmp_path / 'rows.jsonl').write_text(json.dumps(kept | {'unseen_before': 0.4}) + '\n')
    rows = read_rows(tmp_path / 'rows.jsonl', study.Row)
    row = study.with_truth(rows[case.key], case)
    assert row.truth == {'creep': 0.31} and row.centred_before == 0.4
    assert study.outcome(row) == 'named'


def test_an_effect_that_is_no_candidate_is_not_asked_for():
    row = study.Row('outside memory_fade 0.3 21 white', 'unexplained', truth={'memory_fade': 0.3})
    row = replace(row, misfit=0.1, left=row.truth)
    assert study.outcome(row) == 'abstained' and not study.is_candidate(row)
    assert 'no candidate: a false name | 0 of 1' in study.summary([row])


@pytest.mark.parametrize('name', ['diagnosis_study', 'diagnosis_study_foreign'])
def test_a_page_counts_the_lines_of_its_file(name):
    page = (ROOT / f'docs/{name}.md').read_text(encoding='utf-8')
    with (ROOT / f'docs/{name}.csv').open(encoding='utf-8', newline='') as file:
        lines = list(csv.DictReader(file))
    assert f'{len(lines)} of {len(lines)} cases' in page
    assert f'({name}.csv), {len(lines)} lines' in page
