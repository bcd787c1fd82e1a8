# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The frozen block and the chain."""

from dataclasses import FrozenInstanceError

import numpy as np
from numpy.testing import assert_array_equal
from piezo_ident.operators.chain import Block, Chain
import pytest


class Add:
    """Add a number; at rest too."""

    def __init__(self, number):
        self.number = number

    def reset(self, v0, x0):
        return x0 + self.number

    def process(self, block):
        return block.with_signal(block.x + self.number)


class Double(Add):
    def reset(self, v0, x0):
        return 2 * x0

    def process(self, block):
        return block.with_signal(2 * block.x)


def block():
    return Block(t=np.arange(3.0), v=np.ones(3), x=np.arange(3.0), channels={'T': np.zeros(3)})


def test_chain_applies_its_operators_in_order():
    chain = Chain((Add(1.0), Double(0.0), Add(-3.0)))
    assert chain.reset(0.0, 5.0) == 9.0
    assert_array_equal(chain.process(block()).x, 2 * (np.arange(3.0) + 1) - 3)


def test_block_is_frozen_and_keeps_everything_but_the_signal():
    one = block()
    two = one.with_signal(np.zeros(3))
    assert two.t is one.t
    assert two.v is one.v
    assert two.channels is one.channels
    assert_array_equal(one.x, np.arange(3.0))
    with pytest.raises(FrozenInstanceError):
        one.x = np.zeros(3)
