# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Correct the free run of a model by the measured displacement.

The free run of a model begins at rest.  A real stage may still creep from earlier motion.  Its
sensor may have another zero, and the outputs of its plays may be unknown.  In normalised units
the displacement is the free run plus

    o  +  g sum_i c_i d_i  +  m,        d_i(k+1) = exp(-1 / (f_s tau_i)) d_i(k).

- o is an offset, a random walk.
- d_i is the distance of creep element i from its value in the free run, c_i its share, g = G(1).
- m is the error of the model, correlated along the path of the voltage.  At rest m stays the same,
  so averaging over time does not reduce it.

A Kalman filter follows o, d and m by the means of groups of samples.  `estimate` is the free run
plus offset, creep and followed gain, without m: the error of the model must stay visible.  The
claimed variance contains the mean square of m over the last few strokes of the voltage.

The gain is followed on request.  A changed gain adds gamma x, with the free run x about the zero
of the model and a random walk gamma.  Only motion distinguishes a gain from an offset.  The
variance that time adds to gamma therefore counts along the path only; at rest gamma stays the
same.  The filter refuses a step of the gain at first, as it refuses every step.  The step is
accepted once the voltage has moved and the refused measurements are proportional to x.

The drift of the gain is followed on request, too.  The gain gamma then also grows by delta a
second, where delta is a random walk that returns to zero.  The estimate follows a ramp of the gain
without a lag.  While the sensor is silent, the drift goes on until it fades, and the error grows.

Two hypotheses run side by side, weighted by their likelihood: the zero is unchanged, or it is
anywhere.  Slow creep and a shifted zero look alike at first: a wide prior of the zero alone would
take all creep for a shift.

The unknown output of a play lies between bounds, which the voltage draws together; see
`MemoryBounds`.  Such plays count as offset.  The offset may change by as much as their band
shrinks, once G has passed the change on.  At the start G still answers earlier motion, so the
offset is free until G has settled.

Kalman filter: R. E. Kalman, "A new approach to linear filtering and prediction problems", J. Basic
Engineering 82(1), 1960, doi:10.1115/1.3662552.  Weights of hypotheses: D. T. Magill, "Optimal
adaptive estimation of sampled stochastic processes", IEEE Trans. Automatic Control 10(4), 1965,
doi:10.1109/TAC.1965.1098191.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.model import observer_kernel as kernel
from piezo_ident.model.initial_memory import creep_elements
from piezo_ident.model.memory_bounds import MemoryBounds
from piezo_ident.model.metrics import expected_error
from piezo_ident.model.scaling import REST
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.chain import Block, Chain
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator

#: age of the displacement that corrects an estimate [samples]: a block
HORIZON = 100
#: time over which displacement is averaged to one measurement [s]
GROUP = 1e-3
#: rms error of a model whose error is unknown, in spans: the error of the paper's model.
#: Smallest rms error: a tenth of a bit of its converters.
UNKNOWN, LEAST = 1e-2, 1e-6
#: path of the voltage over which the error of a model changes, as a share of its range (taste).
#: The misfit of H has a few waves over a stroke.
PATH = 0.25
#: rms change of the offset in a second, in spans.  A fast thermal drift of a span of 100 um is
#: 100 nm in a minute.
WALK = 1e-3 / np.sqrt(60.0)
#: rms size of the offset, in spans, for an unchanged zero and for a zero anywhere (taste)
ZEROS = (1e-3, 1.0)
#: rms change of the gain in a second.  d33 of PZT changes by some 0.1 % per kelvin, and a working
#: stage warms by a kelvin in a minute.
GAIN_WALK = 1e-3 / np.sqrt(60.0)
#: rms change of the gain since identification (taste: some ten kelvin and lost poling)
GAIN_SIZE = 0.1
#: time constant with which old gains fade from the drift of the gain, and a drift ends [s] (taste)
DRIFT_TIME = 10.0
#: rms drift of the gain [1/s], if it is followed: it then makes the rms change of the gain
DRIFT_SIZE = GAIN_SIZE / DRIFT_TIME
#: refused measurements that make a step at least, and their largest spread over their mean (taste)
STEADY, SPREAD = 10, 0.25
#: least and largest slope of refused measurements over the free run for a changed sign (taste).  A
#: reading of the other sign has the slope -2.
MIRRORED = (-2.5, -1.5)
#: rms size of d, as a share of the range of H: uniform, as earlier motion was anywhere in it
BEYOND = 1.0 / np.sqrt(12.0)
#: deviation beyond which a measurement is refused at first, in standard deviations (taste)
GATE = 5.0
#: time of refused measurements after which they are believed [s] (taste)
ACCEPT_AFTER = 5.0


