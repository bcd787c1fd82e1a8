# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert a model block by block while the wanted motion comes in.

The offline inverse repeats a pass over the whole motion,

    w <- w + Q (y_wanted - y(u)),        u = H^-1 w,

where Q looks ahead by a few samples.  Live, each pass runs that many samples behind the pass
before it.  Each pass has its own H^-1 and its own model, and handles every sample once.

The offline iteration ends at a small error and may shorten its steps.  Here the number of passes
is fixed, each step is whole, and the ends of Q are cut to fit into the preview.  A trial motion
chooses the number and measures the error beforehand.  An amplifier lag is a part of Q, and plays
that widen with speed are left to the passes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, finite_vector, Mask
from piezo_ident.common.errors import DataError
from piezo_ident.control.hysteresis_inverse import HysteresisInverse, with_rising_hysteresis
from piezo_ident.control.inputs import checked_limits, SHORT
from piezo_ident.control.linear_inverse import (
    check_preview,
    least_preview,
    linear_inverse,
    LinearInverse,
)
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.stage_model import StageModel

#: default preview [samples]
PREVIEW = 400
#: most passes
MOST_PASSES = 4
#: a further pass must leave at most this share of the error
PASS_LEAVES = 0.7
#: duration of the transition from another voltage [samples]; taste
JOIN = 2000
#: error of the trial above which a warning calls the preview short [% of stroke]
LARGE = 0.1
#: trial motion: its samples; periods [samples] and amplitudes [of the range] of its sines
TRIAL, SINES = 6000, ((2000.0, 0.3), (400.0, 0.08))


class Driven(NamedTuple):
    """
    The voltage for a block of a wanted motion.

    Attributes
    ----------
    v : ndarray, shape (n,)
        Voltage [V].
    clipped : ndarray of bool, shape (n,)
        Samples at which a limit keeps the model from the wanted motion.
    """

    v: Array
    clipped: Mask


