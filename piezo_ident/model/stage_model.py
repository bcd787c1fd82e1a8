# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
StageModel: the chain of operators with its scaling, and its predictions.

    v --> [input] --> [ H ] --> [hidden] --> [ G ] --> [z^-d] --> [output] --> [acquisition] --> y
          [input], [hidden], [output] and [acquisition] hold effects; effects of H wrap it
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar
import warnings

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, finite_vector, Mask
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.effects import find_effect
from piezo_ident.effects.creep import Creep
from piezo_ident.model.front_door import FrontDoor
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stream import Start, StartLike, Stream
from piezo_ident.operators.chain import Block, Chain, Operator, Slot
from piezo_ident.operators.dynamics import Delay, DelayOperator, Dynamics, DynamicsOperator
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.record.record import Piece, Record

T = TypeVar('T')

#: share of the largest identified voltage below which a wrong unit is likelier than a small signal
FAINT = 2e-3


@dataclass(frozen=True, eq=False)
class EffectSetting:
    """
    Effect in a model: its name and parameters.

    Raises ModelError if the name is unknown or a parameter is not as the effect declares.
    """

    name: str
    parameters: Mapping[str, Any]

    def __post_init__(self) -> None:
        values = find_effect(self.name).check(self.parameters)
        object.__setattr__(self, 'parameters', MappingProxyType(values))

    @property
    def slot(self) -> str:
        """Place in the chain."""
        return find_effect(self.name).slot

    @property
    def channel(self) -> str:
        """Further measured signal that the effect needs; empty without one."""
        return str(self.parameters.get('channel', ''))


