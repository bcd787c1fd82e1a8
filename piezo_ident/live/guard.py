# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Keep the voltage of an amplifier within its limits and its slew.

A command may leave the limits, jump, hold NaN, stop, or start over.  The guard answers:

- it passes a correct command bit for bit;
- it applies the limit for a command outside the limits, and follows a jump at the slew;
- it repeats the last command for a sample that is NaN or infinite;
- it ramps softly to rest while no command comes and the caller asks `Guard.idle`;
- it joins a new stream softly: the distance between the applied and the commanded voltage fades
  out along a raised cosine.

Stage, excitation and feedforward use the guard; a driver of real hardware should, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.kernel import kernel

#: longest ramp to rest at the end of a node [s]
LAST_RAMP = 0.7
#: reasons for altering a sample, in the order of the counts of the kernel
REASONS = ('not_finite', 'outside_limits', 'too_fast', 'joining')

# indices of the state of a guard, which its kernel changes
_APPLIED, _COMMAND, _OFFSET, _DONE, _LENGTH, _PENDING = range(6)


@dataclass(frozen=True)
class GuardSettings:
    """
    Limits of a guard.

    Parameters
    ----------
    low, high : float
        Limits [V].
    slew : float
        Steepest change of the applied voltage [V/s].
    ramp_slew : float
        Top speed of the ramps to rest and into a new stream [V/s].
    rest : float
        Voltage without a command [V].
    sample_rate : float
        [Hz]

    Raises
    ------
    ConfigError
        When the limits are crossed, rest lies outside of them, or a speed or rate is not positive.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> settings = pi.GuardSettings(0, 10, slew=1000, ramp_slew=20, rest=0, sample_rate=1000)
    >>> pi.Guard(settings).process([0.0, 12.0]).voltage.tolist()
    [0.0, 1.0]
    """

    low: float
    high: float
    slew: float
    ramp_slew: float
    rest: float
    sample_rate: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ConfigError(
                f'voltage limits {self.low:g} .. {self.high:g} V are crossed or empty; '
                'the lower one must lie below the upper one'
            )
        if not self.low <= self.rest <= self.high:
            raise ConfigError(
                f'rest = {self.rest:g} V lies outside the voltage limits '
                f'{self.low:g} .. {self.high:g} V; move it, or them'
            )
        if not (self.slew > 0 and self.ramp_slew > 0 and self.sample_rate > 0):
            raise ConfigError(
                f'slew = {self.slew:g} V/s, ramp_slew = {self.ramp_slew:g} V/s and sample_rate = '
                f'{self.sample_rate:g} Hz must be positive'
            )

    @property
    def step(self) -> float:
        """Largest change from one sample to the next [V]."""
        return self.slew / self.sample_rate

    @property
    def ramp_step(self) -> float:
        """Largest change from one sample of a ramp to the next [V]."""
        return min(self.slew, self.ramp_slew) / self.sample_rate


@dataclass(frozen=True, eq=False)
class Applied:
    """
    Applied voltage for a block of command.

    Attributes
    ----------
    voltage : ndarray, shape (n,)
        Applied voltage [V]; equals the command if the command is correct.
    altered : mapping of str to int
        Number of altered samples by reason: ``not_finite``, ``outside_limits``, ``too_fast``,
        ``joining``; empty without altered samples.
    """

    voltage: NDArray[np.float64]
    altered: Mapping[str, int]


@kernel
def _follow(
    v: NDArray[np.float64],
    low: float,
    high: float,
    step: float,
    ramp_step: float,
    state: NDArray[np.float64],
    out: NDArray[np.float64],
    counts: NDArray[np.int64],
) -> None:
    for k in range(v.size):
        x = v[k]
        if not np.isfinite(x):
            counts[0] += 1
            # the limits may have changed since the last command
            x = min(max(state[_COMMAND], low), high)
        else:
            if x < low or x > high:
                counts[1] += 1
                x = min(max(x, low), high)
            state[_COMMAND] = x
            if state[_PENDING] > 0.0:
                state[_PENDING] = 0.0
                offset = state[_APPLIED] - x
                # a distance that the ramp covers in one sample needs no ramp
                if abs(offset) > ramp_step:
                    state[_OFFSET] = offset
                    state[_DONE] = 0.0
                    state[_LENGTH] = math.ceil(2.0 * abs(offset) / ramp_step)
        if state[_DONE] < state[_LENGTH] and state[_PENDING] == 0.0:
            tau = state[_DONE] / state[_LENGTH]
            left = 1.0 - (tau - math.sin(2.0 * math.pi * tau) / (2.0 * math.pi))
            x = min(max(x + state[_OFFSET] * left, low), high)
            state[_DONE] += 1.0
            counts[3] += 1
        change = x - state[_APPLIED]
        if abs(change) > step * (1.0 + 1e-9):
            counts[2] += 1
            x = state[_APPLIED] + math.copysign(step, change)
        state[_APPLIED] = x
        out[k] = x


