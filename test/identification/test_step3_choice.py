# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Which law H gets, on truths that are no sums of plays: relays, Bouc-Wen, Duhem, and plays."""

from functools import cache
from itertools import pairwise

import numpy as np
from paper_stage import A, B
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.step3_choice import choose_law, choose_thresholds, with_small
from piezo_ident.identification.step3_hysteresis import even_thresholds, factorise, fit_hysteresis
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

G, D = Dynamics(A, B).normalised(), Delay(3)


def legs(*levels, speed=2e-3):
    """Go straight from level to level."""
    parts = [np.linspace(a, b, 2 + round(abs(b - a) / speed))[1:] for a, b in pairwise(levels)]
    return np.concatenate([[levels[0]], *parts])


TRIANGLE = legs(0, 0, 1 / 3, 0, 2 / 3, 0, 1, 0)
GROWING = legs(0.5, 0.6, 0.4, 0.7, 0.3, 0.8, 0.2, 0.9, 0.1, 1, 0)
SLOW = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(3000) / 1500)
SMALL = 0.5 - 0.2 * np.cos(2 * np.pi * np.arange(1500) / 500)
WIDE = np.concatenate(
    [
        legs(0, 1, 0),
        SLOW,
        legs(0, 0.5),
        GROWING,
        legs(0, 0.3),
        SMALL,
        legs(0.3, 0.75),
        1.05 - SMALL,
    ]
)
UNSEEN = np.concatenate([legs(0, *np.tile([0.6, 0.12], 3), 0.85, 0.4, 0.95, 0.1), SMALL * 1.2])


def relays(u, density, n=120):
    """Return the sum of relays that rise at a and fall at b <= a, one by one."""
    middle = (np.arange(n) + 0.5) / n
    a, b = np.meshgrid(middle, middle, indexing='ij')
    weight = np.where(a >= b, density(a - b, 0.5 * (a + b)), 0.0)
    state, out = np.zeros((n, n), dtype=bool), np.empty(u.size)
    for k, x in enumerate(u):
        state = (state | (x >= a)) & (x > b)
        out[k] = weight[state].sum()
    return out / weight.sum()


def leaning(width, bias):
    return np.exp(-width / 0.25) * (1.3 - 1.1 * bias + 0.6 * bias**2)


def humped(width, bias):
    return np.exp(-width / 0.2) + np.exp(-(((bias - 0.6) / 0.2) ** 2) - (width - 0.15) ** 2 / 0.02)


def swept(law):
    """Return a law whose stage was swept before, and came down."""
    before = legs(0, 1, 0, 1, 0)
    return lambda u: law(np.concatenate([before, u]))[before.size :]


@swept
def bouc_wen(u, rate=4.0, beta=0.7):
    z, out = 0.0, np.zeros(u.size)
    for k, du in enumerate(np.diff(u), 1):
        z += rate * (du - beta * abs(du) * z - (1 - beta) * du * abs(z))
        out[k] = z
    return -out


@swept
def duhem(u, rate=2.5):
    z, out = 0.0, np.zeros(u.size)
    for k, du in enumerate(np.diff(u), 1):
        c = 2 * u[k] - 1
        z += rate * abs(du) * (c + 0.1 * (1 - c * c) - z) + 0.4 * du
        out[k] = z
    return out


def plays(u):
    r = np.array([0.03, 0.137, 0.3, 0.42, 0.71])
    return Hysteresis(r, [0.1, 0.2, 0.15, 0.1, 0.05], -0.3, 0.6)(u)


CORES = {
    'leaning relays': lambda u: 0.7 * u + 0.8 * relays(u, leaning),
    'humped relays': lambda u: 0.5 * u + 0.5 * relays(u, humped),
    'Bouc-Wen': lambda u: u + 0.25 * bouc_wen(u),
    'Duhem': lambda u: u + 0.2 * duhem(u),
    'plays': plays,
    'fine plays': lambda u: plays(u) + Hysteresis([0.01, 0.02, 0.05], [0.2] * 3, 0.0, 0.0)(u),
}


@cache
def response(core, u):
    """Return what a core makes of a motion, whose bytes are given."""
    return CORES[core](np.frombuffer(u).copy())


def excerpt(core, u, noise=2e-5):
    w = response(core, u.tobytes())
    x = filter_arx(G.a, G.b, D.apply(w / np.ptp(w)))
    x = x + noise * np.random.default_rng(0).standard_normal(u.size)
    return Excerpt(u, x, np.ones(u.size, dtype=bool))