@dataclass(frozen=True, eq=False)
class StageModel(FrontDoor):
    """
    Model of a stage: H, G, delay and effects, with its scaling and its identification.

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
        If the dynamics are unstable or the rate is not positive.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> model.delay.samples, model.dynamics.a.size
    (3, 10)
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

    def __repr__(self) -> str:
        low, high = self.scaling.range
        h, g = self.hysteresis, self.dynamics
        effects = ', '.join(effect.name for effect in self.effects) or 'none'
        return (
            f'StageModel({self.sample_rate:g} Hz, {low:g} .. {high:g} V, '
            f'{len(h.thresholds)} thresholds, na = {g.a.size}, nb = {g.b.size}, '
            f'delay {self.delay.total:g} samples, effects: {effects})'
        )

    @property
    def is_static(self) -> bool:
        """Whether the model is H and a gain alone, and so holds at any sampling rate."""
        return self.dynamics.is_static and self.delay.total == 0.0 and not self.effects

    def used(self, channels: Mapping[str, T]) -> dict[str, T]:
        """Select the further signals that effects of the model depend on."""
        return {e.channel: channels[e.channel] for e in self.effects if e.channel in channels}

    def without_dynamics(self) -> StageModel:
        """Reduce the model to its hysteresis, times the static gain of G."""
        static = replace(Dynamics.unit(), b=np.array([self.dynamics.gain]))
        return replace(self, dynamics=static, delay=Delay(0), effects=())

    def chain(self, start: StartLike = None) -> Chain:
        """
        Make new operators, in the order of the chain.

        Parameters
        ----------
        start : Start or array_like, optional
            As of `simulate`.

        Raises
        ------
        ModelError
            If the start belongs to another model.
        """
        start = Start.of(start)
        core: Operator = HysteresisOperator(self.hysteresis, start.memory)
        for setting in self.effects_in('hysteresis'):
            effect = find_effect(setting.name)
            core = effect(self.sample_rate, setting.parameters, self.hysteresis, core)
        hidden = self._operators('hidden')
        for operator in hidden:
            if isinstance(operator, Creep):
                operator.start_from(start.creep)
        return Chain(
            (
                *self._operators('input'),
                core,
                *hidden,
                DynamicsOperator(self.dynamics),
                DelayOperator(self.total_delay),
                *self._operators('output'),
                *self._operators('acquisition'),
            )
        )

    def effects_in(self, slot: Slot) -> list[EffectSetting]:
        """List the effects with an operator in a slot; a change of the delay has no operator."""
        return [
            s for s in self.effects if s.slot == slot and not find_effect(s.name).in_delay_line
        ]

    def _operators(self, slot: Slot) -> list[Operator]:
        return [find_effect(s.name)(self.sample_rate, s.parameters) for s in self.effects_in(slot)]

    def input_chain(self) -> Chain:
        """Make new operators of the effects in the input slot."""
        return Chain(tuple(self._operators('input')))

    def hysteresis_input(self, piece: Piece) -> Array:
        """Compute the normalised voltage behind the effects of the input slot, shape (n,)."""
        u = self.scaling.u(piece.v)
        chain = self.input_chain()
        chain.reset(float(u[0]), float(u[0]))
        return chain.process(Block(t=piece.t, v=u, x=u, channels=piece.channels)).x

    @property
    def total_delay(self) -> Delay:
        """Identified delay, with its change by effects; ModelError if the sum is negative."""
        added = sum(find_effect(s.name).added_delay(s.parameters) for s in self.effects)
        if added == 0.0:
            return self.delay
        total = self.delay.total + added
        if total < 0.0:
            raise ModelError(
                f'model: a delay of {self.delay.total:g} samples cannot change by {added:g}; '
                'the sum must not be negative'
            )
        whole = int(total)
        return Delay(whole, total - whole)

    def simulate(
        self,
        v: ArrayLike,
        *,
        channels: Mapping[str, ArrayLike] | None = None,
        start: StartLike = None,
    ) -> Array:
        """
        Simulate the displacement under a voltage in free run; warn outside the identified range.

        Parameters
        ----------
        v : array_like, shape (n,)
            Voltage [V], sampled at `sample_rate`; the stage is at rest under the first sample.
        channels : mapping of str to array_like, shape (n,), optional
            Further signals that effects of the model depend on; others cost a warning.
        start : Start, or array_like of shape (m,) or (m + k,), optional
            Play outputs before the first sample, normalised, and behind them the lags along the
            path.  By default these belong to a stage that last came down to zero.  A
            `piezo_ident.model.stream.Start` also holds the distance of creep from its rest.

        Returns
        -------
        ndarray, shape (n,)
            Displacement [m].

        Raises
        ------
        DataError
            If the voltage is not a vector of finite numbers, or a channel has another length.
        ModelError
            If an effect needs a missing channel.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> model = pi.SimulatedStage.load('paper').model
        >>> f'{1e6 * model.simulate([0.0] * 3 + [10.0] * 997)[-1]:.1f} um'
        '71.3 um'
        """
        x = finite_vector(v, 'simulate', 'voltage', 'finite numbers in volts')
        if not x.size:
            return np.empty(0)
        piece = Piece(x, x, self.sample_rate, channels=channels or {})  # type: ignore[arg-type]
        for name, z in piece.channels.items():
            if bad := np.count_nonzero(~np.isfinite(z)):
                raise DataError(f'simulate: the channel {name} has {bad} bad or masked numbers')
        warn_of_unused([self], piece.channels)
        for warning in self.extrapolation(Record((piece,), 'simulate')):
            warnings.warn(warning, stacklevel=2)
        return self.stream(start).follow(piece)

    def stream(self, start: StartLike = None) -> Stream:
        """
        Start a run of this model that takes the voltage block by block.

        Parameters
        ----------
        start : Start or array_like, optional
            As of `simulate`.

        Examples
        --------
        >>> import numpy as np
        >>> import piezo_ident as pi
        >>> model = pi.SimulatedStage.load('paper').model
        >>> v = 5 + 5 * np.sin(np.arange(300) / 50)
        >>> stream = model.stream()
        >>> y = np.concatenate([stream.process(v[:100]), stream.process(v[100:])])
        >>> bool(np.all(y == model.simulate(v)))
        True
        """
        return Stream(self, start)

    def predict_piece(self, piece: Piece, start: StartLike = None) -> Array:
        """Predict the displacement [m], shape (n,), of a piece that `check_rate` accepts."""
        self.check_rate(piece)
        return self.stream(start).follow(piece)

    def takes(self, piece: Piece) -> bool:
        """Tell whether the model holds at the sampling rate of a piece."""
        return self.is_static or abs(piece.sample_rate / self.sample_rate - 1.0) < 1e-6

    def check_rate(self, piece: Piece) -> None:
        """Refuse a piece with another sampling rate than the model with a ModelError."""
        if not self.takes(piece):
            raise ModelError(
                f'the record is sampled at {piece.sample_rate:g} Hz, the model at '
                f'{self.sample_rate:g} Hz; identify a model from data of that rate'
            )

    def outside(self, v: Array) -> Mask:
        """Mark the voltages [V] outside the identified range."""
        low, high = self.scaling.range
        slack = 1e-3 * (high - low)
        return np.asarray((v < low - slack) | (v > high + slack))

    def extrapolation(self, record: Record) -> tuple[str, ...]:
        """Warn if the voltage leaves the identified range, or is far smaller than it."""
        low, high = self.scaling.range
        least, most = record.voltage_range
        identified = f'the identified range {low:g} .. {high:g} V'
        reach = f'{record.name}: the voltage spans {least:g} .. {most:g} V'
        outside = sum(int(self.outside(p.v).sum()) for p in record)
        if outside:
            return (
                f'{reach}; {outside / record.n:.1%} of the samples lie outside {identified}, '
                'where the prediction is an extrapolation',
            )
        if 0.0 < max(abs(least), abs(most)) < FAINT * max(abs(low), abs(high)):
            return (f'{reach}, far less than {identified}; is it in volts?',)
        return ()


def warn_of_unused(models: Iterable[StageModel], channels: Iterable[str]) -> None:
    """Warn the caller of a verb about channels that no effect of the models depends on."""
    used = {effect.channel for model in models for effect in model.effects}
    for name in sorted(set(channels) - used):
        warnings.warn(f'no effect of the model uses the channel {name}', stacklevel=3)
