# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""G that makes the means of rows in one, against G and means after it."""

from __future__ import annotations

import numpy as np
from piezo_ident.diagnosis.changes import Behind
from piezo_ident.diagnosis.row_filter import group_of, RowFilter, serves
from piezo_ident.effects import find_effect
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Delay, DelayOperator, Dynamics, DynamicsOperator
from piezo_ident.residual.stretches import block_means
import pytest


def modes() -> Dynamics:
    """Return a G with so many lightly damped modes that it is run as sections."""
    poles = 0.9995 * np.exp(2j * np.pi * np.array([0.01, 0.011, 0.03, 0.034, 0.1, 0.12]))
    a = np.poly(np.concatenate([poles, poles.conj()])).real
    zeros = 0.999 * np.exp(2j * np.pi * np.array([0.0105, 0.02, 0.032, 0.05, 0.11]))
    b = np.poly(np.concatenate([zeros, zeros.conj()])).real
    return Dynamics(a[1:], b * a.sum() / b.sum())


PAPER = SimulatedStage.load('paper').model.dynamics
SYSTEMS = {
    'paper': PAPER,
    'second order': Dynamics([-1.2, 0.5], [0.13, 0.06]),
    'zeros alone': Dynamics([], [0.5, 0.2, 0.1]),
    'nearly an integrator': Dynamics([-0.999], [0.001]),
    'sections': modes(),
}


def motion(n: int, start: float = 0.0) -> np.ndarray:
    """Return a random walk that starts at rest."""
    walk = 0.01 * np.random.default_rng(7).standard_normal(n).cumsum()
    return start + walk


@pytest.mark.parametrize('system', SYSTEMS)
@pytest.mark.parametrize('m', [3, 4, 7])
def test_it_is_the_mean_of_what_g_makes(system, m):
    G, cut = SYSTEMS[system], 50 * group_of(m) * m
    x = motion(3 * cut - 2 * m - 1, 0.3)
    rows = RowFilter([G], m)
    assert rows.reset(0.3) == pytest.approx(0.3 * G.gain, rel=1e-12)
    found = np.concatenate([rows.process(part) for part in (x[:cut], x[cut:])])
    block = Block(t=x, v=x, x=x, channels={})
    operator = DynamicsOperator(G)
    operator.reset(0.0, 0.3)
    whole = operator.process(block).x
    np.testing.assert_allclose(found, block_means(whole, m), rtol=0, atol=1e-11)


def test_many_modes_run_as_sections():
    G = SYSTEMS['sections']
    assert G.sections is not None
    assert serves([PAPER, G], 4, 200_000)
    # a B that begins with zero leaves no sections, and powers of the whole A lose all digits
    late = Dynamics(G.a, [0.0, *G.b])
    assert late.sections is None
    assert not serves([PAPER, late], 4, 200_000)


@pytest.mark.parametrize('m, samples', [(2, 200_000), (4, 20_000)])
def test_short_rows_and_short_runs_are_filtered_as_they_are(m, samples):
    assert not serves([PAPER], m, samples)


@pytest.mark.parametrize('samples', [0, 1, 5, 47, 48, 49])
def test_a_record_may_be_shorter_than_a_group(samples):
    x = motion(samples)
    operator = DynamicsOperator(PAPER)
    operator.reset(0.0, 0.1)
    whole = operator.process(Block(t=x, v=x, x=x, channels={})).x
    rows = RowFilter([PAPER], 4)
    rows.reset(0.1)
    np.testing.assert_allclose(rows.process(x), block_means(whole, 4), rtol=0, atol=1e-14)