def unseen(law, core, given):
    """Return the error of an H behind the true G on other motion, % of stroke."""
    h = fit_hysteresis(factorise([given], law, G, D), law).hysteresis
    u = np.concatenate([given.u, legs(given.u[-1], 0), UNSEEN])
    w = response(core, u.tobytes())
    w = w / np.ptp(w[: given.u.size])
    return float(100 * np.std((w - h(u))[-UNSEEN.size :]) / np.ptp(w)), h


def best_plays(given):
    out = (np.arange(given.u.size) // 100) % 5 == 2
    parts = (Excerpt(given.u, given.x, use) for use in (~out, out))
    return choose_thresholds(*([part] for part in parts), 1.0, G, D)


@pytest.mark.parametrize('core', ['leaning relays', 'humped relays'])
@pytest.mark.parametrize('u', [TRIANGLE, WIDE])
def test_relays_are_recovered(core, u):
    given = excerpt(core, u)
    choice = choose_law([given], G, D)
    assert choice.law is not None
    assert choice.errors['preisach'] < 0.5 * choice.errors['plays']
    error, h = unseen(choice.law, core, given)
    assert error < 0.5 * unseen(best_plays(given), core, given)[0]
    assert error < (0.15 if core == 'leaning relays' else 0.3)
    assert h.lowest_slope() > 0.0
    assert np.all(np.diff(h(legs(0.0, 1.0))) > 0.0)


@pytest.mark.parametrize('core', ['Bouc-Wen', 'Duhem', 'plays'])
@pytest.mark.parametrize('u', [TRIANGLE, WIDE])
def test_no_choice_is_worse_than_plays_on_other_motion_and_plays_stay_plays(core, u):
    given = excerpt(core, u)
    choice = choose_law([given], G, D)
    if core == 'Duhem':
        assert choice.law.name == 'duhem'
    assert core != 'plays' or choice.law is None
    if choice.law is None:
        return
    ours, of_plays = (unseen(law, core, given)[0] for law in (choice.law, best_plays(given)))
    assert ours < 1.05 * of_plays


@pytest.mark.parametrize('core', ['fine plays', 'plays'])
def test_small_motion_asks_for_smaller_thresholds(core):
    small = 0.03 * np.random.default_rng(1).standard_normal(600).repeat(10)
    whole = excerpt(core, np.concatenate([TRIANGLE, legs(0, 0.5), 0.5 + small]))
    first = np.arange(whole.u.size) < TRIANGLE.size
    fit, other = (Excerpt(whole.u, whole.x, use) for use in (first, ~first))
    # the smallest play of the truth is 0.03
    r = even_thresholds(1.0, 10) if core == 'fine plays' else np.array([0.03, 0.137, 0.3])
    found = with_small(r, [fit], [other], G, D)
    assert np.all(np.diff(found) > 0.0)
    assert found[-r.size :].tolist() == r.tolist()
    assert found.size == r.size + 4 * (core == 'fine plays')
    assert with_small(r, [fit], [], G, D) is r


def test_several_excerpts_have_offsets_of_their_own():
    one = excerpt('leaning relays', TRIANGLE)
    two = Excerpt(one.u, one.x + 7.0, one.use)
    choice = choose_law([one, two, two], G, D)
    assert choice.law is not None
    assert choice.errors['preisach'] < 0.5 * choice.errors['plays']


@pytest.mark.parametrize('count', [6, 7])
def test_any_number_of_excerpts_chooses(count):
    one = excerpt('leaning relays', TRIANGLE)
    assert choose_law([one] * count, G, D).law is not None


def test_noise_chooses_nothing():
    given = excerpt('plays', TRIANGLE, noise=0.01)
    assert choose_law([given], G, D).law is None


def test_creep_is_not_taken_for_lags_along_the_path():
    k = np.arange(12_000)
    small = 0.5 + 0.05 * np.sin(2 * np.pi * k / 200) * (k < 4000)
    u = np.concatenate([TRIANGLE, legs(0, 0.5), small])
    w = CORES['plays'](u)
    creep = sum(c * (filter_arx(np.array([-p]), np.array([1 - p]), w) - w) for c, p in SLOW_POLES)
    x = filter_arx(G.a, G.b, D.apply(w + creep) / np.ptp(w))
    first = np.arange(u.size) < TRIANGLE.size
    triangle, other = (Excerpt(u, x, use) for use in (first, ~first))
    # follows the triangle far better, and says so
    alone = choose_law([triangle], G, D)
    assert alone.errors['duhem'] < 0.75 * alone.errors['plays']
    judged = choose_law([triangle], G, D, others=[other])
    assert judged.law is None or judged.law.name != 'duhem'


SLOW_POLES = ((0.03, 1 - 1 / 300), (0.03, 1 - 1 / 1500))
