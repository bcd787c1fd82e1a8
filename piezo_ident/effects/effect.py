# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What an effect is: an operator with a name, a slot, and parameters that can make it vanish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import reprlib
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.effects.trials import Trial, View
from piezo_ident.operators.chain import Block, Operator, Slot
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator

__all__ = ['NAN', 'Effect', 'Parameter', 'Trial', 'Value', 'View']

#: the neutral value of a parameter that has none
NAN = float('nan')

Value = float | str | NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of an effect.

    A parameter is an amplitude, which makes the effect grow from nothing, or it shapes the effect.

    Attributes
    ----------
    name, unit, description : str
        Units are those of the normalised chain: 1 is the full input or output span.
    neutral : float
        The value at which the effect does nothing; NaN for a parameter without one.
    lower, upper : float
        Bounds of a number.
    vector : bool
        Whether the value is a list of numbers.
    default : float or str, optional
        What a parameter that is left out takes; for a list, each of its numbers.  Without a
        default the parameter is required.
    kind : str
        ``number`` or ``text``.
    step : float
        Of an amplitude: a small value, at which the effect makes about 1e-3 of the span.  0 for a
        parameter that shapes.
    scale : str
        How a fit may move the parameter: ``linear``, ``log`` (by its logarithm) or ``fixed``.
    tries : tuple
        Of a parameter that shapes: values worth trying on any data; for a list, lists.
    """

    name: str
    unit: str
    description: str
    neutral: float
    lower: float
    upper: float
    vector: bool = False
    default: float | str | None = None
    kind: Literal['number', 'text'] = 'number'
    step: float = 0.0
    scale: Literal['linear', 'log', 'fixed'] = 'linear'
    tries: tuple[Any, ...] = ()

    @property
    def is_amplitude(self) -> bool:
        """Whether the effect grows in proportion to it, near its neutral value."""
        return self.step > 0.0

    def clip(self, value: Any) -> Any:
        """Return a value, or a list of them, moved into the bounds."""
        return value if self.kind == 'text' else np.clip(value, self.lower, self.upper)

    def read(self, value: Any, where: str) -> Value:
        """
        Return a value as a float, a vector or a text.

        Raises
        ------
        ModelError
            When it is none, or out of bounds; the message starts with `where`.
        """
        if self.kind == 'text':
            if not isinstance(value, str) or not value:
                raise ModelError(f'{where}: {self.name} must be a text, got {reprlib.repr(value)}')
            return value
        try:
            number = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ModelError(f'{where}: {self.name} is not a number') from None
        if number.ndim != int(self.vector):
            shape = 'a list of numbers' if self.vector else 'one number'
            raise ModelError(f'{where}: {self.name} must be {shape}')
        if not np.all((number >= self.lower) & (number <= self.upper)):
            raise ModelError(
                f'{where}: {self.name} = {number.tolist()} leaves its bounds '
                f'{self.lower:g} .. {self.upper:g} {self.unit}'
            )
        return number.copy() if self.vector else float(number)


class Effect:
    """
    Base of every effect: an operator of the chain.

    A subclass sets the class attributes, reads its parameters by `number`, `array` and `text`,
    and defines `reset` and `process`.  In the slot ``hysteresis`` it receives H as `inner` and
    stands in its place.

    Attributes
    ----------
    name : str
        As verdicts and files call it.
    slot : str
        Its place in the chain.
    parameters : tuple of Parameter
        What it takes.
    description : str
        One line for the catalogue, with the typical size.
    needs : str
        The excitation that would show it.
    time_driven : bool
        Whether it follows from time alone and not from the command: then its amplitudes are
        others in each record, and nothing is known of them beyond the record.
    in_delay_line : bool
        Whether it is no link of its own but a change of the model's delay line, by `added_delay`.

    Parameters
    ----------
    sample_rate : float
        [Hz]
    values : mapping of str to float, str or sequence of float
        One value for each parameter that has no default.
    hysteresis : Hysteresis, optional
        Parameters of H, for effects in its slot.
    inner : Operator, optional
        The operator that an effect in the slot ``hysteresis`` wraps.

    Raises
    ------
    ModelError
        When a parameter is missing, unknown, out of bounds or of the wrong shape, or when they
        contradict each other.
    """

    name: ClassVar[str]
    slot: ClassVar[Slot]
    parameters: ClassVar[tuple[Parameter, ...]]
    description: ClassVar[str] = ''
    needs: ClassVar[str] = ''
    time_driven: ClassVar[bool] = False
    in_delay_line: ClassVar[bool] = False

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
    def check(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """
        Return the values as floats, vectors and texts, defaults filled in.

        Raises
        ------
        ModelError
            As the class says.
        """
        where, known = f'effect {cls.name}', {p.name: p for p in cls.parameters}
        strange = sorted(set(values) - set(known))
        missing = sorted(k for k, p in known.items() if k not in values and p.default is None)
        if strange or missing:
            what = f'unknown {strange}' if strange else f'missing {missing}'
            raise ModelError(f'{where}: {what}; its parameters are {sorted(known)}')
        checked = {k: p.read(values[k], where) for k, p in known.items() if k in values}
        lengths = [x.size for x in checked.values() if isinstance(x, np.ndarray)]
        for name, p in known.items():
            if name not in checked:
                default = np.full(max(lengths, default=1), p.default) if p.vector else p.default
                checked[name] = p.read(default, where)
        checked = {name: checked[name] for name in known}
        cls.agree(checked)
        return checked

    @classmethod
    def agree(cls, values: Mapping[str, Value]) -> None:
        """
        Refuse values that contradict each other: lists must be of one length.

        Raises
        ------
        ModelError
        """
        lengths = {k: x.size for k, x in values.items() if isinstance(x, np.ndarray)}
        if len(set(lengths.values())) > 1:
            said = ', '.join(f'{name} has {n}' for name, n in lengths.items())
            raise ModelError(f'effect {cls.name}: the lists differ in length ({said})')

    @classmethod
    def neutral(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """Return the values with every parameter that has a neutral value there."""
        checked = cls.check(values)
        for p in cls.parameters:
            if not np.isnan(p.neutral):
                old = checked[p.name]
                new = np.full(old.size, p.neutral) if isinstance(old, np.ndarray) else p.neutral
                checked[p.name] = new
        return checked

    @classmethod
    def is_neutral(cls, values: Mapping[str, Any]) -> bool:
        """Return whether every parameter that has a neutral value is there: nothing is done."""
        return cls.same(values, cls.neutral(values))

    @classmethod
    def same(cls, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        """Return whether two sets of values are equal."""
        first, second = cls.check(one), cls.check(other)
        return all(np.array_equal(x, second[name]) for name, x in first.items())

    @classmethod
    def elsewhere(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """
        Return what to expect of an effect that is driven by time in a record that nobody knows.

        Here: its neutral values, for what is known of one record says nothing of another.
        """
        return cls.neutral(values)

    @classmethod
    def added_delay(cls, values: Mapping[str, Any]) -> float:
        """Return by how many samples an effect `in_delay_line` lengthens it."""
        return 0.0

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """
        Return the settings at which the effect is tried on given data.

        Here: each combination of the `tries` of the parameters that shape, all amplitudes moved.
        None when such a parameter has neither `tries` nor a default.

        Parameters
        ----------
        view : View
            What is known of the data.
        """
        shapes = [p for p in cls.parameters if not p.is_amplitude]
        choices = [p.tries or (() if p.default is None else (p.default,)) for p in shapes]
        found = []
        for combination in product(*choices):
            chosen = {p.name: x for p, x in zip(shapes, combination, strict=True)}
            found.append(cls.trial(chosen))
        return tuple(found)

    @classmethod
    def trial(
        cls,
        shape: Mapping[str, Any],
        moved: Sequence[str] | None = None,
        steps: Mapping[str, float] | None = None,
    ) -> Trial:
        """
        Return one trial: amplitudes at their neutral values, the rest as given.

        Parameters
        ----------
        shape : mapping
            Values of the parameters that shape; they are moved into their bounds.
        moved : sequence of str, optional
            Amplitudes that are moved; all when absent.  A list moves in each of its places.
        steps : mapping of str to float, optional
            Steps that suit these data better than those of the parameters.
        """
        known = {p.name: p for p in cls.parameters}
        values = cls.check({name: known[name].clip(x) for name, x in shape.items()})
        for p in cls.parameters:
            if p.is_amplitude and p.name not in shape:
                old = values[p.name]
                values[p.name] = (
                    np.full(old.size, p.neutral) if isinstance(old, np.ndarray) else p.neutral
                )
        moves: list[tuple[str, int | None]] = []
        for p in cls.parameters:
            if p.is_amplitude and (moved is None or p.name in moved):
                start = values[p.name]
                if isinstance(start, np.ndarray):
                    moves += [(p.name, i) for i in range(start.size)]
                else:
                    moves.append((p.name, None))
        own = steps or {}
        far = tuple(float(own.get(name, known[name].step)) for name, _ in moves)
        return Trial(values, tuple(moves), far)

    def number(self, name: str) -> float:
        """Return a scalar parameter."""
        value = self.values[name]
        if not isinstance(value, float):
            raise ModelError(f'effect {self.name}: {name} is not one number')
        return value

    def array(self, name: str) -> NDArray[np.float64]:
        """Return a parameter as a vector."""
        value = self.values[name]
        if isinstance(value, str):
            raise ModelError(f'effect {self.name}: {name} is a text')
        return np.atleast_1d(np.asarray(value, dtype=np.float64))

    def text(self, name: str) -> str:
        """Return a text parameter."""
        value = self.values[name]
        if not isinstance(value, str):
            raise ModelError(f'effect {self.name}: {name} is not a text')
        return value

    @property
    def core(self) -> Operator:
        """The operator at the heart of a stack in the slot ``hysteresis``: H, as a rule."""
        found: Operator = self.inner
        while isinstance(found, Effect):
            found = found.inner
        return found

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; see `piezo_ident.operators.chain.Operator`."""
        raise NotImplementedError

    def process(self, block: Block) -> Block:
        """Apply the effect; see `piezo_ident.operators.chain.Operator`."""
        raise NotImplementedError
