# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimate the displacement of a running axis from its prediction and earlier displacement.

Gain, hysteresis and creep belong to the motion of an axis by its own voltage.  The motion by other
axes is therefore subtracted from prediction and displacement, and added to the estimate.

An observer corrects a sample of the prediction by displacement at least a horizon earlier.  The
sample waits until this displacement has come or is missing: later displacement has come, or none
for `PATIENCE`.  The order in which prediction and displacement arrive therefore makes no
difference.  Samples that still wait when the stream starts over are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers, lines_between
from piezo_ident.common.errors import DataError
from piezo_ident.fitting.adaptation import Adaptation, Learns, Recalled
from piezo_ident.fitting.attribution import Attribution, percent_change, SURE
from piezo_ident.live.predictor import BRIDGE
from piezo_ident.live.sample_clock import BlockClock, Kind
from piezo_ident.model.observer import ACCEPT_AFTER, HORIZON, Observed, Observer
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import Samples

#: names of the corrections, with the attribute of `Observed` that holds each
CORRECTIONS = {
    'offset/value': 'offset',
    'offset/std': 'offset_std',
    'creep/value': 'creep',
    'creep/std': 'creep_std',
    'memory/band': 'band',
    'estimate/std': 'std',
}
#: the same for the gain, if it is followed
GAIN = {
    'gain/value': 'gain',
    'gain/std': 'gain_std',
    'gain/drift': 'drift',
    'gain/drift_std': 'drift_std',
}
#: names of the learnt changes of the model
LEARNT = ('learnt/gain', 'learnt/loop')
#: corrections published per second of the stream
RATE = 50.0
#: largest change of the band of unknown plays in a block from which the model learns, as a share
#: of the span.  In other blocks the error is due to these plays.
SETTLED = 1e-5
#: smallest creep from earlier motion that is mentioned, as a share of the span
FAINT = 1e-4
#: longest wait for displacement, in time of the stream [s]
PATIENCE = 0.5


@dataclass(frozen=True, eq=False)
class Estimated:
    """
    A block of the estimate, with the state of the observer at its samples.

    Attributes
    ----------
    samples : Samples
    seen : Observed
    corrections : list of dict
        The numbers of `CORRECTIONS`, `rate` times a second of the stream.
    is_settled : bool
        Whether the band of unknown plays stays the same over the block, see `SETTLED`.
    """

    samples: Samples
    seen: Observed
    corrections: list[dict[str, float]]
    is_settled: bool


@dataclass(frozen=True, eq=False)
class _Block:
    """A waiting block: first tick, prediction, voltage, and motion by other axes [m]."""

    tick: int
    prediction: Samples
    v: Array
    felt: Array


