# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The prediction beside a running stage: block by block, through gaps, restarts and new models.

The plays remember extremes of the voltage as far back as the start of the run, but only few of
them: a loop inside a later stroke leaves no trace (the wiping-out property).  The remaining
turning points, with the samples just before each, and the last seconds in full bring any new model
into the state that it would have if it had run from the start.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel
from piezo_ident.live.block_clock import BlockClock
from piezo_ident.live.sample_clock import Kind
from piezo_ident.model.stage_model import Scaling, StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.blocks import Samples

__all__ = ['Predictor', 'TurningPoints', 'warm_up']

#: time over which the voltage is kept sample by sample, for G of a new model [s]
RECENT = 5.0
#: longest gap that is bridged by a straight line; after a longer one a new run starts [s]
BRIDGE = 0.5
#: time before each turning point of which the samples are kept [s]
APPROACH = 0.05
#: shortest sampling period that is accepted [s], and most blocks that are kept
SHORTEST, MOST_BLOCKS = 1e-7, 100_000
#: share of the voltage range that counts as its lower end, where the memory is known
REST = 0.01

#: what may be wrong with a block
FINE, NOT_FINITE, NOT_UNIFORM = range(3)


@kernel
def _fault(t: NDArray[np.float64], v: NDArray[np.float64]) -> int:
    shortest, longest = np.inf, 0.0
    for k in range(t.size):
        if not (np.isfinite(t[k]) and np.isfinite(v[k])):
            return NOT_FINITE
        if k:
            step = t[k] - t[k - 1]
            shortest, longest = min(shortest, step), max(longest, step)
    if t.size > 1 and not (shortest > 0.999 * SHORTEST and longest < 1.5 * shortest):
        return NOT_UNIFORM
    return FINE


@kernel
def _turns(v: NDArray[np.float64], out: NDArray[np.int64]) -> int:
    # indices of the first and last sample, and of those at which the direction changes
    n, before = 0, 0.0
    for k in range(v.size):
        after = np.sign(v[k + 1] - v[k]) if k + 1 < v.size else np.nan
        if k == 0 or after != before:
            out[n] = k
            n += 1
        before = after
    return n


