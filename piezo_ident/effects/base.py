# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What an effect is: an operator with a name, a slot, and parameters that can make it vanish."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from piezo_ident.block import Block, Operator, Slot
from piezo_ident.errors import ModelError
from piezo_ident.hysteresis import Hysteresis, HysteresisOperator

__all__ = ['Effect', 'Parameter']


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of an effect.

    Attributes
    ----------
    name, unit, description : str
        Units are those of the normalised chain: 1 is the full input or output span.
    neutral : float
        The value at which the effect does nothing; NaN for a parameter without one.
    lower, upper : float
        Bounds.
    vector : bool
        Whether the value is a list of numbers.
    """

    name: str
    unit: str
    description: str
    neutral: float
    lower: float
    upper: float
    vector: bool = False


class Effect:
    """
    Base of every effect: an operator of the chain.

    A subclass sets the class attributes, reads its parameters from ``self.values``, and defines
    `reset` and `process`.  In the slot ``hysteresis`` it receives H as `inner` and stands in its
    place.

    Parameters
    ----------
    sample_rate : float
        [Hz]
    values : mapping of str to float or sequence of float
        One value for each parameter.
    hysteresis : Hysteresis, optional
        Parameters of H, for effects in its slot.
    inner : Operator, optional
        The operator that an effect in the slot ``hysteresis`` wraps.

    Raises
    ------
    ModelError
        When a parameter is missing, unknown, out of bounds or of the wrong shape.
    """

    name: ClassVar[str]
    slot: ClassVar[Slot]
    parameters: ClassVar[tuple[Parameter, ...]]

    def __init__(
        self,
        sample_rate: float,
        values: Mapping[str, Any],
        hysteresis: Hysteresis | None = None,
        inner: Operator | None = None,
    ) -> None:
        self.sample_rate = float(sample_rate)
        self.values = self.check(values)
        self.hysteresis = hysteresis or Hysteresis([], [], 0.0, 1.0)  # type: ignore[arg-type]
        self.inner: Operator = inner or HysteresisOperator(self.hysteresis)

    @classmethod
    def check(cls, values: Mapping[str, Any]) -> dict[str, float | NDArray[np.float64]]:
        """
        Return the values as floats and arrays.

        Raises
        ------
        ModelError
            As the class says.
        """
        known = {p.name: p for p in cls.parameters}
        strange = sorted(set(values) - set(known))
        missing = sorted(set(known) - set(values))
        if strange or missing:
            what = f'unknown {strange}' if strange else f'missing {missing}'
            raise ModelError(f'effect {cls.name}: {what}; its parameters are {sorted(known)}')
        checked: dict[str, float | NDArray[np.float64]] = {}
        for name, p in known.items():
            try:
                number = np.asarray(values[name], dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                raise ModelError(f'effect {cls.name}: {name} is not a number') from None
            if number.ndim != int(p.vector):
                shape = 'a list of numbers' if p.vector else 'one number'
                raise ModelError(f'effect {cls.name}: {name} must be {shape}')
            if not np.all((number >= p.lower) & (number <= p.upper)):
                raise ModelError(
                    f'effect {cls.name}: {name} = {number.tolist()} leaves its bounds '
                    f'{p.lower:g} .. {p.upper:g} {p.unit}'
                )
            checked[name] = number if p.vector else float(number)
        return checked

    def number(self, name: str) -> float:
        """Return a scalar parameter."""
        value = self.values[name]
        if not isinstance(value, float):
            raise ModelError(f'effect {self.name}: {name} is a list')
        return value

    def array(self, name: str) -> NDArray[np.float64]:
        """Return a parameter as a vector."""
        return np.atleast_1d(np.asarray(self.values[name], dtype=np.float64))

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; see `piezo_ident.block.Operator`."""
        raise NotImplementedError

    def process(self, block: Block) -> Block:
        """Apply the effect; see `piezo_ident.block.Operator`."""
        raise NotImplementedError
