# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The safety contract of the node that drives the amplifier, judged on the voltage applied.

Whatever command comes in - out of range, jumping, not a number, stopping, starting over - the
voltage that goes out stays within its limits and its slew:

- a command that is in order passes bit for bit;
- one outside the limits is applied at the limit, one that jumps is followed at the slew;
- a sample that is no number leaves the last command in force;
- when no command comes any more, the caller asks `Guard.idle` for a soft ramp to rest;
- a new stream joins softly: the distance between what is applied and what is commanded fades out
  along a raised cosine, while the command is followed.

The simulated stage and the excitation use it, and so should a driver of real hardware.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.kernel import kernel

#: how long the ramp of a node that is ending may take [s]
LAST_RAMP = 0.7
#: why a sample was altered, in the order of the kernel's counts
REASONS = ('not_finite', 'outside_limits', 'too_fast', 'joining')

# the state of a guard that its kernel changes
_APPLIED, _COMMAND, _OFFSET, _DONE, _LENGTH, _PENDING = range(6)


@dataclass(frozen=True)
class GuardSettings:
    """
    What a guard holds to.

    Parameters
    ----------
    low, high : float
        Limits [V].
    slew : float
        Steepest voltage that is ever applied [V/s].
    ramp_slew : float
        Top speed of the ramps to rest and into a new stream [V/s].
    rest : float
        Where a silent drive goes [V].
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
            raise ConfigError('slew, ramp_slew and sample_rate of a guard must be positive')

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
    What became of a block of command.

    Attributes
    ----------
    voltage : ndarray, shape (n,)
        What is applied [V]; the command itself where nothing was wrong.
    altered : mapping of str to int
        How many samples were altered, by reason: ``not_finite``, ``outside_limits``, ``too_fast``,
        ``joining``; empty when none was.
    """

    voltage: NDArray[np.float64]
    altered: Mapping[str, int] = field(default_factory=dict)


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
            # the limits may have been moved since
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
    Makes of a command what may be applied; how it is cut into blocks changes no bit.

    Parameters
    ----------
    settings : GuardSettings
        May be replaced at any time; an applied voltage outside new limits moves back into them at
        the slew, also in a gap and before a ramp to rest.
    applied : float, optional
        The voltage applied so far [V]; rest when absent.

    Examples
    --------
    >>> guard = Guard(GuardSettings(0, 10, slew=1000, ramp_slew=20, rest=0, sample_rate=1000))
    >>> guard.process([0.0, 0.5, 5.0, float('nan'), 1.5]).voltage.tolist()
    [0.0, 0.5, 1.5, 2.5, 1.5]
    >>> float(guard.idle(1000)[-1])
    0.0
    """

    def __init__(self, settings: GuardSettings, applied: float | None = None) -> None:
        start = settings.rest if applied is None else float(applied)
        # a command that is no number before the first one that is: stay where we are
        self._state = np.array([start, start, 0.0, 0.0, 0.0, 1.0])
        self._settings = settings
        # start and length in samples of the ramp to rest, and how much of it is done
        self._ramp: tuple[float, int, int] | None = None
        # whether nothing has been commanded since the last silence
        self._idled = False
        # compiles, so that the first block does not have to wait
        self.process(())

    @property
    def settings(self) -> GuardSettings:
        """What is held to."""
        return self._settings

    @settings.setter
    def settings(self, settings: GuardSettings) -> None:
        self._settings = settings
        self._ramp = None

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
        Return what may be applied of the next stretch of command.

        Parameters
        ----------
        command : array_like, shape (n,)
            [V]
        restarted : bool, optional
            Whether a new stream begins here; after `idle` one always does.
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
        """Return what is applied while `n` samples of a stream are missing: the last voltage."""
        back = self._back_inside(n)
        return np.concatenate([back, np.full(n - back.size, self.applied)])

    def _back_inside(self, n: int) -> NDArray[np.float64]:
        """Return up to `n` samples of the way back into limits that were moved."""
        settings, start = self._settings, self.applied
        limit = min(max(start, settings.low), settings.high)
        if limit == start or not n:
            return np.empty(0)
        most = min(n, math.ceil(abs(limit - start) / settings.step) + 1)
        steps = np.full(most + 1, math.copysign(settings.step, limit - start))
        steps[0] = start
        # one after the other, so that it does not matter how the time is cut
        way = np.add.accumulate(steps)[1:]
        there = np.flatnonzero(way <= limit if limit < start else way >= limit)
        if there.size:
            way = way[: there[0] + 1]
            way[-1] = limit
        self._state[_APPLIED] = way[-1]
        return np.asarray(way)

    def idle(self, n: int, longest: float = math.inf) -> NDArray[np.float64]:
        """
        Return what is applied while no command comes: a soft ramp to rest, and then rest.

        Parameters
        ----------
        n : int
            Number of samples.
        longest : float, optional
            Time within which rest must be reached [s], though never faster than the slew allows;
            looked at when the ramp begins.

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
        # rest itself, not what rounding leaves of it
        voltage = np.where(k >= length, rest, start + (rest - start) * shape)
        self._ramp = (start, length, done + n)
        self._state[_APPLIED] = voltage[-1]
        return np.concatenate([back, voltage]) if back.size else voltage
