# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Small changes of a signal that pass the links of a chain."""

from __future__ import annotations

import numpy as np
from piezo_ident.diagnosis.run_chain import Behind, run_abreast, RunChain
from piezo_ident.effects import find_effect
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Delay, DelayOperator, Dynamics, DynamicsOperator
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.residual.stretches import block_means
import pytest

PAPER = SimulatedStage.load('paper').model.dynamics


def motion(n: int, start: float = 0.0) -> np.ndarray:
    """Return a random walk that starts at rest."""
    walk = 0.01 * np.random.default_rng(7).standard_normal(n).cumsum()
    return start + walk


def behind_links(links: list, block: Block, rest: float) -> Block:
    """Run a block through links that are at rest under a signal."""
    for link in links:
        rest = link.reset(0.0, rest)
        block = link.process(block)
    return block


@pytest.mark.parametrize('delay', [Delay(1), Delay(3, 0.4)])
def test_linear_links_pass_a_change_alone(delay):
    m, rate = 4, 20_000.0
    x = motion(40_011)
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
    behind = Behind(links, [0.0] * 5, [block] * 5, m)
    assert not behind.bends
    found = behind.rows(change, 0.2)
    passed = behind_links(links, block.with_signal(change), 0.2)
    np.testing.assert_allclose(found, block_means(passed.x, m), rtol=0, atol=1e-12)
    assert np.ptp(found) > 0.1


def test_a_gain_that_follows_time_scales_a_change():
    m, rate = 4, 20_000.0
    x = motion(4000)
    block = Block(t=100.0 + np.arange(x.size) / rate, v=x, x=x, channels={})
    drift = find_effect('gain_drift')
    values = drift.check({'time': [1.0, 200.0], 'gain': [0.0, 0.2]})
    links = [drift(rate, values), DelayOperator(Delay(8))]
    change = np.ones(x.size)
    found = Behind(links, [0.0] * 3, [block] * 3, m).rows(change, 1.0)
    passed = behind_links(links, block.with_signal(change), 1.0)
    np.testing.assert_allclose(found, block_means(passed.x, m), rtol=0, atol=1e-12)


def test_a_curve_passes_a_change_as_two_runs_do():
    m, rate = 4, 20_000.0
    x = motion(20_011, 0.4)
    block = Block(t=np.arange(x.size) / rate, v=x, x=x, channels={})
    sensor = find_effect('sensor_nonlinearity')
    values = sensor.check({'square': 0.2, 'cubic': -0.3, 'fourth': 0.1})
    links = [DynamicsOperator(PAPER), sensor(rate, values)]
    G = DynamicsOperator(PAPER)
    blocks, rests = [block], [0.4, G.reset(0.0, 0.4)]
    blocks.append(G.process(block))
    rests.append(links[1].reset(0.0, rests[1]))
    blocks.append(links[1].process(blocks[1]))
    change = motion(x.size, 0.2)
    behind = Behind(links, rests, blocks, m)
    assert behind.bends
    found = behind.rows(change, 0.2)
    chain = [DynamicsOperator(PAPER), sensor(rate, values)]
    moved = behind_links(chain, block.with_signal(x + change), 0.6)
    difference = block_means(moved.x - blocks[2].x, m)
    np.testing.assert_allclose(found, difference, rtol=0, atol=1e-12)


def test_springs_side_by_side_move_as_each_does_alone():
    rate, x = 5000.0, motion(3000, 0.3)
    block = Block(t=np.arange(x.size) / rate, v=x, x=x)
    loop = find_effect('loop_hysteresis')
    mode = {'frequency': 300.0, 'damping': 0.02}
    springs = [
        {
            **mode,
            **{'elastic': 0.01 * i, 'square': -0.01 * i, 'cubic': 0.02 * i, 'viscous': 1e-3 * i},
            **{'stiffness': [0.02 * i], 'threshold': [0.002 * i]},
            **{'gamma': [3.0 * (i % 3)], 'skew': [-0.1 * i]},
        }
        for i in range(10)
    ]
    # a finer grid, another law, two elements, and a spring that does nothing
    springs[3] |= {'elastic': 2.0}
    springs[5] |= {'power': 1.5}
    springs.append({**mode, 'stiffness': [0.1, 0.2], 'gamma': [1.0, 0.0]})
    springs.append({**mode, 'stiffness': [0.0]})
    h = HysteresisOperator(Hysteresis([], [], 0.0, 1.0))
    last = DelayOperator(Delay(1))
    before = RunChain((h, last), block)
    before.output(keep=True)
    alone, together = (
        [RunChain((h, loop(rate, spring), last), block) for spring in springs] for _ in range(2)
    )
    run_abreast(loop, [None, *((chain, 1) for chain in together)], before)
    for one, other in zip(alone, together, strict=True):
        assert type(other.operators[1]) is not loop
        found = one.difference(before, 1, 4)
        assert np.isfinite(found).all()
        # the second pass begins at the start, too
        for _ in range(2):
            np.testing.assert_array_equal(other.difference(before, 1, 4), found)
