# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimate beside a running stage: prediction and displacement joined for an observer.

An estimate waits until the displacement of a horizon before has come, or is known to be missing:
later displacement has come, or for `PATIENCE` none did.  It therefore does not matter which of the
two streams comes first.  What still waits when a stream starts over has no estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import DataError
from piezo_ident.fitting.adaptation import Adaptation, Learns, Recalled
from piezo_ident.live.block_clock import BlockClock
from piezo_ident.live.predictor import BRIDGE
from piezo_ident.live.sample_clock import Kind
from piezo_ident.model.observer import HORIZON, Observed, Observer
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.record.blocks import Samples

#: what an observer tells of its corrections, and of which of its numbers
CORRECTIONS = {
    'offset/value': 'offset',
    'offset/std': 'offset_std',
    'creep/value': 'creep',
    'creep/std': 'creep_std',
    'memory/band': 'band',
    'estimate/std': 'std',
}
#: the same of a gain that is followed
GAIN = {'gain/value': 'gain', 'gain/std': 'gain_std'}
#: the names of what is learnt
LEARNT = ('learnt/gain', 'learnt/loop')
#: corrections a second
RATE = 50.0
#: share of the span by which the band of unknown plays may shrink in a block that is judged: while
#: plays become known what is left is a matter of them
SETTLED = 1e-5
#: share of the span from which creep of earlier motion is told
FAINT = 1e-4
#: standard deviations from which a change of the gain is told (taste)
SURE = 3.0
#: time of the stream for which displacement is waited for [s]
PATIENCE = 0.5
#: time constant by which a wanted motion takes over what is found: a step would excite the modes
#: of a stage [s] (taste)
FADE = 0.01
#: what it takes over at most, as a share of the span: a sensor may be at fault (taste)
MOST = 0.1


def gain_change(value: float, std: float) -> str:
    """Return a change of the gain by size; empty where it is not sure."""
    if not abs(value) > SURE * std > 0.0:
        return ''
    return f'gain {100.0 * value:+.1f} +- {max(100.0 * std, 0.05):.1f} %'


@dataclass(frozen=True, eq=False)
class Estimated:
    """
    An estimate as a block, and what the observer says of its samples.

    Attributes
    ----------
    samples : Samples
    seen : Observed
    corrections : list of dict
        The numbers of `CORRECTIONS`, of the first sample of each stretch of a steady rate.
    is_settled : bool
        Whether what is left is no matter of plays that become known.
    """

    samples: Samples
    seen: Observed
    corrections: list[dict[str, float]]
    is_settled: bool


@dataclass(frozen=True, eq=False)
class _Block:
    """A block of prediction that waits: its first tick, and the voltage."""

    tick: int
    prediction: Samples
    v: Array


