# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The frozen block that travels along the chain, and what every operator promises.

    v --> [input] --> [hysteresis] --> [hidden] --> [G, z^-d] --> [output] --> [acquisition] --> y

Everything inside the chain is in normalised units: u = (v - v0)/V and (y - y0)/Y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ['SLOTS', 'Block', 'Chain', 'Operator', 'Slot']

Slot = Literal['input', 'hysteresis', 'hidden', 'output', 'acquisition']

#: the places of a chain into which an effect goes, in the order of the signal
SLOTS: tuple[Slot, ...] = ('input', 'hysteresis', 'hidden', 'output', 'acquisition')


@dataclass(frozen=True, eq=False)
class Block:
    """
    A stretch of the stream.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Time [s].
    v : ndarray, shape (n,)
        Command, normalised; every operator may look at it, wherever it sits.
    x : ndarray, shape (n,)
        The signal on its way through the chain, normalised.
    channels : mapping of str to ndarray, shape (n,)
        Further measured signals in their own units.
    """

    t: NDArray[np.float64]
    v: NDArray[np.float64]
    x: NDArray[np.float64]
    channels: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def with_signal(self, x: NDArray[np.float64]) -> Block:
        """Return the block with another signal."""
        block = object.__new__(Block)
        # as replace() has it, but without its way through the fields: short blocks feel that
        block.__dict__.update(self.__dict__, x=x)
        return block


class Operator(Protocol):
    """One link of a chain; it keeps its own state between blocks."""

    def reset(self, v0: float, x0: float) -> float:
        """
        Come to rest under a constant command.

        Parameters
        ----------
        v0, x0 : float
            Command and incoming signal at rest, normalised.

        Returns
        -------
        float
            The outgoing signal at rest.
        """
        ...

    def process(self, block: Block) -> Block:
        """Return the block with this operator applied; the result never depends on the cutting."""
        ...


class Chain:
    """Operators one after the other, themselves an operator."""

    def __init__(self, operators: tuple[Operator, ...]) -> None:
        self.operators = operators

    def reset(self, v0: float, x0: float) -> float:
        """Bring every operator to rest, each under the rest value of the one before."""
        for operator in self.operators:
            x0 = operator.reset(v0, x0)
        return x0

    def process(self, block: Block) -> Block:
        """Pass the block through all operators."""
        for operator in self.operators:
            block = operator.process(block)
        return block
