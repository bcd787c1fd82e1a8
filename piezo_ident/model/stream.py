# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run a model block by block: volts in, metres out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, line_between, real_array
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator
from piezo_ident.operators.hysteresis import HysteresisOperator
from piezo_ident.operators.kernels import cascade, STRETCH
from piezo_ident.record.readings.gaps import follows, played_before
from piezo_ident.record.record import Piece

if TYPE_CHECKING:
    from piezo_ident.model.stage_model import StageModel

#: number of samples that pass the chain at once; the signals then stay in the cache
CHUNK = 8192


@dataclass(frozen=True, eq=False)
class Start:
    """
    State of a stage from its motion before a run.

    Attributes
    ----------
    memory : array_like, shape (m,) or (m + k,), or None
        Play outputs, normalised, and behind them the lags along the path.  None stands for the
        outputs of a stage that last came down to zero.
    creep : ndarray, shape (c,)
        Distance of each element of creep from its rest, normalised; empty if all are at rest.
    """

    memory: ArrayLike | None = None
    creep: Array = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(cls, start: StartLike) -> Start:
        """Make a start; a bare array is the memory of the plays."""
        return start if isinstance(start, Start) else cls(start)


#: start of a run; a bare array is the memory of the plays
StartLike: TypeAlias = 'Start | ArrayLike | None'


class Stream:
    """
    Run of a model, block by block, in volts and metres.

    After construction or `reset` the stage is at rest under the first sample, except for the
    state in `start`.
    """

    def __init__(self, model: StageModel, start: StartLike = None) -> None:
        self.model = model
        self._chain = model.chain(start)
        self._count = 0
        self._started = False
        self._cascade: _Cascade | None = None
        match self._chain.operators:
            case (HysteresisOperator() as H, DynamicsOperator() as G, DelayOperator() as z):
                if model.dynamics.sections is None:
                    self._cascade = _Cascade(model, H, G, z)

    def reset(self, v0: float) -> float:
        """Come to rest at a voltage [V]; the result is the displacement there [m]."""
        u0 = float(self.model.scaling.u(v0))
        self._count, self._started = 0, True
        if self._cascade is not None:
            return self._cascade.reset(u0)
        return float(self.model.scaling.y(self._chain.reset(u0, u0)))

    def follow(self, piece: Piece) -> Array:
        """Compute the displacement [m] for the next samples, a piece or a part of a piece."""
        y = np.empty(piece.n)
        for start in range(0, piece.n, CHUNK):
            cut = slice(start, start + CHUNK)
            if self._cascade is not None:
                y[cut] = self.process(piece.v[cut])
                continue
            channels = {name: x[cut] for name, x in piece.channels.items()}
            y[cut] = self.process(piece.v[cut], piece.time(cut.start, cut.stop), channels)
        return y

    def bridge(self, one: Piece, other: Piece) -> None:
        """Cross the gap between two pieces of one clock; an unknown voltage becomes a line."""
        if played := played_before(one, other):
            self.follow(played)
            return
        missing = follows(one, other)
        if not missing:
            return

        def line(before: Array, after: Array) -> Array:
            return line_between(float(before[-1]), float(after[0]), missing)

        channels = {k: line(x, other.channels[k]) for k, x in one.channels.items()}
        time = line(one.time(one.n - 1, one.n), other.time(0, 1))
        self.process(line(one.v, other.v), time, channels)

    def recall(self, v: Array, t: Array) -> None:
        """
        Run through a past voltage [V] at the times t [s], shapes (n,).

        The stage was at rest before the first sample.  Effects behind H are at rest after the last
        one, because a past of turning points has lost the times on which they depend.
        """
        self.reset(float(v[0]))
        if self._cascade is not None:
            self._cascade.run(v)
            return
        u = self.model.scaling.u(v)
        block = Block(t=t, v=u, x=u)
        for operator in self._chain.operators:
            x = block.x
            if getattr(operator, 'slot', None) in ('hidden', 'output', 'acquisition'):
                rest = operator.reset(float(u[-1]), float(x[-1]))
                block = block.with_signal(np.full(x.size, rest))
            else:
                block = operator.process(block)

    def process(
        self, v: ArrayLike, t: ArrayLike | None = None, channels: Mapping[str, Array] | None = None
    ) -> Array:
        """
        Compute the displacement [m] for the next samples of voltage [V], shape (n,).

        The time [s] is counted from the first sample by default.  `channels` are further measured
        signals.
        """
        x = real_array(v, 'stream, voltage')
        if x.size == 0:
            return np.empty(0)
        if not self._started:
            self.reset(float(x[0]))
        if self._cascade is not None:
            return self._cascade.run(x)
        if t is None:
            time = (self._count + np.arange(x.size)) / self.model.sample_rate
        else:
            time = np.asarray(t, dtype=np.float64)
        self._count += x.size
        u = self.model.scaling.u(x)
        block = self._chain.process(Block(t=time, v=u, x=u, channels=channels or {}))
        return self.model.scaling.y(block.x)


class _Cascade:
    """H, G and z^-d of a model without other effects, in one compiled loop."""

    def __init__(
        self, model: StageModel, H: HysteresisOperator, G: DynamicsOperator, z: DelayOperator
    ) -> None:
        s = model.scaling
        past_w, past_y = G.b.size - 1, max(G.a.size, z.delay.samples + 1)
        # without this room, a long delay would spend its time on moving its past
        room = max(STRETCH, past_y)
        self._H, self._G, self._delay = H, G, z.delay
        self._w, self._y = np.empty(past_w + room), np.empty(past_y + room)
        self._scale = np.array([s.v0, s.V, s.y0, s.Y])
        h = model.hysteresis
        lags = np.empty((0, 4)) if h.relaxations is None else np.array(h.relaxations)
        self._hysteresis = (*h.for_kernel, lags)

    def reset(self, u0: float) -> float:
        """Come to rest; the result is the displacement there [m]."""
        w0 = self._H.reset(u0, u0)
        rest = self._G.reset(u0, w0)
        m, memory = self._H.hysteresis.thresholds.size, self._H.memory
        idle = np.zeros(self._hysteresis[0].size - m)
        self._memory = np.concatenate([memory[:m], idle, memory[m:]])
        self._w[:], self._y[:] = w0, rest
        y0, Y = self._scale[2:]
        return float(y0 + Y * rest)

    def run(self, v: Array) -> Array:
        """Compute the displacement [m] for the next samples, shape (n,)."""
        out = np.empty(v.size)
        # a copy of a frozen array, which would be another type to the compiler
        v = v if v.flags.carray else v.copy()
        cascade(
            v,
            self._scale,
            *self._hysteresis,
            self._memory,
            self._G.b,
            self._G.a,
            self._w,
            self._y,
            self._delay.samples,
            self._delay.fraction,
            out,
        )
        return out