class Corrector:
    """
    Corrects predictions by displacement that comes at least a horizon before.

    Parameters
    ----------
    horizon : int, optional
        [samples]
    gain : bool, optional
        Whether the gain is followed, too.
    rate : float, optional
        Corrections that are told a second of the stream.
    adapt : {'off', 'gain', 'hysteresis'}, optional
        What the estimate learns of the stage: what the observer corrects is then the free run of
        the model that was learnt.

    Attributes
    ----------
    told : dict
        The corrections that were told last.
    """

    def __init__(
        self, horizon: int = HORIZON, gain: bool = False, rate: float = RATE, adapt: Learns = 'off'
    ) -> None:
        self._horizon, self._gain, self._rate, self._adapt = horizon, gain, rate, adapt
        self._model: StageModel | None = None
        self._adaptation: Adaptation | None = None
        self._is_new = False
        self.told: dict[str, float] = {}
        self._bin = -1
        self._forget()

    @property
    def knows_memory(self) -> bool:
        """Whether the voltage of the run, with its gaps, tells the outputs of all plays."""
        # the observer learns of a gap when the displacement of its time is decided
        gaps = any(np.isnan(block.prediction.t[0]) for block in self._waiting)
        return self._observer is not None and self._observer.known and not gaps

    @property
    def span(self) -> float:
        """Displacement of the model over its range [m]; infinite without a model."""
        return abs(self._model.scaling.Y) if self._model is not None else np.inf

    def set_model(self, model: StageModel, recalled: Recalled = StageModel.stream) -> None:
        """
        Take the model that predicts from now on.

        `recalled` makes of a model a run under the voltage so far; at rest when absent.
        """
        self._model = model
        self._learn_anew(recalled)

    def set_up(
        self, horizon: int, gain: bool, adapt: Learns, recalled: Recalled = StageModel.stream
    ) -> None:
        """Take another horizon, or follow the gain or not, or learn, and begin anew."""
        self._horizon, self._gain, self._adapt = horizon, gain, adapt
        self._learn_anew(recalled)

    def _learn_anew(self, recalled: Recalled) -> None:
        self._adaptation, self._is_new = None, True
        if self._model is not None and self._adapt != 'off':
            self._adaptation = Adaptation(self._model, self._adapt, self._horizon, recalled)
        self.told = {}
        self._forget()

    @property
    def learnt(self) -> StageModel:
        """The model with what was learnt; DataError where nothing is."""
        if self._adaptation is None:
            raise DataError('nothing is learnt: there is no model, or the parameter adapt is off')
        return self._adaptation.learnt_model

    def restore(self) -> str:
        """Forget what was learnt; return what that was."""
        said = self.learnt.identification['adaptation'][-1]['seconds']
        if self._adaptation is not None:
            self._adaptation.restore()
        return f'the model is as it was given; forgotten: what {said:g} s of motion told'

    def ahead(self, lead: int, n: int) -> tuple[Array, float]:
        """
        Return what offset and creep [m] will be, shape (n,), and the relative change of the gain.

        The first of the samples comes `lead` samples behind the last voltage.
        """
        if self._observer is None:
            return np.zeros(n), 0.0
        waiting = sum(block.v.size for block in self._waiting)
        return self._observer.ahead(lead + waiting, n)

    def accept(self) -> str:
        """Take the present step of the sensor as its zero; return what was accepted."""
        if self._observer is None:
            raise DataError('there is no estimate yet: no step to accept')
        return f'a step of {1e6 * self._observer.accept():+.3g} um is taken as the zero'

    @property
    def corrected(self) -> str:
        """What is corrected, by size."""
        offset, creep, gain, std = (
            self.told.get(name, 0.0)
            for name in ('offset/value', 'creep/value', 'gain/value', 'gain/std')
        )
        parts = [f'offset {1e6 * offset:+.2g} um']
        if abs(creep) > FAINT * self.span:
            parts.append(f'creep from earlier motion {1e6 * creep:+.2g} um')
        if said := gain_change(gain, std):
            parts.append(said)
        learnt = [(name, self.told.get(name, 0.0)) for name in LEARNT]
        parts += [f'{name.replace("/", " ")} {100.0 * x:+.2g} %' for name, x in learnt if x]
        return ', '.join(parts)

    def _forget(self) -> None:
        self._clock = BlockClock()
        self._observer: Observer | None = None
        self._waiting: list[_Block] = []
        self._measured: list[tuple[Integers, Array]] = []
        # the tick that comes next, and the newest ones that displacement has told of and that are
        # decided
        self._next, self._told, self._decided = 0, -1, -1
        self._last: tuple[float, float] | None = None
        # whether what is left is no matter of plays that become known
        self._is_settled = True

    def predicted(self, prediction: Samples, voltage: Samples, known: bool) -> list[Estimated]:
        """
        Take a prediction, of the last samples of a block of voltage; return what can be estimated.

        `known` is whether a run that was under way before this model has the memory of the plays.
        """
        if self._model is None:
            return []
        t, v = prediction.t, voltage.values[-prediction.t.size :].astype(np.float64)
        before = self._clock.period
        kind, missing = self._clock.judge(t)
        period = self._clock.period
        if kind is Kind.LATE:
            return []
        jumps = kind is Kind.GAP and missing * period > BRIDGE
        if kind is Kind.START or jumps or abs(period / before - 1.0) > 1e-3:
            known &= kind is Kind.START and not self._clock.restarts
            self._forget()
            self._clock.judge(t)
            model = self._model
            if model.is_static:
                model = replace(model, sample_rate=1.0 / period)
            if self._adaptation is not None and not self._is_new:
                self._adaptation.begin()
            self._is_new = False
            self._observer = Observer(model, horizon=self._horizon, known=known, gain=self._gain)
        elif kind is Kind.GAP and self._last is not None:
            # as the prediction went on, over a straight line
            share = np.arange(1, missing + 1) / (missing + 1)
            v0, y0 = self._last
            y = y0 + (float(prediction.values[0]) - y0) * share
            self._wait(Samples(np.full(missing, np.nan), y), v0 + (float(v[0]) - v0) * share)
        self._wait(prediction, v)
        self._last = float(v[-1]), float(prediction.values[-1])
        return self._estimates()

    def _wait(self, prediction: Samples, v: Array) -> None:
        self._waiting.append(_Block(self._next, prediction, v))
        self._next += v.size

    def measured(self, t: Array, y: Array) -> list[Estimated]:
        """Take displacement [m] of times that were predicted; return what can be estimated."""
        if self._observer is None or np.isnan(self._clock.period):
            return []
        ticks = np.rint((t - self._clock.begin) / self._clock.period).astype(np.int64)
        self._measured.append((ticks, y))
        self._told = max(self._told, int(ticks[-1]))
        return self._estimates()

    def _estimates(self) -> list[Estimated]:
        """Return the estimates of the blocks whose displacement is decided."""
        newest, decided = self._next - 1, self._told
        if (newest - self._told) * self._clock.period >= PATIENCE:
            decided = max(decided, newest - self._horizon)
        self._decided = max(self._decided, decided)
        done = []
        while self._waiting and self._observer is not None:
            block = self._waiting[0]
            first, end = (block.tick + n - self._horizon for n in (0, block.v.size))
            if end - 1 > self._decided:
                break
            self._waiting.pop(0)
            y = np.full(block.v.size, np.nan)
            for ticks, values in self._measured:
                here = (ticks >= first) & (ticks < end)
                y[ticks[here] - first] = values[here]
            self._measured = [part for part in self._measured if part[0][-1] >= end]
            free = self._learnt_run(block, y)
            seen = self._observer.process(block.v, free, y)
            self._is_settled = bool(np.ptp(seen.band) <= SETTLED * self.span)
            if np.isnan(block.prediction.t[0]):
                # nobody saw the voltage
                self._observer.lose_memory()
                continue
            samples = replace(block.prediction, values=seen.estimate)
            done.append(Estimated(samples, seen, self._tell(samples.t, seen), self._is_settled))
        return done

    def _learnt_run(self, block: _Block, y: Array) -> Array:
        """Return the free run of the model that was learnt, from displacement a horizon before."""
        free = block.prediction.values
        if self._adaptation is None:
            return free
        ticks = np.arange(block.tick, block.tick + free.size, dtype=np.float64)
        t = self._clock.begin + ticks * self._clock.period
        return self._adaptation.process(block.v, t, free, y, self._is_settled)

    def _tell(self, t: Array, seen: Observed) -> list[dict[str, float]]:
        """Return the corrections that begin a stretch."""
        names = CORRECTIONS | (GAIN if self._gain else {})
        # rounding may put a sample just before its stretch
        bins = np.floor(t * self._rate + 1e-6).astype(np.int64)
        first = np.flatnonzero(np.diff(bins, prepend=self._bin)).tolist()
        learnt = {} if self._adaptation is None else self._adaptation.told
        rows = [{n: float(getattr(seen, x)[k]) for n, x in names.items()} | learnt for k in first]
        self._bin, self.told = int(bins[-1]), rows[-1] if rows else self.told
        return rows


