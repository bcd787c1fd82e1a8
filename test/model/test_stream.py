# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stream gives the numbers of the single operators, however it is cut."""

from dataclasses import replace
from itertools import pairwise

from effect_table import VISIBLE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS, PAPER
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.model.stream import CHUNK
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import STRETCH
from piezo_ident.record.record import Piece
import pytest

#: effects of every slot that need no further channel
NAMES = sorted(set(VISIBLE) - {'cross_coupling'})


def setting(name) -> EffectSetting:
    return EffectSetting(name, VISIBLE[name])


def signal(n, seed=0):
    rng = np.random.default_rng(seed)
    slow = np.sin(np.arange(n) / 90.0) * np.linspace(0.2, 1.0, n)
    return 5.0 + 4.5 * slow + 0.3 * rng.standard_normal(n)


def unfused(model, v, memory=None):
    """Return what the operators of the chain say one after the other."""
    chain = model.chain(memory)
    u = model.scaling.u(v)
    chain.reset(float(u[0]), float(u[0]))
    t = np.arange(v.size) / model.sample_rate
    return model.scaling.y(chain.process(Block(t=t, v=u, x=u)).x)


def in_blocks(model, v, cuts, memory=None):
    stream, edges = model.stream(memory), [0, *sorted(cuts), v.size]
    return np.concatenate([stream.process(v[a:b]) for a, b in pairwise(edges)])


