# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Predict the displacement of a running stage, through gaps, restarts and new models.

`Predictor` handles gaps, restarts and faults of the voltage, and keeps its history.  A new model
takes over in the state of a run from the start, see `piezo_ident.live.history`.  `AxesRun` runs
the chains of a model, `ModesRun` its shared modes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array, line_between, lines_between
from piezo_ident.common.errors import ModelError
from piezo_ident.live.history import History, TurningPoints
from piezo_ident.live.sample_clock import BlockClock, Kind
from piezo_ident.model.axis_records import motion_of
from piezo_ident.model.estimate import observe
from piezo_ident.model.modes.stream import ModesRun
from piezo_ident.model.multi_axis import (
    alone,
    judged_models,
    models_of,
    MultiAxisModel,
    require_voltages_only,
)
from piezo_ident.model.scaling import REST, Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.blocks import Samples, time_problem
from piezo_ident.record.record import Piece
from piezo_ident.uncertainty.band import band_of, BandStream, KEY

#: longest gap that a straight line bridges [s]; a longer gap starts a new run, because a stage
#: ramps to rest after this default `silence`
BRIDGE = 0.5
#: default share of the errors that a band holds (taste)
LEVEL = 0.9


class AxesRun:
    """
    Run of a model, with a row of voltages and of displacements for each axis.

    A coupled axis runs twice: alone, for the motion by its own voltage, and with the motions of
    the other axes.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    axes : sequence of str
        Order of the rows, by the names of the displacements; all axes of the model.

    Attributes
    ----------
    felt : ndarray, shape (k, n)
        Motion by other axes in the last displacements [m].

    Examples
    --------
    >>> import piezo_ident as pi
    >>> one = pi.SimulatedStage.load('paper').model
    >>> run = AxesRun(pi.MultiAxisModel({'y': one, 'y_b': one}), ('y', 'y_b'))
    >>> y = run.process(np.ones((2, 300)), np.arange(300) / 20e3)
    >>> y.shape, bool((y[0] == y[1]).all())
    ((2, 300), True)
    """

    def __init__(self, model: StageModel | MultiAxisModel, axes: Sequence[str]) -> None:
        whole = {axis: models_of(model)[axis] for axis in axes}
        single = alone(model)
        self._alone = {axis: single[axis].stream() for axis in axes}
        self._coupled = {
            axis: x.stream() for axis, x in whole.items() if x.effects != single[axis].effects
        }
        self.felt = np.zeros((len(axes), 0))

    def recall(self, pasts: Sequence[History], period: float) -> None:
        """Take the state after the past voltages; `pasts` has a history for each row."""
        t, rows = np.empty(0), []
        for axis, past in zip(self._alone, pasts, strict=True):
            for run in filter(None, (self._coupled.get(axis), self._alone[axis])):
                t, v = past.recall(run, run.model, period)
            rows.append(v)
        self.process(np.stack(rows), t)

    def process(self, v: Array, t: Array) -> Array:
        """Compute the displacements [m] of the next voltages [V], shapes (k, n); t is in s."""
        own = [run.process(row, t) for run, row in zip(self._alone.values(), v, strict=True)]
        y = own[0][np.newaxis] if len(own) == 1 else np.stack(own)
        self.felt = np.zeros(y.shape)
        if not self._coupled:
            return y
        moved = {motion_of(axis): row for axis, row in zip(self._alone, own, strict=True)}
        for k, axis in enumerate(self._alone):
            if axis in self._coupled:
                y[k] = self._coupled[axis].process(v[k], t, moved)
                self.felt[k] = y[k] - own[k]
        return y


def run_of(model: StageModel | MultiAxisModel, axes: Sequence[str]) -> AxesRun | ModesRun:
    """Begin a run of a model, with the axes in this order."""
    if isinstance(model, MultiAxisModel) and model.modes is not None:
        return ModesRun(model.modes, axes, doubts=bool(_with_band(model, axes)))
    return AxesRun(model, axes)


