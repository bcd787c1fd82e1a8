# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Block of samples that passes the chain, and the interface of its operators.

    v --> [input] --> [hysteresis] --> [hidden] --> [G, z^-d] --> [output] --> [acquisition] --> y

All signals inside the chain are normalised: u = (v - v0)/V and (y - y0)/Y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from piezo_ident.common.arrays import Array

#: slots of a chain for effects, in the order of the signal
Slot = Literal['input', 'hysteresis', 'hidden', 'output', 'acquisition']


@dataclass(frozen=True, eq=False)
class Block:
    """
    The next samples of a stream; shapes (n,).

    `t` is the time [s], `v` the normalised command, which an operator in any slot may use, and `x`
    the normalised signal on its way through the chain.  The channels keep their own units.
    """

    t: Array
    v: Array
    x: Array
    channels: Mapping[str, Array] = field(default_factory=dict)

    def with_signal(self, x: Array) -> Block:
        """Replace the signal of the block."""
        block = object.__new__(Block)
        # dataclasses.replace() is slow for short blocks
        block.__dict__.update(self.__dict__, x=x)
        return block


class Operator(Protocol):
    """Element of a chain; it keeps its state between blocks."""

    def reset(self, v0: float, x0: float) -> float:
        """
        Come to rest under a constant command v0 and incoming signal x0, both normalised.

        The result is the outgoing signal at rest.
        """
        ...

    def process(self, block: Block) -> Block:
        """Process the next block; the result must not depend on how a stream is cut."""
        ...


class Chain:
    """Operators in series, used as one operator."""

    def __init__(self, operators: tuple[Operator, ...]) -> None:
        self.operators = operators

    def reset(self, v0: float, x0: float) -> float:
        """Bring every operator to rest; the result is the output of the last operator."""
        for operator in self.operators:
            x0 = operator.reset(v0, x0)
        return x0

    def process(self, block: Block) -> Block:
        """Pass the block through all operators."""
        for operator in self.operators:
            block = operator.process(block)
        return block