class Follower:
    """
    Moves a wanted motion by what the stage is off, so that the stage goes where it is wanted.

    What a model makes of the corrected motion is that motion; the stage adds offset, creep and
    gain to it.

    Parameters
    ----------
    model : StageModel
    gain : bool
        Whether the gain is followed, too.
    step : float
        Largest change of the correction from one sample to the next [m].
    stream : Stream, optional
        A run of the model up to now; at rest when absent.
    known : bool, optional
        Whether that run has the memory of the plays.

    Attributes
    ----------
    corrector : Corrector
    is_limited : bool
        Whether the last correction was as large as it may be.
    """

    def __init__(
        self,
        model: StageModel,
        gain: bool,
        step: float,
        stream: Stream | None = None,
        known: bool = False,
    ) -> None:
        self.corrector, self._model, self._step = Corrector(gain=gain), model, step
        self.corrector.set_model(model)
        self._stream, self._known = stream or model.stream(), known
        self._newest = -np.inf
        # what is applied of what the stage adds [m], and of its gain
        self._offset = self._gain = 0.0
        self.is_limited = False

    def drove(self, t: Array, v: Array) -> None:
        """Take the voltage [V] that left, with its time [s]; at least one sample."""
        self._newest = float(t[-1])
        prediction = Samples(t, self._stream.process(v, t))
        self.corrector.predicted(prediction, Samples(t, v), self._known)

    def measured(self, samples: Samples) -> None:
        """Take a block of displacement; what is no number, or ahead of the voltage, is none."""
        usable = np.isfinite(samples.values) & (samples.t <= self._newest)
        if usable.any():
            self.corrector.measured(samples.t[usable], samples.values[usable])

    def process(self, wanted: Array, lead: int) -> Array:
        """
        Return the next samples of a wanted motion [m], corrected; shapes (n,).

        The first of them is wanted `lead` samples behind the last voltage.
        """
        n, s = wanted.size, self._model.scaling
        offset, gain = self.corrector.ahead(lead + n - 1, 1)
        share = 1.0 - np.exp(-n / (FADE * self._model.sample_rate))
        most = n * self._step
        way = float(np.clip(share * (offset[0] - self._offset), -most, most))
        most /= abs(s.Y)
        turn = float(np.clip(share * (np.clip(gain, -MOST, MOST) - self._gain), -most, most))
        part = np.arange(1, n + 1) / n
        add = self._offset + way * part
        gains = self._gain + turn * part
        self._offset, self._gain = self._offset + way, self._gain + turn
        change = (wanted - s.y0 - add) / (1.0 + gains) + s.y0 - wanted
        limit = MOST * abs(s.Y)
        self.is_limited = bool(np.abs(change).max() > limit)
        return wanted + np.clip(change, -limit, limit)