def check_axes(model: StageModel | MultiAxisModel, axes: Sequence[str]) -> None:
    """Raise ModelError for a model of other axes than those of a node."""
    held = models_of(model)
    if set(held) != set(axes):
        raise ModelError(
            f'the model holds for {", ".join(held)}, and this node for {", ".join(axes)}: start '
            "the node with the parameter 'axes' of the stage"
        )


class Predictor:
    """
    Predicts the displacement as blocks of voltage come.

    Parameters
    ----------
    axes : sequence of str, optional
        Names of the displacements; blocks of several axes have a row for each.
    level : float, optional
        Share of the errors that the band holds.

    Attributes
    ----------
    problem : str
        The last problem of the stream; empty without one.
    clock : BlockClock
        Counts lost and late samples, and restarts.
    half_width : Samples or None
        Half width of the band of the last block [m]; None for a model without a band.
    felt : ndarray, shape (k, n)
        Motion by other axes in the last prediction [m].
    """

    def __init__(self, axes: Sequence[str] = ('y',), level: float = LEVEL) -> None:
        self._axes = tuple(axes)
        self.model: StageModel | MultiAxisModel | None = None
        self.problem = ''
        self.half_width: Samples | None = None
        self.felt = np.zeros((len(self._axes), 0))
        self._level = level
        self.clock = BlockClock()
        self._clear()

    def _clear(self) -> None:
        self._pasts = [History() for _ in self._axes]
        self._run: AxesRun | ModesRun | None = None
        self._bands = list[BandStream]()
        self._lowest = [float('inf')] * len(self._axes)

    @property
    def memory_known(self) -> bool:
        """
        Whether the voltage so far determines the memory of the plays.

        The lower end of the range or a sweep of shared modes determines the memory, until a gap.
        """
        return self._was_at_rest or (isinstance(self._run, ModesRun) and self._run.stream.is_swept)

    @property
    def _was_at_rest(self) -> bool:
        """Whether the run has been at the lower end of the voltage range."""
        if self.model is None or (isinstance(run := self._run, ModesRun) and run.is_partial):
            return False
        each = models_of(self.model)
        return all(
            each[a].scaling.u(v) < REST for a, v in zip(self._axes, self._lowest, strict=True)
        )

    def set_model(self, model: StageModel | MultiAxisModel) -> None:
        """
        Take a model, in the state that it would have if it had run from the start.

        ModelError for other axes or another sampling rate than those of the stream, and for an
        effect that needs a further channel.
        """
        check_axes(model, self._axes)
        require_voltages_only(model)
        if np.isfinite(self.clock.period):
            self._check_rate(model)
        for one in _with_band(model, self._axes):
            band_of(one)  # a damaged band is refused now, not in the stream
        run = None
        if self._pasts[0]:
            run = run_of(model, self._axes)
            run.recall(self._pasts, self.clock.period)
        self.model, self._run, self._bands = model, run, []
        if self._pasts[0] and self.problem.startswith('the stream'):
            self.problem = ''

    def _check_rate(self, model: StageModel | MultiAxisModel) -> None:
        is_static = all(x.is_static for x in models_of(model).values())
        if is_static or abs(self.clock.period * model.sample_rate - 1.0) < 1e-6:
            return
        raise ModelError(
            f'the stream is sampled at {1.0 / self.clock.period:.6g} Hz, the model holds for '
            f'{model.sample_rate:g} Hz; identify a model at the rate of the stream'
        )

    def caught_up(self, model: StageModel, axis: int = 0) -> Stream:
        """Run a model under the voltage of an axis so far; without voltage it is at rest."""
        stream, past = model.stream(), self._pasts[axis]
        if not past:
            return stream
        t, v = past.recall(stream, model, self.clock.period)
        stream.process(v, t)
        return stream

    def process(self, samples: Samples) -> Samples | None:
        """
        Predict the displacement [m] for a block of voltage [V], shape (n,), or (k, n) for k axes.

        The result is None for a block that is left out.  It is also None without a model, and with
        a model of another rate.

        A straight line bridges a gap of up to half a second.  A longer gap and a restart begin a
        new run, with the stage at rest.  Repeated and late blocks, and blocks with NaN or infinite
        numbers, are left out.
        """
        # copies, since the message may change
        t, v = np.array(samples.t, np.float64), np.array(samples.values, np.float64, ndmin=2)
        if not self._usable(t, v):
            return None
        clock = self.clock
        before, last = clock.period, clock.last
        kind, count = clock.judge(t)
        if kind is Kind.LATE:
            self.problem = f'samples at t = {t[0]:.6g} s came again or out of turn'
            t, v = t[count:], np.ascontiguousarray(v[:, count:])
            if not t.size:
                return None
        elif kind is Kind.START:
            # a program that starts again starts at zero
            if clock.restarts and t[0] > 0.5 * clock.period:
                way = 'back' if t[0] < last else 'ahead'
                self.problem = f'time jumps {way} from {last:.6g} to {t[0]:.6g} s'
            self._clear()
        elif abs(clock.period / before - 1.0) > 1e-3:
            self.problem = f'the sampling rate changed at t = {t[0]:.6g} s'
            self._clear()
        elif kind is Kind.GAP:
            self._bridge(last, float(t[0]), v[:, :1], count)
        y = self._advance(t, v)
        if y is None:
            return None
        half = self._half_width(v, y)
        if samples.values.ndim < 2:
            y, half = y[0], None if half is None else half[0]
        self.half_width = (
            None if half is None else Samples(t, half, samples.segment, 'displacement')
        )
        return Samples(t, y, samples.segment, 'displacement')

    def _half_width(self, v: Array, y: Array) -> Array | None:
        models = [] if self.model is None else _with_band(self.model, self._axes)
        if len(models) < len(self._axes):
            return None
        if not self._bands:
            known = self.memory_known or isinstance(self._run, ModesRun)
            self._bands = [BandStream(x, self._level, plays=known, creep=False) for x in models]
        half = np.stack([band.follow(*of) for band, *of in zip(self._bands, v, y, strict=True)])
        if isinstance(self._run, ModesRun) and not self._was_at_rest:
            half += self._level * self._run.spread
        return half

    def _usable(self, t: Array, v: Array) -> bool:
        if problem := time_problem(t):
            self.problem = f'a block of voltage is left out: {problem}'
        elif not np.isfinite(v).all():
            # its samples count as missing once the next block shows the gap
            self.problem = (
                f'the block of voltage at t = {t[0]:.6g} s holds NaN or infinite numbers; '
                'it is left out'
            )
        elif t.size == 1 and np.isnan(self.clock.period):
            self.problem = (
                f'the block at t = {t[0]:.6g} s is one sample, which tells no sampling rate; it '
                'is left out'
            )
        else:
            return True
        return False

    def _bridge(self, t0: float, t1: float, v1: Array, missing: int) -> None:
        self.problem = f'{missing} samples of voltage are missing before t = {t1:.6g} s'
        if missing * self.clock.period > BRIDGE:
            self._clear()
            return
        between = lines_between((past.last for past in self._pasts), v1[:, 0], missing)
        self._advance(line_between(t0, t1, missing), between)
        self._lowest = [float('inf')] * len(self._axes)
        if isinstance(self._run, ModesRun):
            self._run.forget()

    def _advance(self, t: Array, v: Array) -> Array | None:
        for k, past in enumerate(self._pasts):
            self._lowest[k] = min(self._lowest[k], float(v[k].min()))
            past.add(t, v[k])
        model = self.model
        if model is None:
            return None
        if self._run is None:
            try:
                self._check_rate(model)
            except ModelError as error:
                self.problem = str(error)
                return None
            self._run = run_of(model, self._axes)
        try:
            y = self._run.process(v, t)
            if not np.isfinite(y).all():
                raise ModelError(f'the prediction at t = {t[0]:.6g} s is not finite')
        except ModelError as error:
            self.problem = f'{error}; the prediction begins anew'
            self._clear()
            return None
        self.felt = self._run.felt
        return y


def _with_band(model: StageModel | MultiAxisModel, axes: Sequence[str]) -> list[StageModel]:
    """List the models of the axes that carry a band, in the order of the axes."""
    each = judged_models(model)
    return [each[axis] for axis in axes if KEY in each[axis].identification]


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
    observe(model, Piece(t, t, model.sample_rate))