class TurningPoints:
    """
    The part of a voltage's history that determines the memory of any play operator.

    Of four turning points in a row, the inner two are dropped when they lie between the outer
    two.  The first point always stays.

    Examples
    --------
    >>> points = TurningPoints()
    >>> points.add(np.arange(6.0), np.array([0.0, 4.0, 1.0, 3.0, 2.0, 5.0]))
    >>> points.values.tolist()
    [0.0, 5.0]
    """

    def __init__(self) -> None:
        # value of each point, and the samples that lead to it
        self._points: list[tuple[float, Samples]] = []
        self._tail = Samples(np.empty(0), np.empty(0))

    def __len__(self) -> int:
        return len(self._points)

    def add(self, t: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        """Add the next samples: time [s] and voltage [V]."""
        # most samples of a block lie between two turning points
        turns = np.empty(v.size, dtype=np.int64)
        turns = turns[: _turns(np.array(v, dtype=np.float64), turns)]
        before = self._tail.t.size
        t, v = np.concatenate([self._tail.t, t]), np.concatenate([self._tail.values, v])
        first = np.searchsorted(t, t - APPROACH)
        points = self._points
        for k in (before + turns).tolist():
            x, lead = float(v[k]), Samples(t[first[k] : k + 1], v[first[k] : k + 1])
            if points and x == points[-1][0]:
                continue
            if len(points) > 1 and (points[-1][0] - points[-2][0]) * (x - points[-1][0]) > 0.0:
                points.pop()
            points.append((x, lead))
            while len(points) > 3:
                a, b, c, d = (value for value, _ in points[-4:])
                if not min(a, d) <= min(b, c) <= max(b, c) <= max(a, d):
                    break
                del points[-3:-1]
        self._tail = Samples(t[first[-1] :], v[first[-1] :])

    @property
    def values(self) -> NDArray[np.float64]:
        """Start, turning points and last sample [V]."""
        return np.array([x for x, _ in self._points])

    def path(self, period: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """
        Return time [s] and voltage [V] of a path through the turning points.

        For operators that depend on the speed.  The samples before each point are those that were
        measured; short straight lines connect them.

        Parameters
        ----------
        period : float
            Sampling period [s].
        """
        parts_t: list[NDArray[np.float64]] = []
        parts_v: list[NDArray[np.float64]] = []
        for _, lead in self._points:
            t, v = lead.t, lead.values
            if parts_t:
                end, level = float(parts_t[-1][-1]), float(parts_v[-1][-1])
                t, v = t[t > end], v[t > end]
                missing = min(float(t[0]) - end, APPROACH) / period
                if missing > 1.5:
                    share = np.linspace(0.0, 1.0, round(missing), endpoint=False)[1:]
                    parts_t.append(end + (t[0] - end) * share)
                    parts_v.append(level + (v[0] - level) * share)
            parts_t.append(t)
            parts_v.append(v)
        return np.concatenate(parts_t), np.concatenate(parts_v)


class Predictor:
    """
    Predicts the displacement as blocks of voltage come.

    Attributes
    ----------
    problem : str
        The last problem of the stream; empty without one.
    """

    def __init__(self) -> None:
        self.model: StageModel | None = None
        self.problem = ''
        self._clock = BlockClock()
        self._clear()

    def _clear(self) -> None:
        self._old = TurningPoints()
        self._recent: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()
        self._stream: Stream | None = None
        self._lowest = float('inf')

    @property
    def lost(self) -> int:
        """Samples that are missing or not usable."""
        return self._clock.lost

    @property
    def late(self) -> int:
        """Samples that arrived again or out of order, and were left out."""
        return self._clock.late

    @property
    def restarts(self) -> int:
        """Number of restarts of the sample clock."""
        return self._clock.restarts

    @property
    def memory_known(self) -> bool:
        """
        Whether the memory of the plays is known.

        It is when the voltage has been at its lowest since the start of the run or the last gap.
        """
        return self.model is not None and bool(self.model.scaling.u(self._lowest) < REST)

    @property
    def memory_lost(self) -> bool:
        """Whether blocks arrive and the memory of the plays is not known."""
        return bool(np.isfinite(self._clock.last)) and not self.memory_known

    def set_model(self, model: StageModel) -> None:
        """
        Take a model, in the state that it would have if it had run from the start.

        Raises
        ------
        ModelError
            When its sampling rate differs from that of the stream.
        """
        if np.isfinite(self._clock.period):
            self._check_rate(model)
        self.model = model
        self._stream = self._caught_up(model) if self._recent else None
        if self._recent and self.problem.startswith('the stream'):
            self.problem = ''

    def _check_rate(self, model: StageModel) -> None:
        if model.is_static or abs(self._clock.period * model.sample_rate - 1.0) < 1e-6:
            return
        raise ModelError(
            f'the stream is sampled at {1.0 / self._clock.period:.6g} Hz, the model holds for '
            f'{model.sample_rate:g} Hz; identify a model at the rate of the stream'
        )

    def _caught_up(self, model: StageModel) -> Stream:
        stream = model.stream()
        # without older samples the recent ones are the whole run
        if len(self._old):
            if model.effects_in('input') or model.effects_in('hysteresis'):
                t, v = self._old.path(self._clock.period)
            else:
                # plays alone do not depend on time
                v = self._old.values
                t = np.zeros(v.size)
            stream.recall(v, t)
        t, v = (np.concatenate(x) for x in zip(*self._recent, strict=True))
        stream.process(v, t)
        return stream

    def process(self, samples: Samples) -> Samples | None:
        """
        Return the prediction for a block, or None.

        A gap of up to half a second is bridged by a straight line; after a longer one, and after
        a restart, the stage is taken to be at rest.  Repeated and late blocks, and blocks with
        NaN or infinite numbers, are left out.

        Parameters
        ----------
        samples : Samples
            Of voltage.
        """
        # copies, since the message may change
        t, v = np.array(samples.t, np.float64), np.array(samples.values, np.float64)
        if not self._usable(t, v):
            return None
        clock = self._clock
        before, last = clock.period, clock.last
        kind, count = clock.judge(t)
        if kind is Kind.LATE:
            self.problem = f'samples at t = {t[0]:.6g} s came again or out of turn'
            t, v = t[count:], v[count:]
            if not t.size:
                return None
        elif kind is Kind.START:
            # a program that starts again starts at zero
            if clock.restarts and t[0] > 0.5 * clock.period:
                self.problem = f'time jumps back from {last:.6g} to {t[0]:.6g} s'
            self._clear()
        elif abs(clock.period / before - 1.0) > 1e-3:
            self.problem = f'the sampling rate changed at t = {t[0]:.6g} s'
            self._clear()
        elif kind is Kind.GAP:
            self._bridge(last, float(t[0]), float(v[0]), count)
        y = self._advance(t, v)
        if y is None:
            return None
        return Samples(t, y, samples.segment, 'displacement')

    def _usable(self, t: NDArray[np.float64], v: NDArray[np.float64]) -> bool:
        if not t.size:
            return False
        fault = _fault(t, v)
        if fault == NOT_FINITE:
            # counted when the gap that it leaves is met
            self.problem = (
                f'the block of voltage at t = {t[0]:.6g} s holds NaN or infinite numbers; '
                'it is left out'
            )
        elif fault == NOT_UNIFORM:
            self.problem = f'time is not uniform in the block at t = {t[0]:.6g} s; left out'
        elif t.size == 1 and np.isnan(self._clock.period):
            self.problem = (
                f'the block at t = {t[0]:.6g} s is one sample, which tells no sampling rate; it '
                'is left out'
            )
            return False
        return bool(fault == FINE)

    def _bridge(self, t0: float, t1: float, v1: float, missing: int) -> None:
        self.problem = f'{missing} samples of voltage are missing before t = {t1:.6g} s'
        if missing * self._clock.period > BRIDGE:
            self._clear()
            return
        v0 = float(self._recent[-1][1][-1])
        share = np.arange(1, missing + 1) / (missing + 1)
        self._advance(t0 + (t1 - t0) * share, v0 + (v1 - v0) * share)
        self._lowest = float('inf')

    def _advance(
        self, t: NDArray[np.float64], v: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        self._remember(t, v)
        model = self.model
        if model is None:
            return None
        if self._stream is None:
            try:
                self._check_rate(model)
            except ModelError as error:
                self.problem = str(error)
                return None
            self._stream = model.stream()
        return self._stream.process(v, t)

    def _remember(self, t: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        self._lowest = min(self._lowest, float(v.min()))
        self._recent.append((t, v))
        recent = self._recent
        while t[-1] - recent[0][0][-1] > RECENT or len(recent) > MOST_BLOCKS:
            self._old.add(*self._recent.popleft())


def warm_up() -> None:
    """Compile the kernels of a prediction, or load them, before the first block arrives."""
    model = StageModel(
        sample_rate=1000.0,
        scaling=Scaling(0.0, 1.0, 0.0, 1.0, (0.0, 1.0)),
        hysteresis=Hysteresis(np.array([0.1]), np.array([0.1]), 0.0, 0.9),
        dynamics=Dynamics(np.array([-0.5]), np.array([0.5])),
        delay=Delay(1),
    )
    predictor = Predictor()
    predictor.set_model(model)
    t = np.arange(100) / 1000.0
    predictor.process(Samples(t, t))
    predictor.set_model(model)
    TurningPoints().add(t, t)