class Guard:
    """
    Turns a command into a safe voltage, which does not depend on the size of the blocks.

    Parameters
    ----------
    settings : GuardSettings
        They may be replaced at any time.  An applied voltage outside new limits moves back inside
        at the slew, also in a gap and before a ramp to rest.
    applied : float, optional
        The voltage applied so far [V]; rest when absent.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> settings = pi.GuardSettings(0, 10, slew=1000, ramp_slew=20, rest=0, sample_rate=1000)
    >>> guard = pi.Guard(settings)
    >>> guard.process([0.0, 0.5, 5.0, float('nan'), 1.5]).voltage.tolist()
    [0.0, 0.5, 1.5, 2.5, 1.5]
    >>> float(guard.idle(1000)[-1])
    0.0
    """

    def __init__(self, settings: GuardSettings, applied: float | None = None) -> None:
        start = settings.rest if applied is None else float(applied)
        # NaN before the first command repeats the start voltage
        self._state = np.array([start, start, 0.0, 0.0, 0.0, 1.0])
        self._settings = settings
        # start [V], length and number of finished samples of the ramp to rest
        self._ramp: tuple[float, int, int] | None = None
        # whether nothing has been commanded since the last silence
        self._idled = False
        # compiles the kernel, so that the first block need not wait
        self.process(())

    @property
    def settings(self) -> GuardSettings:
        """Limits of the guard."""
        return self._settings

    @settings.setter
    def settings(self, settings: GuardSettings) -> None:
        # equal settings do not begin a ramp anew
        if settings != self._settings:
            self._settings, self._ramp = settings, None

    @property
    def applied(self) -> float:
        """The last voltage applied [V]."""
        return float(self._state[_APPLIED])

    @property
    def is_at_rest(self) -> bool:
        """Whether the rest voltage is applied."""
        return self.applied == self._settings.rest

    def process(self, command: ArrayLike, restarted: bool = False) -> Applied:
        """
        Make the applied voltage for the next block of command.

        Parameters
        ----------
        command : array_like, shape (n,)
            [V]
        restarted : bool, optional
            Whether a new stream begins here.  A stream after `idle` is always new.
        """
        v = np.ascontiguousarray(command, dtype=np.float64)
        state, settings = self._state, self._settings
        if self._idled or restarted:
            state[_COMMAND] = state[_APPLIED]
            state[_DONE] = state[_LENGTH] = 0.0
            state[_PENDING] = 1.0
            self._ramp, self._idled = None, False
        counts = np.zeros(len(REASONS), dtype=np.int64)
        out = np.empty_like(v)
        limits = settings.low, settings.high, settings.step, settings.ramp_step
        _follow(v, *limits, state, out, counts)
        altered = {why: int(n) for why, n in zip(REASONS, counts, strict=True) if n}
        return Applied(out, altered)

    def hold(self, n: int) -> NDArray[np.float64]:
        """Repeat the last voltage for `n` missing samples, first moving back into new limits."""
        back = self._back_inside(n)
        return np.concatenate([back, np.full(n - back.size, self.applied)])

    def _back_inside(self, n: int) -> NDArray[np.float64]:
        """Move back into changed limits at the slew, for up to `n` samples."""
        settings, start = self._settings, self.applied
        limit = min(max(start, settings.low), settings.high)
        if limit == start or not n:
            return np.empty(0)
        most = min(n, math.ceil(abs(limit - start) / settings.step) + 1)
        steps = np.full(most + 1, math.copysign(settings.step, limit - start))
        steps[0] = start
        # summed one by one, so that the size of the blocks changes no bit
        way = np.add.accumulate(steps)[1:]
        there = np.flatnonzero(way <= limit if limit < start else way >= limit)
        if there.size:
            way = way[: there[0] + 1]
            way[-1] = limit
        self._state[_APPLIED] = way[-1]
        return np.asarray(way)

    def idle(self, n: int, longest: float = math.inf) -> NDArray[np.float64]:
        """
        Make the voltage for `n` samples without a command: a soft ramp to rest, then rest.

        Parameters
        ----------
        n : int
            Number of samples.
        longest : float, optional
            Longest ramp [s], fixed when the ramp begins.  The slew still limits its speed.

        Returns
        -------
        ndarray, shape (n,)
            [V]
        """
        settings, rest = self._settings, self._settings.rest
        self._idled = True
        back = self._back_inside(n)
        n -= back.size
        if not n:
            return back
        if self._ramp is None:
            distance = 2.0 * abs(rest - self.applied)
            length = math.ceil(distance / settings.ramp_step)
            if length > longest * settings.sample_rate:
                fastest = math.ceil(distance / settings.step)
                length = max(fastest, int(longest * settings.sample_rate))
            self._ramp = (self.applied, length, 0)
        start, length, done = self._ramp
        k = np.arange(done + 1, done + n + 1)
        tau = np.minimum(k / max(length, 1), 1.0)
        shape = tau - np.sin(2 * np.pi * tau) / (2 * np.pi)
        # exactly rest, free of rounding
        voltage = np.where(k >= length, rest, start + (rest - start) * shape)
        self._ramp = (start, length, done + n)
        self._state[_APPLIED] = voltage[-1]
        return np.concatenate([back, voltage]) if back.size else voltage