class Corrector:
    """
    Corrects predictions by displacement of at least a horizon before.

    Parameters
    ----------
    horizon : int, optional
        [samples]
    gain, drift : bool, optional
        Whether the gain is followed, too, and whether it is followed as a drifting gain.
    adapt : {'off', 'gain', 'hysteresis'}, optional
        Part of the model that the corrector learns.  The observer then corrects the free run of
        the learnt model.
    accept_after : float, optional
        Time after which the observer believes a step of the sensor [s].
    rate : float, optional
        Corrections published per second of the stream.

    Attributes
    ----------
    told : dict
        The corrections published last.
    """

    def __init__(
        self,
        horizon: int = HORIZON,
        gain: bool = False,
        drift: bool = False,
        adapt: Learns = 'off',
        accept_after: float = ACCEPT_AFTER,
        rate: float = RATE,
    ) -> None:
        self._horizon, self._gain, self._drift, self._adapt = horizon, gain, drift, adapt
        self._rate, self._accept_after = rate, accept_after
        self._model: StageModel | None = None
        self._adaptation: Adaptation | None = None
        self._attribution: Attribution | None = None
        self._is_new = False
        # makes the runs of a stream that starts over
        self._at_rest: Recalled = StageModel.stream
        self.told: dict[str, float] = {}
        self._bin = -1
        self._forget()

    @property
    def knows_memory(self) -> bool:
        """Whether the voltage of the run, with its gaps, determines the outputs of all plays."""
        # the observer learns of a gap when the displacement of its time is decided
        gaps = any(np.isnan(block.prediction.t[0]) for block in self._waiting)
        return self._observer is not None and self._observer.known and not gaps

    @property
    def span(self) -> float:
        """Displacement of the model over its range [m]; infinite without a model."""
        return abs(self._model.scaling.Y) if self._model is not None else np.inf

    def set_model(self, model: StageModel, recalled: Recalled = StageModel.stream) -> None:
        """Take the model that predicts from now on; `recalled` gives its run up to now."""
        self._model = model
        self._learn_anew(recalled)

    def set_up(
        self,
        horizon: int,
        gain: bool,
        drift: bool,
        adapt: Learns,
        accept_after: float,
        *,
        recalled: Recalled = StageModel.stream,
    ) -> None:
        """Change the settings, see `Corrector`, and forget the observer and the learnt part."""
        self._horizon, self._gain, self._drift, self._adapt = horizon, gain, drift, adapt
        self._accept_after = accept_after
        self._learn_anew(recalled)

    def _learn_anew(self, recalled: Recalled) -> None:
        self._adaptation, self._is_new = None, True
        self._at_rest = None if recalled is None else StageModel.stream
        if self._model is not None:
            self._attribution = Attribution(self._model, self._horizon, recalled)
            if self._adapt != 'off':
                self._adaptation = Adaptation(self._model, self._adapt, self._horizon, recalled)
        self.told = {}
        self._forget()

    @property
    def _learning(self) -> Adaptation:
        """The adaptation; DataError if the corrector does not learn."""
        if self._adaptation is None:
            raise DataError('nothing is learnt: there is no model, or the parameter adapt is off')
        return self._adaptation

    @property
    def learnt(self) -> StageModel:
        """The learnt model; DataError if the corrector does not learn."""
        return self._learning.learnt_model

    def restore(self) -> str:
        """Return to the model of `set_model`; the text gives the forgotten time."""
        adaptation = self._learning
        seconds = round(adaptation.seconds, 3)
        adaptation.restore()
        return f'the model is as it was given; forgotten: what {seconds:g} s of motion told'

    def accept(self) -> str:
        """Take the present step of the sensor as its zero; the message gives its size."""
        if self._observer is None:
            raise DataError('there is no estimate yet: no step to accept')
        return f'a step of {1e6 * self._observer.accept():+.3g} um is taken as the zero'

    @property
    def corrected(self) -> str:
        """Sizes of the corrections, as text."""
        offset, creep, gain, std, drift, drift_std = (
            self.told.get(name, 0.0) for name in ('offset/value', 'creep/value', *GAIN)
        )
        parts = [f'offset {1e6 * offset:+.2g} um']
        if abs(creep) > FAINT * self.span:
            parts.append(f'creep from earlier motion {1e6 * creep:+.2g} um')
        if abs(gain) > SURE * std > 0.0:
            parts.append(f'gain {percent_change(gain, std)}')
        if abs(drift) > SURE * drift_std > 0.0:
            parts.append(f'drift of the gain {100.0 * drift:+.2g} % a second')
        learnt = [(name, self.told.get(name, 0.0)) for name in LEARNT]
        parts += [f'{name.replace("/", " ")} {100.0 * x:+.2g} %' for name, x in learnt if x]
        return ', '.join(parts)

    @property
    def changed(self) -> str:
        """Likely causes of the error that the corrections leave, as text; '' without any."""
        causes = self._attribution.causes if self._attribution is not None else []
        return ', '.join(str(cause) for cause in causes)

    @property
    def doubt(self) -> str:
        """Doubt about the sensor, as text; '' if the sensor seems sound."""
        return self._observer.doubt if self._observer is not None else ''

    def _forget(self) -> None:
        self._clock = BlockClock()
        self._observer: Observer | None = None
        self._waiting: list[_Block] = []
        self._measured: list[tuple[Integers, Array]] = []
        # next tick of the voltage, newest tick with displacement, and newest tick whose
        # displacement has come or is given up
        self._next, self._told, self._decided = 0, -1, -1
        self._last: Array | None = None
        # time of the tick before `_next` [s]
        self._newest = np.nan
        # motion by other axes, a horizon before the next sample
        self._felt = np.zeros(self._horizon)
        # see `Estimated.is_settled`
        self._is_settled = True

    def predicted(
        self, prediction: Samples, voltage: Samples, known: bool, felt: Array | float = 0.0
    ) -> list[Estimated]:
        """
        Take the prediction for the last samples of a block of voltage; return finished estimates.

        `known` says whether the run knew the outputs of the plays before the first block; `felt`
        is the motion by other axes in the prediction [m].
        """
        if self._model is None:
            return []
        t, y = prediction.t, prediction.values
        rows = np.stack(np.broadcast_arrays(voltage.values[-t.size :], y, felt))
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
            if model.is_static and np.isfinite(period):
                model = replace(model, sample_rate=1.0 / period)
            if not self._is_new:
                self._attribution = Attribution(model, self._horizon, self._at_rest)
                if self._adaptation is not None:
                    self._adaptation.begin(self._at_rest)
            self._is_new = False
            self._observer = Observer(
                model,
                horizon=self._horizon,
                known=known,
                gain=self._gain,
                drift=self._drift,
                accept_after=self._accept_after,
            )
        elif kind is Kind.GAP and self._last is not None:
            # the predictor bridged this gap by a straight line, too
            between = lines_between(self._last, rows[:, 0], missing)
            self._wait(Samples(np.full(missing, np.nan), between[1]), between)
        self._wait(prediction, rows)
        self._last, self._newest = rows[:, -1], float(t[-1])
        return self._estimates()

    def _wait(self, prediction: Samples, rows: Array) -> None:
        v, _, felt = rows
        self._waiting.append(_Block(self._next, prediction, v, felt))
        self._next += v.size

    def measured(self, t: Array, y: Array) -> list[Estimated]:
        """Take displacement [m] at times t [s] with a prediction; return finished estimates."""
        if self._observer is None or np.isnan(self._clock.period):
            return []
        # from the newest sample: over hours the rounding of the period would add up
        ticks = self._next - 1 + np.rint((t - self._newest) / self._clock.period).astype(np.int64)
        self._measured.append((ticks, y))
        self._told = max(self._told, int(ticks[-1]))
        return self._estimates()

    def _estimates(self) -> list[Estimated]:
        """Estimate all blocks whose displacement has come or is given up."""
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
            felt = np.append(self._felt, block.felt)
            y, self._felt = y - felt[: y.size], felt[y.size :]
            free = self._learnt_run(block, y)
            seen = self._observer.process(block.v, free, y)
            self._is_settled = bool(np.ptp(seen.band) <= SETTLED * self.span)
            if np.isnan(block.prediction.t[0]):
                # the voltage in a gap is unknown
                self._observer.lose_memory()
                continue
            samples = replace(block.prediction, values=seen.estimate + block.felt)
            done.append(Estimated(samples, seen, self._tell(samples.t, seen), self._is_settled))
        return done

    def _learnt_run(self, block: _Block, y: Array) -> Array:
        """Return the free run of the learnt model, which learns from y a horizon before [m]."""
        free = block.prediction.values - block.felt
        ticks = np.arange(block.tick, block.tick + free.size, dtype=np.float64)
        t = self._newest + (ticks - (self._next - 1)) * self._clock.period
        if self._adaptation is not None:
            free = self._adaptation.process(block.v, t, free, y, self._is_settled)
        if self._attribution is not None:
            known = y if self._is_settled else np.full(y.size, np.nan)
            self._attribution.process(block.v, t, free, known)
        return free

    def _tell(self, t: Array, seen: Observed) -> list[dict[str, float]]:
        """Pick the corrections to publish, `rate` times a second of the stream."""
        names = CORRECTIONS | (GAIN if self._gain or self._drift else {})
        # rounding may put a sample just before its stretch
        bins = np.floor(t * self._rate + 1e-6).astype(np.int64)
        first = np.flatnonzero(np.diff(bins, prepend=self._bin)).tolist()
        learnt = {} if self._adaptation is None else self._adaptation.told
        rows = [{n: float(getattr(seen, x)[k]) for n, x in names.items()} | learnt for k in first]
        self._bin, self.told = int(bins[-1]), rows[-1] if rows else self.told
        return rows
