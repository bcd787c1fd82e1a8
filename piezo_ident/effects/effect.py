# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Base of effects: operators with a name, a slot and parameters that can switch them off."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import reprlib
from typing import Any, ClassVar, Literal

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.effects.trials import Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block, Operator, Slot
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator

__all__ = ['NAN', 'Effect', 'Parameter', 'Trial', 'Value', 'View']

#: neutral value of a parameter that has none
NAN = float('nan')

Value = float | str | Array


@dataclass(frozen=True)
class Parameter:
    """
    Parameter of an effect.

    An amplitude scales the effect from zero; other parameters shape it.

    Attributes
    ----------
    name, unit, description : str
        Units are those of the normalised chain: 1 is the full input or output span.
    neutral : float
        Value at which the effect does nothing; NaN if the parameter has no such value.
    lower, upper : float
        Bounds of the value.
    vector : bool
        Whether the value is a list of numbers.
    default : float or str, optional
        Value if the parameter is left out; in a list, of each number.  An amplitude defaults to
        its neutral value; another parameter without a default is required.
    kind : str
        ``number`` or ``text``.
    step : float
        For an amplitude: value that moves the output by about 1e-3 of the span; else 0.
    scale : str
        How a fit moves the parameter: ``linear``, ``log`` (its logarithm) or ``fixed``.
    tries : tuple
        For a parameter that is not an amplitude: values (or lists) worth trying on any data.
    first_stays : bool
        For a list over time: whether its first number stays fixed in a fit of one record with a
        free H, because H can take the place of this number.
    spread : float
        For an amplitude: prior rms of its numbers, which counts as one more observation in a
        fit.  The prior keeps numbers small that compensate each other.
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
    first_stays: bool = False
    spread: float = float('inf')

    def __post_init__(self) -> None:
        if self.default is None and self.is_amplitude:
            object.__setattr__(self, 'default', self.neutral)

    @property
    def is_amplitude(self) -> bool:
        """Whether the effect is proportional to this parameter near its neutral value."""
        return self.step > 0.0

    def neutral_like(self, value: Value) -> Value:
        """Give the neutral value, as a list as long as the value if the parameter is a list."""
        return np.full(np.size(value), self.neutral) if self.vector else self.neutral

    def clip(self, value: Any) -> Any:
        """Move a value, or a list of values, into the bounds."""
        return value if self.kind == 'text' else np.clip(value, self.lower, self.upper)

    def read(self, value: Any, where: str) -> Value:
        """
        Convert a value to a float, a vector or a text.

        Raises
        ------
        ModelError
            If the value has the wrong type or is out of bounds; the message starts with `where`.
        """
        is_number = self.kind == 'number' and not self.vector and isinstance(value, float)
        if is_number and self.lower <= value <= self.upper:
            return float(value)  # without arrays, as a fit reads many numbers
        if self.kind == 'text':
            if not isinstance(value, str) or not value:
                raise ModelError(f'{where}: {self.name} must be a text, got {reprlib.repr(value)}')
            return value
        try:
            number = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            text = reprlib.repr(value)
            raise ModelError(f'{where}: {self.name} is not a number: {text}') from None
        if number.ndim != int(self.vector):
            shape = 'a list of numbers' if self.vector else 'one number'
            raise ModelError(f'{where}: {self.name} must be {shape}, got {reprlib.repr(value)}')
        if not np.all((number >= self.lower) & (number <= self.upper)):
            raise ModelError(
                f'{where}: {self.name} = {number.tolist()} leaves its bounds '
                f'{self.lower:g} .. {self.upper:g} {self.unit}'
            )
        return number.copy() if self.vector else float(number)


class Effect:
    """
    Base class of every effect: an operator of the chain.

    A subclass sets the class attributes, reads its parameters by `number`, `array` and `text`,
    and defines `reset` and `process`.  In the slot ``hysteresis`` it receives H as `inner` and
    replaces it in the chain.

    Attributes
    ----------
    name, slot : str
        Name in verdicts and files, and place in the chain.
    parameters : tuple of Parameter
    description, needs : str
        Line for the catalogue with the typical size, and the excitation that would show it.
    time_driven : bool
        Whether the effect depends on time alone and not on the command.  Its amplitudes then
        differ from record to record.
    rate_independent : bool
        Whether the effect depends only on the path of the command, not on its speed.  A wide
        enough H can then imitate it.
    in_dynamics : bool
        Whether the effect is linear, so that an identification with the effect puts it into G.
    change : str
        Response of the effect to a change of its signal.  ``passed``: the change passes, because
        the effect only adds a signal of its own.  ``linear``: the effect of the change alone.
        ``bent``: any other response.
    of_hysteresis : str
        Dependence of the part that the effect adds in the slot ``hysteresis`` on the coefficients
        of H: ``not``, ``linear`` or ``bent`` (nonlinear).
    in_delay_line : bool
        Whether the effect changes the delay of the model, by `added_delay`, instead of the signal.
    contains : tuple of str
        Special cases of this effect, which must err clearly more before this effect is named.

    Parameters
    ----------
    sample_rate : float
        Sampling rate [Hz].
    values : mapping of str to float, str or sequence of float
        One value for each parameter that has no default.
    hysteresis : Hysteresis, optional
        Parameters of H, for effects in its slot.
    inner : Operator, optional
        Operator that an effect in the slot ``hysteresis`` wraps.

    Raises
    ------
    ModelError
        If a parameter is missing, unknown, out of bounds or of the wrong shape, or if parameters
        contradict each other.
    """

    name: ClassVar[str]
    slot: ClassVar[Slot]
    parameters: ClassVar[tuple[Parameter, ...]]
    description: ClassVar[str] = ''
    needs: ClassVar[str] = ''
    time_driven: ClassVar[bool] = False
    rate_independent: ClassVar[bool] = False
    in_dynamics: ClassVar[bool] = False
    change: ClassVar[Literal['passed', 'linear', 'bent']] = 'bent'
    of_hysteresis: ClassVar[Literal['not', 'linear', 'bent']] = 'bent'
    in_delay_line: ClassVar[bool] = False
    contains: ClassVar[tuple[str, ...]] = ()

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
        self.prepare()

    def prepare(self) -> None:
        """Compute values that depend on the parameters alone."""

    @classmethod
    def check(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """Convert the values to floats, vectors and texts, and add the defaults."""
        where, known = f'effect {cls.name}', {p.name: p for p in cls.parameters}
        unknown = sorted(set(values) - set(known))
        missing = sorted(k for k, p in known.items() if k not in values and p.default is None)
        if unknown or missing:
            what = f'unknown {unknown}' if unknown else f'missing {missing}'
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
        """Refuse values that contradict each other: lists must have the same length."""
        lengths = {k: x.size for k, x in values.items() if isinstance(x, np.ndarray)}
        if len(set(lengths.values())) > 1:
            each = ', '.join(f'{name} has {n}' for name, n in lengths.items())
            raise ModelError(f'effect {cls.name}: the lists differ in length ({each})')

    @classmethod
    def neutral(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """Set every parameter with a neutral value to it; the effect then does nothing."""
        checked = cls.check(values)
        for p in cls.parameters:
            if not np.isnan(p.neutral):
                checked[p.name] = p.neutral_like(checked[p.name])
        return checked

    @classmethod
    def is_neutral(cls, values: Mapping[str, Any]) -> bool:
        """Tell whether the effect does nothing at these values."""
        return cls.same(values, cls.neutral(values))

    @classmethod
    def same(cls, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        """Tell whether two sets of values are equal."""
        first, second = cls.check(one), cls.check(other)
        return all(np.array_equal(x, second[name]) for name, x in first.items())

    @classmethod
    def elsewhere(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """
        Give the expected values of a time-driven effect in another record.

        By default they are the neutral values, since a record says nothing about another record.
        """
        return cls.neutral(values)

    @classmethod
    def is_plausible(cls, values: Mapping[str, Any]) -> bool:
        """
        Tell whether a stage can have these values; the bounds of single parameters cannot.

        By default True.  A diagnosis never names an effect with implausible values.
        """
        return True

    @classmethod
    def mode(cls, values: Mapping[str, Any]) -> tuple[float, float] | None:
        """Give frequency [Hz] and damping ratio of the mode of G that the effect moves, if any."""
        return None

    @classmethod
    def added_delay(cls, values: Mapping[str, Any]) -> float:
        """Give the delay [samples] that an effect `in_delay_line` adds."""
        return 0.0

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """
        List the settings at which the effect is tried on some data.

        By default, all combinations of the `tries` of parameters that are not amplitudes, with
        all amplitudes moved.  Each of these parameters needs `tries` or a default.
        """
        shapes = [p for p in cls.parameters if not p.is_amplitude]
        choices = [p.tries or (() if p.default is None else (p.default,)) for p in shapes]
        names = [p.name for p in shapes]
        return tuple(cls.trial(dict(zip(names, x, strict=True))) for x in product(*choices))

    @classmethod
    def trial(
        cls,
        shape: Mapping[str, Any],
        moved: Sequence[str] | None = None,
        steps: Mapping[str, float] | None = None,
    ) -> Trial:
        """
        Make one trial: amplitudes at their neutral values, other parameters by `shape`.

        Parameters
        ----------
        shape : mapping
            Values of parameters that are not amplitudes; they are clipped to their bounds.
        moved : sequence of str, optional
            Amplitudes that are moved; by default all.  Each element of a list moves by itself.
        steps : mapping of str to float, optional
            Steps that replace the steps of the parameters.
        """
        known = {p.name: p for p in cls.parameters}
        values = cls.check({name: known[name].clip(x) for name, x in shape.items()})
        for p in cls.parameters:
            if p.is_amplitude and p.name not in shape:
                values[p.name] = p.neutral_like(values[p.name])
        moves = tuple(
            (p.name, i)
            for p in cls.parameters
            if p.is_amplitude and (moved is None or p.name in moved)
            for i in (range(np.size(values[p.name])) if p.vector else (None,))
        )
        far = {**{name: p.step for name, p in known.items()}, **(steps or {})}
        return Trial(values, moves, tuple(float(far[name]) for name, _ in moves))

    def slopes(self, block: Block) -> Mapping[str, Array]:
        """
        Compute derivatives of the output of `process` by the names of scalar parameters.

        Each has shape (n,), and the memory stays unchanged.  The method serves effects around H;
        missing derivatives are taken by differences.
        """
        return {}

    @classmethod
    def abreast(cls, effects: Sequence[Effect], block: Block) -> list[Array] | None:
        """Compute the outputs of several effects at rest together; None if that is no faster."""
        return None

    def of_parts(
        self, block: Block, rest: float, parts: Iterable[tuple[Hysteresis, Array]]
    ) -> Iterator[Array]:
        """
        Yield the output of the slot ``hysteresis`` for each part of H alone; shapes (n,).

        A part has plays only, or none; it comes with the outputs of its plays at `rest`.
        """
        for h, memory in parts:
            operator = type(self)(self.sample_rate, self.values, h, HysteresisOperator(h, memory))
            operator.reset(float(block.v[0]), rest)
            yield operator.process(block).x

    def number(self, name: str) -> float:
        """Read a scalar parameter."""
        return float(self.values[name])

    def array(self, name: str) -> Array:
        """Read a parameter as a vector."""
        return np.atleast_1d(np.asarray(self.values[name], dtype=np.float64))

    def text(self, name: str) -> str:
        """Read a text parameter."""
        return str(self.values[name])

    @property
    def core(self) -> Operator:
        """Innermost operator of the slot ``hysteresis``; normally H."""
        operator: Operator = self.inner
        while isinstance(operator, Effect):
            operator = operator.inner
        return operator

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; by default the signal passes, without memory or an addition at rest."""
        return x0

    def process(self, block: Block) -> Block:
        """Apply the effect; see `piezo_ident.operators.chain.Operator`."""
        raise NotImplementedError

    def c_code(self) -> CCode:
        """
        Write the effect in C, for `piezo_ident.export_c`.

        Raises
        ------
        ModelError
            If the subclass does not define it.
        """
        raise ModelError(
            f'effect {self.name}: is not written in C and cannot be exported; give its class a '
            'c_code(), or take the effect out of the model'
        )