class LiveInverse:
    """
    The inverse of a model, block by block.

    Before the first block the stage rests under the voltage `rest`, and the wanted motion rests
    at `position`.  Each sample of wanted motion gives one sample of voltage.  The stage reaches
    the wanted displacement `preview` samples later.

    Parameters
    ----------
    model : StageModel
    limits : tuple of float, optional
        Lowest and highest voltage [V].  Default: the identified range.
    slew : float, optional
        Largest speed of the voltage [V/s].
    preview : int, optional
        Samples by which the wanted motion is known ahead.
    rest : float, optional
        Voltage before the first block [V].  Default: the lower limit.

    Attributes
    ----------
    preview, passes : int
        Samples ahead, and number of passes that share them.
    error : float
        Error through the finite preview and number of passes [%].  It is 100 rms(wanted -
        reached) / (max wanted - min wanted) of the model on a trial motion of two slow sines.
    position : float
        Displacement of the stage at rest [m].
    warnings : tuple of str

    Raises
    ------
    DataError
        When the limits are crossed, or rest lies outside of them.
    ModelError
        When the model has no inverse, or the preview is too short for its delay.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> live = pi.LiveInverse(model)
    >>> wanted = live.position + 20e-6 * (1 - np.cos(np.arange(4000) / 200))
    >>> v = np.concatenate([live.process(wanted[k : k + 100]).v for k in range(0, 4000, 100)])
    >>> y = model.simulate(v)
    >>> bool(np.abs(y[live.preview :] - wanted[: -live.preview]).max() < 2e-9)
    True
    """

    def __init__(
        self,
        model: StageModel,
        *,
        limits: tuple[float, float] | None = None,
        slew: float = np.inf,
        preview: int = PREVIEW,
        rest: float | None = None,
    ) -> None:
        low, high, self._slew = checked_limits(model, limits, slew)
        self._limits = low, high
        self._rest = low if rest is None else float(rest)
        if not low <= self._rest <= high:
            raise DataError(f'rest, {self._rest:g} V, lies outside of {low:g} .. {high:g} V')
        self.model, self.warnings = _without_channels(model)
        self.preview = int(preview)
        check_preview(model, self.preview)
        inverted, lines = with_rising_hysteresis(self.model)
        self.warnings += lines
        self._hysteresis, self._filter = inverted.hysteresis, linear_inverse(inverted)
        self.passes, self.error = self._tried()
        # a longer preview does not help plays that are inverted as lines
        enough = '' if lines else f'; {MOST_PASSES * self._filter.ahead} are enough for anything'
        self.warnings += preview_warnings(preview, self.passes, self.error, enough)
        self._passes = self._built(self.passes, self._slew)
        self.reset()

    def _built(self, passes: int, slew: float) -> list[_Pass]:
        """Build passes that share the preview."""
        s, rate = self.model.scaling, self.model.sample_rate
        bounds = float(s.u(self._limits[0])), float(s.u(self._limits[1]))
        Q = self._filter.shortened(self.preview // passes)
        waits = [self.preview - passes * Q.ahead] + [0] * (passes - 1)
        return [
            _Pass(
                self.model,
                HysteresisInverse(self._hysteresis, bounds, slew / s.V / rate),
                Q,
                wait,
                passes - 1 - k,
                k == 0,
            )
            for k, wait in enumerate(waits)
        ]

    def _tried(self) -> tuple[int, float]:
        """Choose the number of passes on a trial motion; return the number and its error."""
        stream = self.model.stream()
        low, high, rest = (stream.reset(v) for v in (*self._limits, self._rest))
        fade, motion = trial_motion()
        wanted = rest + fade * (0.5 * (low + high) - rest + (high - low) * motion)
        best, least = 1, np.inf
        for passes in range(1, MOST_PASSES + 1):
            if self.preview < passes * least_preview(self.model):
                break
            self._passes = self._built(passes, np.inf)
            self.reset()
            v = self.process(np.append(wanted, np.full(self.preview, wanted[-1]))).v
            error = percent_of_stroke(wanted, self.model.stream().process(v)[self.preview :])
            if not error < PASS_LEAVES * least:
                break
            best, least = passes, error
        return best, least

    def reset(self) -> None:
        """Come to rest, with the clock of the voltage at zero."""
        self.position = float(np.mean([p.reset(self._rest) for p in self._passes]))

    def recall(self, v: Array, t: Array) -> None:
        """
        Run through a past voltage, after which effects behind H are at rest.

        Parameters
        ----------
        v, t : ndarray, shape (n,)
            Voltage [V] and time [s]; the stage was at rest before the first sample.
        """
        for p in self._passes:
            p.recall(v, t)

    def follow(self, v: Array, tick: int = 0) -> None:
        """
        Follow a voltage that another source has applied up to now.

        The displacement of the model under this voltage replaces the past of the wanted motion;
        `position` is its last value.  The next `preview` samples give no voltage yet; the first
        sample of voltage waits for the second one, whose slope the transition takes over.

        Parameters
        ----------
        v : ndarray, shape (n,)
            [V]
        tick : int, optional
            Clock of the voltage at the first sample [samples].
        """
        for p in self._passes:
            y = p.follow(v, tick)
        self.position = float(y[-1])

    def process(self, wanted: ArrayLike) -> Driven:
        """
        Compute the voltage for the next samples of a wanted motion.

        Parameters
        ----------
        wanted : array_like, shape (n,)
            Displacement [m].

        Returns
        -------
        Driven
            As many samples; after `follow`, `preview` samples fewer in all.

        Raises
        ------
        DataError
            When the wanted motion is not a vector of finite numbers.
        """
        y = finite_vector(wanted, 'live inverse', 'wanted motion', 'finite numbers, in metres')
        s = self.model.scaling
        x = d = s.x(y)
        w = np.full(x.size, self._passes[0].origin)
        for p in self._passes:
            x, d, w, u, short = p.process(x, d, w)
        return Driven(np.clip(s.v0 + s.V * u, *self._limits), short)


def trial_motion(stretch: float = 1.0) -> tuple[Array, Array]:
    """Make a rise from 0 to 1, and the sines of the trial, whose periods are stretched."""
    k = np.arange(TRIAL)
    motion = np.sum([a * np.sin(2 * np.pi * k / (stretch * t)) for t, a in SINES], axis=0)
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(k / SINES[0][0], 1.0)), motion


def preview_warnings(preview: int, passes: int, error: float, enough: str = '') -> tuple[str, ...]:
    """Warn of a preview that leaves a large error on the trial motion."""
    text = (
        f'a preview of {preview} samples in {passes} passes leaves {error:.2g} % of stroke on a '
        f'slow motion, were the model exact{enough}'
    )
    return (text,) if error > LARGE else ()