# a short delay goes with G, a longer one needs states of its own
@pytest.mark.parametrize('delay', [Delay(1), Delay(0, 0.4), Delay(3, 0.4)])
def test_links_that_filter_may_stand_on_either_side_of_g(delay):
    m, rate = 4, 20_000.0
    x = motion(120_011)
    block = Block(t=np.arange(x.size) / rate, v=x, x=x, channels={})
    creep = find_effect('creep')
    values = creep.check({'gain': [0.03, -0.01], 'time_constant': [0.02, 0.5]})
    links = [
        creep(rate, values, None),
        DynamicsOperator(PAPER),
        DynamicsOperator(Dynamics([-0.4], [0.6])),
        DelayOperator(delay),
    ]
    # a change that begins with a step, as one of H at rest does
    change = motion(x.size, 0.2)
    found = Behind(links, [0.0] * 5, [block] * 5, m).rows(change, 0.2)
    rest, passed = 0.2, block.with_signal(change)
    for link in links:
        rest = link.reset(0.0, rest)
        passed = link.process(passed)
    np.testing.assert_allclose(found, block_means(passed.x, m), rtol=0, atol=1e-12)
    assert np.ptp(found) > 0.1


def test_a_gain_that_follows_time_scales_changes_of_any_size():
    m, rate = 6, 20_000.0
    x = motion(120_000, 0.4)
    block = Block(t=np.arange(x.size) / rate, v=x, x=x, channels={})
    drift = find_effect('gain_drift')
    values = drift.check({'time': [1.0, 4.0], 'gain': [0.1, -0.2]})
    links = [DynamicsOperator(PAPER), drift(rate, values)]
    change = motion(x.size, 0.2)
    found = Behind(links, [0.0] * 3, [block] * 3, m).rows(change, 0.2)
    links[0].reset(0.0, 0.2)
    passed = links[1].process(links[0].process(block.with_signal(change)))
    np.testing.assert_allclose(found, block_means(passed.x, m), rtol=0, atol=1e-4)
    assert np.ptp(found) > 0.1


def test_a_gain_that_follows_time_comes_to_rest_as_it_does():
    m, rate = 4, 20_000.0
    x = motion(4000)
    block = Block(t=100.0 + np.arange(x.size) / rate, v=x, x=x, channels={})
    drift = find_effect('gain_drift')
    values = drift.check({'time': [1.0, 200.0], 'gain': [0.0, 0.2]})
    links = [drift(rate, values), DelayOperator(Delay(8))]
    change = np.ones(x.size)
    found = Behind(links, [0.0] * 3, [block] * 3, m).rows(change, 1.0)
    links[1].reset(0.0, links[0].reset(0.0, 1.0))
    passed = links[1].process(links[0].process(block.with_signal(change)))
    np.testing.assert_allclose(found, block_means(passed.x, m), rtol=0, atol=1e-12)


def test_a_curve_behind_g_passes_small_changes_by_its_slope():
    m, rate = 4, 20_000.0
    x = motion(120_011, 0.4)
    block = Block(t=np.arange(x.size) / rate, v=x, x=x, channels={})
    sensor = find_effect('sensor_nonlinearity')
    values = sensor.check({'square': 0.2, 'cubic': -0.3, 'fourth': 0.1})
    links = [DynamicsOperator(PAPER), sensor(rate, values)]
    G = DynamicsOperator(PAPER)
    blocks, rests = [block], [0.4, G.reset(0.0, 0.4)]
    blocks.append(G.process(block))
    rests.append(links[1].reset(0.0, rests[1]))
    blocks.append(links[1].process(blocks[1]))
    change = 1e-4 * motion(x.size, 0.2)
    exact = Behind(links, rests, blocks, m).rows(change, 2e-5)
    found = Behind(links, rests, blocks, m, small=True).rows(change, 2e-5)
    assert np.abs(exact).max() > 1e-5
    # the curve bends a little within a row, and under the change
    np.testing.assert_allclose(found, exact, rtol=2e-3, atol=1e-3 * np.abs(exact).max())
    sections = np.array([[0.3, 0.0, 0.0, -0.7, 0.0]])
    sections[:, :3] *= 1e-4
    rows, bent = (
        Behind(links, rests, blocks, m, small=small).filtered(sections, x, 0.4)
        for small in (True, False)
    )
    np.testing.assert_allclose(rows, bent, atol=1e-3 * np.abs(bent).max())
