# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
StageModel: the chain of operators with its scaling, and what it predicts.

    v --> [input] --> [ H ] --> [hidden] --> [ G ] --> [z^-d] --> [output] --> [acquisition] --> y
                  effects in their slots stand where their names say

A model is frozen.  `StageModel.stream` makes a `Stream`, which carries the state of one run;
`StageModel.predict` is a stream over a whole record, so both give the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.effects import find_effect
from piezo_ident.operators.chain import Block, Chain, Operator
from piezo_ident.operators.dynamics import Delay, DelayOperator, Dynamics, DynamicsOperator
from piezo_ident.operators.fused import fused, FusedOperator
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.record.record import Piece, Record

__all__ = ['EffectSetting', 'Prediction', 'Scaling', 'StageModel', 'Stream']

#: samples that pass the chain at once; small enough for the signals to stay in the cache
CHUNK = 8192
#: share of the identified voltages below which another unit is likelier than a small signal
FAINT = 2e-3


@dataclass(frozen=True)
class Scaling:
    """
    Signed affine normalisation: u = (v - v0)/V and (y - y0)/Y.

    Attributes
    ----------
    v0, V : float
        Voltage at u = 0 and span [V].
    y0, Y : float
        Displacement at zero and span [m]; Y is negative for a stage that retracts.
    range : tuple of float
        Voltages between which the model was identified [V].
    """

    v0: float
    V: float
    y0: float
    Y: float
    range: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (self.v0, self.V, self.y0, self.Y, *self.range)
        if not np.all(np.isfinite(numbers)):
            raise ModelError('scaling: v0, V, y0, Y and range must be finite numbers')
        if self.V <= 0 or self.Y == 0:
            raise ModelError('scaling: V must be positive and Y not zero')
        if self.range[0] >= self.range[1]:
            raise ModelError('scaling: range must be [lowest, highest] voltage')

    def u(self, v: ArrayLike) -> NDArray[np.float64]:
        """Return the normalised input."""
        return (np.asarray(v, dtype=np.float64) - self.v0) / self.V

    def y(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return metres from the normalised output."""
        return self.y0 + self.Y * np.asarray(x, dtype=np.float64)

    def x(self, y: ArrayLike) -> NDArray[np.float64]:
        """Return the normalised output from metres."""
        return (np.asarray(y, dtype=np.float64) - self.y0) / self.Y


@dataclass(frozen=True, eq=False)
class EffectSetting:
    """
    An effect in a model: its name and parameters.

    Raises
    ------
    ModelError
        When the name is unknown or a parameter is not as the effect declares.
    """

    name: str
    parameters: Mapping[str, Any]

    def __post_init__(self) -> None:
        values = find_effect(self.name).check(self.parameters)
        object.__setattr__(self, 'parameters', MappingProxyType(values))

    @property
    def slot(self) -> str:
        """The place in the chain."""
        return find_effect(self.name).slot


@dataclass(frozen=True, eq=False)
class Prediction:
    """
    Free-run prediction of a record.

    Attributes
    ----------
    pieces : tuple of ndarray
        Predicted displacement of each piece [m].
    warnings : tuple of str
        What the reader should know before trusting it.
    """

    pieces: tuple[NDArray[np.float64], ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class StageModel:
    """
    A stage: H, G, delay and effects, with scaling and the story of its identification.

    Parameters
    ----------
    sample_rate : float
        Rate for which G and the delay hold [Hz].
    scaling : Scaling
    hysteresis : Hysteresis
    dynamics : Dynamics
    delay : Delay
    effects : tuple of EffectSetting
    identification : mapping
        Method, seed, records, errors, uncertainties, noise floor, warnings: plain data.

    Raises
    ------
    ModelError
        When the dynamics are unstable or the rate is not positive.
    """

    sample_rate: float
    scaling: Scaling
    hysteresis: Hysteresis
    dynamics: Dynamics
    delay: Delay
    effects: tuple[EffectSetting, ...] = ()
    identification: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise ModelError(f'model: sample_rate must be positive, got {self.sample_rate}')
        if not self.dynamics.is_stable:
            raise ModelError(
                f'model: G is unstable (pole at radius {self.dynamics.radius:.6g}); '
                'identify again with another order'
            )

    @property
    def is_static(self) -> bool:
        """Whether neither G nor the delay nor an effect depends on the sampling rate."""
        trivial = self.dynamics.a.size == 0 and self.dynamics.b.size == 1
        return trivial and self.delay.total == 0.0 and not self.effects

    def without_dynamics(self) -> StageModel:
        """Return the hysteresis alone: G replaced by its static gain, no delay, no effects."""
        gain = self.dynamics.gain
        static = Dynamics(a=np.empty(0), b=np.array([gain]))
        return replace(self, dynamics=static, delay=Delay(0), effects=())

    def chain(self, memory: ArrayLike | None = None) -> Chain:
        """
        Return fresh operators in their order.

        Parameters
        ----------
        memory : array_like, shape (m,), optional
            Play outputs at the start, normalised.
        """
        in_slot: dict[str, list[EffectSetting]] = {}
        for setting in self.effects:
            if not find_effect(setting.name).in_delay_line:
                in_slot.setdefault(setting.slot, []).append(setting)

        def make(slot: str) -> list[Operator]:
            return [
                find_effect(s.name)(self.sample_rate, s.parameters) for s in in_slot.get(slot, [])
            ]

        core: Operator = HysteresisOperator(self.hysteresis, memory)
        for s in in_slot.get('hysteresis', []):
            core = find_effect(s.name)(self.sample_rate, s.parameters, self.hysteresis, core)
        return Chain(
            (
                *make('input'),
                core,
                *make('hidden'),
                DynamicsOperator(self.dynamics),
                DelayOperator(self.total_delay),
                *make('output'),
                *make('acquisition'),
            )
        )

    @property
    def total_delay(self) -> Delay:
        """
        The delay line of the chain: the identified delay, and what effects change of it.

        Raises
        ------
        ModelError
            When that is less than none.
        """
        added = sum(find_effect(s.name).added_delay(s.parameters) for s in self.effects)
        if added == 0.0:
            return self.delay
        total = self.delay.total + added
        if total < 0.0:
            raise ModelError(
                f'model: a delay of {self.delay.total:g} samples cannot change by {added:g}; '
                'no stage answers before its command'
            )
        whole = int(total)
        return Delay(whole, total - whole)

    def stream(self, memory: ArrayLike | None = None) -> Stream:
        """Return a run of this model that takes the voltage block by block."""
        return Stream(self, memory)

    def predict_piece(self, piece: Piece, memory: ArrayLike | None = None) -> NDArray[np.float64]:
        """
        Return the predicted displacement of one piece [m], shape (n,).

        Raises
        ------
        ModelError
            When the piece has another sampling rate.
        """
        self.check_rate(piece)
        return self.stream(memory).follow(piece)

    def predict(
        self, record: Record, memories: tuple[ArrayLike | None, ...] | None = None
    ) -> Prediction:
        """
        Return the free-run prediction of a record.

        Parameters
        ----------
        record : Record
            Only its voltage, time and further channels are used.
        memories : tuple of (array_like or None), optional
            Play outputs at the start of each piece; see
            `piezo_ident.model.initial_memory.fit_memory`.

        Raises
        ------
        ModelError
            When a piece has another sampling rate than the model.
        """
        starts = memories if memories is not None else (None,) * len(record.pieces)
        pieces = tuple(self.predict_piece(p, m) for p, m in zip(record, starts, strict=True))
        return Prediction(pieces, self.extrapolation(record))

    def takes(self, piece: Piece) -> bool:
        """Return whether the model holds at the sampling rate of a piece."""
        return self.is_static or abs(piece.sample_rate / self.sample_rate - 1.0) < 1e-6

    def check_rate(self, piece: Piece) -> None:
        """
        Refuse a piece whose sampling rate is not the model's.

        Raises
        ------
        ModelError
        """
        if self.takes(piece):
            return
        raise ModelError(
            f'the record is sampled at {piece.sample_rate:g} Hz, the model at '
            f'{self.sample_rate:g} Hz; identify a model from data of that rate'
        )

    def extrapolation(self, record: Record) -> tuple[str, ...]:
        """Return a warning when the voltage is not of the range in which H was identified."""
        outside = sum(self.outside(p.v) for p in record)
        return self.range_warnings(record.name, outside / record.n, record.voltage_range)

    def outside(self, v: NDArray[np.float64]) -> int:
        """Return how many voltages [V] leave the range in which the model was identified."""
        low, high = self.scaling.range
        slack = 1e-3 * (high - low)
        return int(np.sum((v < low - slack) | (v > high + slack)))

    def range_warnings(
        self, name: str, outside: float, seen: tuple[float, float]
    ) -> tuple[str, ...]:
        """
        Return what to say of voltages that the model was not identified with.

        Parameters
        ----------
        name : str
            Of the record.
        outside : float
            Share of its samples that leave the identified range.
        seen : tuple of float
            Its smallest and largest voltage [V].
        """
        low, high = self.scaling.range
        identified = f'identified range {low:g} .. {high:g} V'
        reach = f'they reach {seen[0]:g} .. {seen[1]:g} V'
        if outside:
            return (
                f'{name}: {outside:.1%} of the samples lie outside the {identified} ({reach}); '
                'the prediction is an extrapolation there',
            )
        largest = max(map(abs, seen))
        if 0.0 < largest < FAINT * max(abs(low), abs(high)):
            return (
                f'{name}: the voltages are next to nothing beside the {identified} ({reach}): '
                'are they in volts?',
            )
        return ()


class Stream:
    """
    One run of a model, block by block, in volts and metres.

    The first sample after `reset`, or after construction, is taken as the command under which the
    stage was at rest.
    """

    def __init__(self, model: StageModel, memory: ArrayLike | None = None) -> None:
        self.model = model
        self._chain = fused(model.chain(memory))
        self._count = 0
        # a chain that is one kernel needs no block to pass along, and knows the scaling itself
        match self._chain.operators:
            case (FusedOperator() as alone,):
                s = model.scaling
                self._alone: FusedOperator | None = alone.scaled(s.v0, s.V, s.y0, s.Y)
                self._chain = Chain((self._alone,))
            case _:
                self._alone = None
        self._started = False

    @property
    def sees_more(self) -> bool:
        """Whether anything but the voltage can matter: time, further channels."""
        return self._alone is None

    def reset(self, v0: float) -> float:
        """Come to rest at a voltage [V] and return the displacement there [m]."""
        u0 = float(self.model.scaling.u(v0))
        self._count, self._started = 0, True
        return float(self.model.scaling.y(self._chain.reset(u0, u0)))

    def follow(self, piece: Piece) -> NDArray[np.float64]:
        """Return the displacement [m] for the next samples, which are a piece or a part of one."""
        if not self.sees_more:
            return self.process(piece.v)
        y = np.empty(piece.n)
        for start in range(0, piece.n, CHUNK):
            cut = slice(start, start + CHUNK)
            channels = {name: x[cut] for name, x in piece.channels.items()}
            y[cut] = self.process(piece.v[cut], piece.time(cut.start, cut.stop), channels)
        return y

    def process(
        self,
        v: ArrayLike,
        t: ArrayLike | None = None,
        channels: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> NDArray[np.float64]:
        """
        Return the displacement [m] for the next stretch of voltage [V].

        Parameters
        ----------
        v : array_like, shape (n,)
        t : array_like, shape (n,), optional
            Time [s]; counted from the first sample when absent.
        channels : mapping of str to ndarray, optional
            Further measured signals.
        """
        x = np.asarray(v, dtype=np.float64)
        if x.size == 0:
            return np.empty(0)
        if not self._started:
            self.reset(float(x[0]))
        if self._alone is not None:
            return self._alone.run(x)
        if t is None:
            time = (self._count + np.arange(x.size)) / self.model.sample_rate
        else:
            time = np.asarray(t, dtype=np.float64)
        self._count += x.size
        u = self.model.scaling.u(x)
        block = self._chain.process(Block(t=time, v=u, x=u, channels=channels or {}))
        return self.model.scaling.y(block.x)
