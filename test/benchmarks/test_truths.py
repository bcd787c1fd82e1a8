# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The stages that judge a diagnosis: independent, repeatable, of the wanted size."""

import ast
from pathlib import Path
import sys

import numpy as np
import pytest
import truths
from truths.cores import everett, plays, Row
from truths.linear import Cascade, delayed, RATE, relaxation
from truths.references import remainder
from truths.stage import make_base, VOLTS
from truths.table_one import table_one_stage

ROOT = Path(__file__).resolve().parents[2]
NAMES = truths.EFFECTS + truths.OUTSIDE


@pytest.fixture(scope='module')
def record():
    t, v, labels = truths.program('diagnosis', 1)
    return t, v, labels, truths.other_axis(t, np.random.default_rng(1))


@pytest.fixture(scope='module')
def short():
    t = np.arange(12000) / RATE
    v = 5 - 5 * np.cos(2 * np.pi * 5 * t)
    return t, v, truths.other_axis(t, np.random.default_rng(1))


def test_the_truths_know_nothing_of_the_package():
    files = sorted((ROOT / 'benchmarks' / 'truths').glob('*.py'))
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or '']
            tops = {name.partition('.')[0] for name in names}
            known = {'numpy', 'scipy', 'numba', 'yaml'} | set(sys.stdlib_module_names)
            assert tops <= known, f'{path.name} imports {tops - known}'
        assert 'import_module' not in path.read_text(encoding='utf-8')


@pytest.mark.parametrize('name', NAMES)
def test_same_seed_same_record(name, short):
    t, v, other = short
    runs = [
        truths.make_stage(name, 0.3, 2).respond(t, v, channels={'other': other}) for _ in range(2)
    ]
    np.testing.assert_array_equal(*runs)
    assert np.all(np.isfinite(runs[0]))
    another = truths.make_stage(name, 0.3, 2).respond(t, v, channels={'other': other}, take=1)
    assert np.any(another != runs[0])


@pytest.mark.parametrize('name', truths.LATER)
def test_what_sets_in_later_was_not_there_before(name, short):
    t, v, _ = short
    stage, plain = truths.make_stage(name, 0.3, 3), truths.make_stage(None, 0.3, 3)
    before = stage.respond(t, v, changed=False)
    np.testing.assert_array_equal(before, plain.respond(t, v))
    assert np.std(stage.respond(t, v) - before) > 0


def refits(base, v):
    """Return what a refit of offset, v, v^3 and 40 plays can do, every eighth sample."""
    u, rows = v / VOLTS, (np.arange(40) + 0.5) / 40
    parts = [u, u**3, *(plays(u, Row(np.array([r]), np.ones(1))) for r in rows)]
    columns = [np.ones(u.size), *(delayed(base.dynamics(x), base.delay) for x in parts)]
    return np.stack([x[::8] for x in columns], axis=1)


def test_the_size_of_every_effect(record):
    t, v, _, other = record
    X = refits(make_base(1), v)
    plain = truths.make_stage(None, 0.0, 1).respond(t, v, clean=True)
    for name in NAMES:
        stage = truths.make_stage(name, 0.3, 1)
        y = stage.respond(t, v, channels={'other': other}, clean=True)
        left = 100 * remainder(X, (y - plain)[::8]) / np.ptp(plain)
        assert 0.1 < left < 0.9, f'{name}: {left:.3f} % of stroke is left'


def test_the_base_is_one_that_plays_can_follow(record):
    t, v, *_ = record
    for seed in range(2):
        stage = truths.make_stage(None, 0.0, seed)
        y = stage.respond(t, v, clean=True)[::8]
        assert remainder(refits(stage.base, v), y) < 3e-4 * np.ptp(y)
        assert 0.1 < stage.base.density.width() < 0.15


def test_the_two_cores_agree():
    # the Everett staircase is exact; 240 plays miss by the square of their distance
    rng = np.random.default_rng(5)
    corners = np.concatenate([[0.0], rng.uniform(0, 1, 60), [0.0]])
    u = np.interp(np.arange(6001) / 100, np.arange(corners.size), corners)
    density = make_base(4).density
    np.testing.assert_allclose(everett(u, density), plays(u, density), atol=3e-5)


def test_linear_parts_against_formulas():
    t = np.arange(40000) / RATE
    step = np.ones(t.size)
    f, zeta = 400.0, 0.05
    y = Cascade(((f, zeta, 1.0),))(step)
    w, wd = 2 * np.pi * f, 2 * np.pi * f * np.sqrt(1 - zeta**2)
    exact = 1 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))
    np.testing.assert_allclose(y, exact, atol=1e-9)
    crept = relaxation(np.concatenate([[0.0], step]), 'log', 0.01)[1:]
    np.testing.assert_allclose(crept[1000:], 1 + 0.01 * np.log1p(t[1000:] / 0.02), atol=2e-4)
    x = 1 - np.cos(2 * np.pi * 200 * t)
    moved = delayed(x, 2.4 / RATE)
    late = 1 - np.cos(2 * np.pi * 200 * (t - 2.4 / RATE))
    np.testing.assert_allclose(moved[100:-100], late[100:-100], atol=1e-5)


def test_noise_has_its_size(short):
    t, v, _ = short
    for noise in ('white', '1/f'):
        stage = truths.make_stage(None, 0.0, 1, noise=noise, noise_rms=1e-4)
        e = (stage.respond(t, v) - stage.respond(t, v, clean=True)) / truths.SPAN
        assert np.std(e) == pytest.approx(1e-4, rel=0.05)
    y = truths.make_stage(None, 0.0, 1, noise='10-bit').respond(t, v) / truths.SPAN * 1024
    np.testing.assert_allclose(y, np.rint(y), atol=1e-6)


def test_table_one_stage_is_fixed():
    t = np.arange(20000) / RATE
    v = 5 - 5 * np.cos(2 * np.pi * 5 * t)
    stage = table_one_stage(1)
    np.testing.assert_array_equal(stage.respond(t, v), table_one_stage(1).respond(t, v))
    still = table_one_stage(1, rate={'gain': 0.0}, creep={'gain': 0.0})
    change = stage.respond(t, v, clean=True) - still.respond(t, v, clean=True)
    assert 0.005 < np.std(change) / np.ptp(still.respond(t, v)) < 0.2