@dataclass(frozen=True, eq=False)
class Observed:
    """
    State of an observer along samples, shapes (n,), in metres.

    Attributes
    ----------
    estimate, std : ndarray
        Displacement, and the standard deviation of its error.
    offset, offset_std : ndarray
        Constant part of the correction, and its standard deviation.  Plays whose output is unknown
        count as offset.
    creep, creep_std : ndarray
        Creep from earlier motion, and its standard deviation.
    gain, gain_std : ndarray
        Relative change of the gain, and its standard deviation; zero if it is not followed.
    drift, drift_std : ndarray
        Change of the gain in a second, and its standard deviation; taken over the last
        `DRIFT_TIME` if the drift is not followed.
    band : ndarray
        Largest further change of the offset by plays of unknown output.
    fading : ndarray, shape (c,)
        Creep of each element at the last sample.
    """

    estimate: Array
    std: Array
    offset: Array
    offset_std: Array
    creep: Array
    creep_std: Array
    gain: Array
    gain_std: Array
    drift: Array
    drift_std: Array
    band: Array
    fading: Array


class Observer:
    """
    Estimates offset, creep and gain from displacement that is a horizon old.

    The result does not depend on the size of the blocks.

    Parameters
    ----------
    model : StageModel
    horizon : int, optional
        Samples by which displacement is older than the estimate that uses it.
    error, noise : float, optional
        Rms error of the model, and of the sensor [m].  Default: the error stored with the model,
        which contains the noise.
    zeros : tuple of float, optional
        Size of the offset [m, rms] by each hypothesis.
    gate : float, optional
        Deviation beyond which a measurement is refused at first [standard deviations].
    known : bool, optional
        Whether the free run begins with known outputs of the plays.  A start at the lowest voltage
        always does.
    gain, drift : bool, optional
        Whether the gain is followed, too, and whether as a drifting gain.
    accept_after : float, optional
        Time after which refused measurements are believed [s].
    """

    def __init__(
        self,
        model: StageModel,
        *,
        horizon: int = HORIZON,
        error: float | None = None,
        noise: float | None = None,
        zeros: tuple[float, ...] | None = None,
        gate: float = GATE,
        known: bool = False,
        gain: bool = False,
        drift: bool = False,
        accept_after: float = ACCEPT_AFTER,
    ) -> None:
        if horizon < 1:
            raise DataError(f'observer: the horizon is at least one sample, got {horizon}')
        self.model, self.horizon = model, horizon
        span, percent = abs(model.scaling.Y), expected_error(model)
        held = UNKNOWN if percent is None else percent / 100.0
        size = max(held if error is None else error / span, LEAST)
        noisy = size if noise is None else max(noise / span, LEAST)
        self._zeros = np.array(ZEROS) if zeros is None else np.array(zeros) / span
        self._group = max(1, round(GROUP * model.sample_rate))
        self._gain, self._drift = gain or drift, drift
        self._law, self._row = self._laws(size, noisy, gate, accept_after)
        low, high = model.scaling.u(model.scaling.range).tolist()
        self._low, self._width = low, high - low
        self._input = model.input_chain()
        operators = DynamicsOperator(model.dynamics), DelayOperator(model.total_delay)
        self._output = Chain(operators)
        self._bounds = MemoryBounds(model.hysteresis, low, (low, high))
        self._is_known, self._started, self._is_lost = known, False, False

    def _laws(
        self, error: float, noise: float, gate: float, accept_after: float
    ) -> tuple[kernel.Law, Array]:
        model, rate, size = self.model, self.model.sample_rate, self._group
        gains, times = creep_elements(model)
        left = np.exp(-1.0 / (rate * times))
        before = left[:, None] ** -np.arange(size)
        gains = model.dynamics.gain * gains
        groups = max(1.0, accept_after * rate / size)
        growth = 1.0 / groups if gate < np.inf else 0.0
        h = model.hysteresis
        reach = BEYOND * float(np.ptp(h(np.linspace(*h.span, 65))))
        walk = WALK**2 * size / rate
        # in the order of the places in the kernel
        numbers = [noise**2, error**2, PATH, walk, gate**2, growth, groups, reach**2]
        numbers += [GAIN_WALK**2 * size / rate, GAIN_SIZE**2]
        numbers += [size / rate, max(2.0, DRIFT_TIME * rate / size)]
        numbers.append(self._drift * DRIFT_SIZE**2)
        # drift and gain; the entry of the gain is set for each group
        own = np.array([np.exp(-size / rate / DRIFT_TIME)] * self._drift + [1.0] * self._gain)
        row = np.concatenate([[1.0], gains * before.mean(axis=1), 0.0 * own, [1.0]])
        law = kernel.Law(
            lead=gains * left**self.horizon,
            left=left,
            kept=np.concatenate([[1.0], left**size, own]),
            numbers=np.array(numbers),
        )
        return law, row

    def _start(self, u0: float) -> None:
        law = self._law
        n, count, c = self._row.size, self._zeros.size, law.left.size
        reach2 = law.numbers[kernel.REACH]
        P = np.zeros((count, n, n))
        for b, zero in enumerate(self._zeros):
            P[b] = np.diag(
                [zero**2, *[reach2] * c, *[0.0] * (n - 2 - c), law.numbers[kernel.ERROR]]
            )
            if self._drift:
                P[b, -3, -3] = law.numbers[kernel.DRIFT_VAR]
        now = np.zeros(kernel.PLACES)
        now[kernel.SCALE], now[kernel.READING] = 1.0, np.nan
        now[kernel.MISFIT] = law.numbers[kernel.ERROR]
        now[kernel.IDLE] = self._gain * law.numbers[kernel.GAIN_SIZE]
        x, weight, group = np.zeros((count, n)), np.zeros(count), np.full((2, self._group), np.nan)
        self._state = kernel.FilterState(x, P, weight, self._row.copy(), group, np.zeros(c), now)
        kernel.tell(law, self._state)
        self._input.reset(u0, u0)
        self._output.reset(u0, 0.0)
        if self._is_known or u0 - self._low < REST * self._width:
            self._bounds.came_down(u0)
        else:
            self._bounds.forget(u0)
        self._count, self._last, self._started = 0, u0, True
        self._past: Array | None = None

    @property
    def known(self) -> bool:
        """Whether the voltage so far determines the outputs of all plays."""
        return self._started and not self._is_lost and bool(self._bounds.known.all())

    def lose_memory(self) -> None:
        """Note a gap in the voltage before the next sample: the plays are unknown again."""
        self._is_lost = True

    @property
    def doubt(self) -> str:
        """Motion of the reading that a stage hardly makes, as text; '' for a sound reading."""
        if not self._started:
            return ''
        now = self._state.now
        n, e, ee, x, xx, xe = now[kernel.SEEN : kernel.SUM_XE + 1].tolist()
        if now[kernel.STUCK_NOW]:
            return 'it stays the same while the stage should move'
        if n < STEADY:
            return ''
        swing2 = xx - x**2 / n
        # the variance of a uniform motion that is long enough for a reading to count as stuck
        if 12.0 * swing2 > n * kernel.STUCK**2:
            slope = (xe - x * e / n) / swing2
            if MIRRORED[0] < slope < MIRRORED[1]:
                return 'it moves against the stage'
        if max(ee / n - (e / n) ** 2, 0.0) <= (SPREAD * e / n) ** 2:
            return 'it has stepped'
        return ''

    def accept(self) -> float:
        """
        Accept the refused measurements as a step of the zero of the sensor; return its size [m].

        Raises
        ------
        DataError
            When too few measurements are refused, or they differ too much for a step.
        """
        now = self._state.now if self._started else np.zeros(kernel.PLACES)
        n, total, squares = now[kernel.SEEN], now[kernel.SUM_E], now[kernel.SUM_EE]
        if n < STEADY:
            raise DataError(
                f'no step to accept: {n:.0f} measurements in turn are off the estimate, and '
                f'{STEADY} are needed'
            )
        step, um = total / n, 1e6 * self.model.scaling.Y
        spread = float(np.sqrt(max(squares / n - step**2, 0.0)))
        if spread > SPREAD * abs(step):
            raise DataError(
                f'what the sensor says changes as the stage moves, {um * step:+.3g} um with a '
                f'standard deviation of {abs(um) * spread:.2g} um: it is no step of the zero'
            )
        self._state.P[:, 0, 0] += kernel.JUMP * step**2
        kernel.forget_refused(now)
        return float(self.model.scaling.Y * step)

    def process(self, v: Array, free: Array, measured: Array) -> Observed:
        """
        Estimate the displacement of the next samples; all shapes (n,).

        Parameters
        ----------
        v : ndarray
            Voltage [V].
        free : ndarray
            Free run of the model under this voltage [m].
        measured : ndarray
            Displacement `horizon` samples before each sample [m]; NaN if it is missing.
        """
        scaling, g = self.model.scaling, abs(self.model.dynamics.gain)
        u = scaling.u(v)
        if not self._started:
            self._start(float(u[0]))
        time = (self._count + np.arange(u.size)) / self.model.sample_rate
        self._count += u.size
        u = self._input.process(Block(t=time, v=u, x=u)).x
        if self._is_lost:
            self._bounds.forget(float(u[0]))
            self._is_lost = False
        band = self._bounds.follow(u)
        # G passes the band on from zero at the start, as if that were the motion from before
        reached = np.abs(self._output.process(Block(t=time, v=u, x=band)).x)
        band *= g
        path = np.abs(np.diff(u, prepend=self._last)) / self._width
        self._last = float(u[-1])
        new = np.stack([scaling.x(free), path, reached])
        if self._past is None:
            # no displacement before the start
            self._past = np.full((3, self.horizon), np.nan)
            self._state.now[kernel.BAND] = reached[0]
        whole = np.concatenate([self._past, new], axis=1)
        before, self._past = whole[:, : u.size].copy(), whole[:, u.size :]
        out = np.empty((10, u.size))
        kernel.follow(scaling.x(measured), before, new[0], self._law, self._state, out)
        Y = scaling.Y
        return Observed(
            estimate=free + Y * out[0],
            std=abs(Y) * out[1],
            offset=Y * out[2],
            offset_std=abs(Y) * out[3],
            creep=Y * out[4],
            creep_std=abs(Y) * out[5],
            gain=out[6],
            gain_std=out[7],
            drift=out[8],
            drift_std=out[9],
            band=abs(Y) * band,
            fading=Y * self._state.coming,
        )