@st.composite
def models(draw):
    """Stages of any number of thresholds, orders and delays."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, pairs, nb = draw(st.integers(0, 13)), draw(st.integers(0, 5)), draw(st.integers(1, 12))
    radius, angle = 0.95 * rng.random(pairs), np.pi * rng.random(pairs)
    poles = np.concatenate([radius * np.exp(1j * angle), radius * np.exp(-1j * angle)])
    if draw(st.booleans()):
        poles = np.append(poles, -0.5)
    a = np.real(np.poly(poles))[1:] if poles.size else np.empty(0)
    return replace(
        PAPER,
        scaling=replace(PAPER.scaling, y0=3e-6, Y=draw(st.sampled_from([-1.0, 1.0])) * 75e-6),
        hysteresis=Hysteresis(np.sort(rng.random(m) + 1e-3), rng.random(m), 0.3, 0.7),
        dynamics=Dynamics(a, rng.standard_normal(nb)),
        delay=Delay(
            draw(st.sampled_from([0, 1, 3, 40, 2 * STRETCH])),
            draw(st.sampled_from([0.0, 0.3, 0.99])),
        ),
    )


@settings(deadline=None, max_examples=60)
@given(models(), st.lists(st.integers(0, 1500), max_size=12))
def test_equal_to_the_chain_to_the_last_bit_however_cut(model, cuts):
    v = signal(1500)
    expected = unfused(model, v)
    assert np.all(np.isfinite(expected))
    assert_array_equal(in_blocks(model, v, cuts), expected)
    assert_array_equal(model.predict_piece(Piece(v, np.zeros(v.size), FS)), expected)


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.sampled_from(NAMES), unique=True),
    st.lists(st.integers(0, 1200), max_size=8),
    st.sampled_from([0.0, 0.4]),
)
def test_effects_stand_where_they_stood(names, cuts, fraction):
    model = replace(
        PAPER, delay=Delay(3, fraction), effects=tuple(setting(name) for name in names)
    )
    v = signal(1200)
    whole = model.stream().process(v)
    assert_array_equal(whole, unfused(model, v))
    # NumPy's own vector functions may round the end of a block differently
    assert_allclose(in_blocks(model, v, cuts), whole, rtol=0, atol=1e-12 * 75e-6)


@pytest.mark.parametrize('size', [1, 2, 3, 5, 7, 100, STRETCH - 1, STRETCH, STRETCH + 1])
def test_blocks_of_one_size(size):
    v = signal(3 * STRETCH + 11)
    model = replace(PAPER, delay=Delay(2, 0.25))
    assert_array_equal(in_blocks(model, v, range(size, v.size, size)), model.stream().process(v))


def test_memory_that_is_given_counts_and_one_of_another_size_is_refused():
    v = signal(400)
    memory = v[0] / 10.0 - 0.5 * PAPER.hysteresis.thresholds
    assert_array_equal(PAPER.stream(memory).process(v), unfused(PAPER, v, memory))
    assert np.abs(PAPER.stream(memory).process(v) - PAPER.stream().process(v)).max() > 1e-7
    with pytest.raises(ModelError, match='8 play outputs'):
        PAPER.stream(memory[:-1])


def test_lags_that_are_given_count_and_cuts_change_nothing():
    lags = [[2.0, 0.3, 0.1, 0.0], [4.0, -0.1, 0.3, -0.2]]
    model = replace(PAPER, hysteresis=replace(PAPER.hysteresis, relaxations=lags))
    v = signal(1500)
    plays = v[0] / 10.0 - 0.5 * PAPER.hysteresis.thresholds
    starts = [plays, np.append(plays, [0.2, 0.1]), np.append(plays, [0.2, 0.1, v[0] / 10.0])]
    ran = [model.simulate(v, start=start) for start in starts]
    assert_allclose(ran[1], ran[2], rtol=0, atol=1e-18)
    assert np.abs(ran[0] - ran[1]).max() > 1e-7
    for start, whole in zip(starts, ran, strict=True):
        stream = model.stream(start)
        assert_array_equal(
            np.concatenate([stream.process(part) for part in np.split(v, [1, 7, 700])]), whole
        )
        assert_array_equal(unfused(model, v, start), whole)
    for start in (np.append(plays, 0.2), np.append(ran[2], 0.0)):
        with pytest.raises(ModelError, match='2 lags'):
            model.stream(start)


def test_frozen_lists_views_and_integers_are_read_like_any_array():
    v = np.round(signal(2 * CHUNK + 5))
    expected = PAPER.stream().process(v)
    frozen = v.copy()
    frozen.setflags(write=False)
    rows = np.stack([v, v], axis=1)
    for same in (frozen, v.tolist(), rows[:, 1], v.astype(int), v[::-1][::-1]):
        assert_array_equal(PAPER.stream().process(same), expected)
    assert_array_equal(rows[:, 1], v)


def test_a_run_starts_anew_from_rest():
    model = replace(PAPER, delay=Delay(5, 0.5))
    v = signal(700)
    stream = model.stream()
    first = stream.process(v)
    stream.reset(float(v[0]))
    assert_array_equal(stream.process(v), first)
    # two runs know nothing of each other
    one, two = model.stream(), model.stream()
    parts = [(one.process(v[a:b]), two.process(v[a:b] + 1.0)) for a, b in pairwise((0, 9, 700))]
    assert_array_equal(np.concatenate([a for a, _ in parts]), first)


def test_a_number_that_is_none_stays_with_its_own_sample_where_nothing_remembers():
    static = replace(PAPER, dynamics=Dynamics.unit(), delay=Delay(0))
    v = signal(50)
    v[20] = np.nan
    y = static.stream().process(v)
    assert np.flatnonzero(np.isnan(y)).tolist() == [20]


def test_very_long_delay_in_short_blocks():
    d = 100_000
    model = replace(PAPER, delay=Delay(d))
    v = signal(d + 3000)
    y = in_blocks(model, v, range(100, v.size, 100))
    assert_array_equal(y[d:], PAPER_UNDELAYED.stream().process(v)[:3000])
    assert_array_equal(y[:d], np.full(d, y[0]))


PAPER_UNDELAYED = replace(PAPER, delay=Delay(0))


def test_a_stream_takes_real_numbers_alone():
    with pytest.raises(DataError, match=r'stream, voltage: .* complex128'):
        PAPER.stream().process(np.ones(100) + 1j)
    masked = np.ma.masked_greater(np.linspace(0, 10, 100), 9.0)
    assert np.isnan(PAPER.stream().process(masked)[-1])