class _Pass:
    """
    One pass of the iteration with its own filter, H^-1 and model, behind the pass before it.

    The pass waits for `wait` samples more than it needs; `left` passes come after it.
    """

    def __init__(
        self,
        model: StageModel,
        H: HysteresisInverse,
        Q: LinearInverse,
        wait: int,
        left: int,
        is_first: bool,
    ) -> None:
        self._model, self._H, self._stream = model, H, model.stream()
        self._taps = Q.taps[::-1].copy()
        self._ahead, self._behind = Q.ahead + wait, Q.behind
        self._later, self._is_first, self._is_last = left * Q.ahead, is_first, left == 0
        # H at the end of another voltage, and the transition from there
        self._w0: float | None = None
        self._step, self._since = 0.0, JOIN

    def reset(self, v0: float) -> float:
        """Come to rest and return the displacement there [m]."""
        s, u0 = self._model.scaling, float(self._model.scaling.u(v0))
        w0, y0 = self._H.reset(u0), self._stream.reset(v0)
        x0 = float(s.x(y0))
        # a nonlinear sensor makes the rest of the chain more than a gain
        self.origin = w0 - x0 * float(self._taps.sum())
        self._tick, self._w0, self._since = self._later, None, JOIN
        n, is_first = self._ahead, self._is_first
        self._x, self._w = np.full(n, x0), np.full(n, self.origin if is_first else w0)
        self._d = np.full(self._behind + n, x0 if is_first else 0.0)
        return y0

    def recall(self, v: Array, t: Array) -> None:
        """Run H and the model through a past voltage, as `Stream.recall` does."""
        u = self._model.scaling.u(v)
        self._H.reset(float(u[0]))
        self._H.follow(u)
        self._stream.recall(v, t)

    def follow(self, v: Array, tick: int) -> Array:
        """Follow a voltage, and return the displacement of the model [m]."""
        s = self._model.scaling
        self._H.follow(s.u(v))
        y = self._run(v, tick)
        # the wanted motion that was known ahead no longer holds
        self._x = self._w = np.empty(0)
        self._w0 = self._H.value
        past = self._d[: self._behind]
        self._d = np.append(past, s.x(y) if self._is_first else np.zeros(v.size))[v.size :]
        return y

    def process(self, x: Array, d: Array, w: Array) -> tuple[Array, Array, Array, Array, Mask]:
        """
        Process the samples that are known far enough ahead, and return the input of the next pass.

        x, d and w, shape (n,), are wanted motion, error and H before this pass, normalised.  The
        result is x, d and w after this pass, the normalised voltage u, and a mask of the samples
        at which H missed its goal; all of shape (m,).
        """
        x, d, w = (np.append(*z) for z in ((self._x, x), (self._d, d), (self._w, w)))
        n = max(x.size - self._ahead, 0)
        if n == 1 and self._w0 is not None:
            n = 0  # the transition takes over the slope between two samples
        self._x, self._d, self._w = x[n:], d[n:], w[n:]
        if n == 0:
            nothing = np.empty(0)
            return nothing, nothing, nothing, nothing, nothing > 0.0
        x, d = x[:n], d[: n + self._taps.size - 1]
        goal = self._joined(w[:n] + np.correlate(d, self._taps, 'valid'))
        u, reached = self._H.process(goal)
        if not self._is_last:
            s = self._model.scaling
            d = x - s.x(self._run(s.v0 + s.V * u, self._tick))
        return x, d, reached, u, np.abs(goal - reached) > SHORT

    def _joined(self, goal: Array) -> Array:
        """Fade the step from another voltage out of the goal of H."""
        if self._w0 is not None:
            self._step, self._w0, self._since = self._w0 + (goal[1] - goal[0]) - goal[0], None, 0
        if self._since < JOIN:
            k = np.minimum(np.arange(self._since, self._since + goal.size) / JOIN, 1.0)
            goal = goal + self._step * (0.5 + 0.5 * np.cos(np.pi * k))
            self._since += goal.size
        return goal

    def _run(self, v: Array, tick: int) -> Array:
        self._tick = tick + v.size
        return self._stream.process(v, np.arange(tick, self._tick) / self._model.sample_rate)


def _without_channels(model: StageModel) -> tuple[StageModel, tuple[str, ...]]:
    """Remove effects of further channels, which have no preview; warnings name them."""
    left = [setting for setting in model.effects if setting.channel]
    if not left:
        return model, ()
    names = ', '.join(setting.name for setting in left)
    kept = tuple(setting for setting in model.effects if setting not in left)
    return replace(model, effects=kept), (
        f'{names} is not made up for: its channel is unknown ahead',
    )
