# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert G and the delay by a filter that looks ahead.

    Q(f) = conj(G) / (|G|^2 + (epsilon G(0))^2)

A causal inverse cannot undo a delay, and it diverges at zeros of G outside the unit circle.  A
filter that knows the wanted motion some time ahead has neither limit.  Above the modes the stage
hardly moves; epsilon keeps the voltage small there.  A model from data is uncertain there as well:
full compensation of the corners of a scan makes the real stage ring.

The method is the stable inversion of S. Devasia, D. Chen and B. Paden, "Nonlinear inversion-based
output tracking", IEEE Trans. Automatic Control 41(7), 1996, doi:10.1109/9.508898, for a linear
system.  The weight on the voltage is that in S. Devasia, "Should model-based inverse inputs be
used as feedforward under plant uncertainty?", ibid. 47(11), 2002, doi:10.1109/TAC.2002.804478.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
import math
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.model.metrics import expected_error
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis
from scipy.ndimage import gaussian_filter1d
from scipy.signal import oaconvolve

#: epsilon of an exact model, and of a model from data, whose small gains are uncertain
EXACT, FROM_DATA = 3e-2, 0.1
#: largest truncated part of the filter, as a share of the sum of its magnitudes
OUTSIDE = 1e-7
#: the same, if rounding does not allow less
ROUNDING = 1e-5
#: the same, for the neighbourhood that a sample influences
REACH = 1e-3
#: smallest slope of H that counts
FLAT = 1e-6
#: shortest and longest filter [samples], and shortest filter in delays of the model
SHORTEST, LONGEST, OF_DELAY = 1 << 11, 1 << 19, 8
#: past of a shortened filter: largest truncated part, as a share of the sum of its magnitudes,
#: and most samples
MISSED, MOST_BEHIND = 1e-6, 8192
#: Poles below the corner `SLOW` [1 / `LONGEST`] are too slow for the longest filter, a quarter of
#: which must hold the time constants that `OUTSIDE` takes.  An iteration corrects slow poles with
#: at most the share `LITTLE` of the static gain (taste)
SLOW, LITTLE = -4.0 * math.log(OUTSIDE) / (2.0 * math.pi), 0.2
#: damping below which a mode rings
RINGS = 0.2
#: shortest useful preview in delays of the model
BEYOND = 1.2


Filter = TypeVar('Filter', bound='LinearInverse')


@dataclass(frozen=True, eq=False)
class LinearInverse:
    """
    Inverse filter that needs `ahead` samples after and `behind` samples before the present one.

    Its `taps`, shape (ahead + 1 + behind,), begin with the earliest.
    """

    taps: Array
    ahead: int
    behind: int

    @property
    def size(self) -> Array:
        """Size of each tap."""
        return np.abs(self.taps)

    @property
    def reach(self) -> int:
        """Distance beyond which a sample of the wanted motion matters less than `REACH`."""
        total = np.cumsum(self.size)
        first, last = np.searchsorted(total, total[-1] * np.array([REACH, 1.0 - REACH]))
        return int(max(self.ahead - first, last - self.ahead, 0))

    def shortened(self: Filter, most: int) -> Filter:
        """Limit the samples ahead to `most`, the past to the part that counts; keep the gain."""
        size = self.size
        idle = int(np.argmax(np.cumsum(size[::-1]) > MISSED * size.sum()))
        ahead, behind = min(self.ahead, most), min(max(self.behind - idle, 0), MOST_BEHIND)
        taps = self.taps[self.ahead - ahead : self.ahead + 1 + behind]
        return replace(self, taps=self.with_gain(taps), ahead=ahead, behind=behind)

    def with_gain(self, taps: Array) -> Array:
        """Scale other taps to the static gain of this filter."""
        return np.asarray(taps * (self.taps.sum() / taps.sum()))

    def __call__(self, x: Array) -> Array:
        """Filter a signal of shape (n,) that rests before and after its samples."""
        padded = np.pad(x, (self.behind, self.ahead), mode='edge')
        return np.asarray(oaconvolve(padded, self.taps, mode='valid'))


class Cut(NamedTuple):
    """The taps of a filter that count, `used`, and the samples that these need."""

    used: slice
    ahead: int
    behind: int


def cut(size: Array, last: float) -> tuple[float, Cut | None]:
    """
    Cut off the ends of a filter.

    Parameters
    ----------
    size : ndarray, shape (n,)
        Sizes of the taps; the middle one belongs to the present sample.
    last : float
        Share of the ends in a filter half as long.

    Returns
    -------
    left : float
        Share of the ends: the outer quarters.  If the ends are empty, the filter has not wrapped
        around.
    cut : Cut or None
        The used taps, or None for too short a filter.
    """
    n = len(size)
    before, after = np.cumsum(size), np.cumsum(size[::-1])[::-1]
    left = float(before[n // 4] + after[-(n // 4)]) / float(before[-1])
    # close poles cost digits, which a longer filter does not bring back
    if not (left < OUTSIDE or 0.5 * last < left < ROUNDING):
        return left, None
    share = 0.5 * max(OUTSIDE, 4.0 * left) * float(before[-1])
    start = min(int(np.searchsorted(before, share)), n // 2)
    stop = max(n - int(np.searchsorted(after[::-1], share)), n // 2 + 1)
    return left, Cut(slice(start, stop), n // 2 - start, stop - 1 - n // 2)


def linear_inverse(model: StageModel, *, iterated: bool = False) -> LinearInverse:
    """
    Invert the linear and fast part of a model: G, the delay, and the effects that filter them.

    The static gain of the filter is exact.

    Parameters
    ----------
    model : StageModel
    iterated : bool, optional
        Whether an iteration with the whole model follows.  The filter may then leave out poles
        that are too slow for `LONGEST` samples, if they hold little of the static gain.

    Raises
    ------
    ModelError
        When G has no static gain, or needs a filter of more than `LONGEST` samples.
    """
    gain = model.dynamics.gain
    if not 0.0 < gain * gain < np.inf:
        raise ModelError(
            f'this model has no inverse: G has the static gain {gain:g}; identify again'
        )
    n = SHORTEST
    # a longer delay would wrap around
    while n < OF_DELAY * model.total_delay.samples:
        n *= 2
    left = np.inf
    while n <= LONGEST:
        G = _response(model, n)
        Q = np.conj(G) / (np.abs(G) ** 2 + (least_gain(model) * np.abs(G[0])) ** 2)
        taps = np.roll(np.fft.irfft(Q, n), n // 2)
        left, enough = cut(np.abs(taps), left)
        if enough is not None:
            part = taps[enough.used]
            # static gain of the model without effects, whose share is small
            return LinearInverse(part / (part.sum() * G[0].real), enough.ahead, enough.behind)
        n *= 2
    faster = model.dynamics.without_slow_poles(
        SLOW * model.sample_rate / LONGEST, model.sample_rate
    )
    if iterated and 0.0 < abs(faster.gain / gain - 1.0) < LITTLE:
        return linear_inverse(replace(model, dynamics=faster))
    a, b = model.dynamics.a, model.dynamics.b
    radii = np.abs(np.concatenate([np.roots(np.append(1.0, a)), np.roots(b)]))
    slowest = min(radii, key=lambda r: abs(r - 1.0), default=0.0)
    raise ModelError(
        f'this model has no inverse of less than {LONGEST} samples: its delay is '
        f'{model.total_delay.total:g} samples, and the slowest pole or zero of G has the radius '
        f'{slowest:.6f}; identify again with a lower order'
    )


def lowest_mode(model: StageModel) -> float:
    """Frequency of the lowest mode that rings [Hz]; infinite without such a mode."""
    modes = model.dynamics.modes(model.sample_rate)
    return min((mode.frequency for mode in modes if mode.damping < RINGS), default=math.inf)


def least_gain(model: StageModel) -> float:
    """Choose epsilon: the share of the static gain below which G is not inverted."""
    # plays that widen with speed need the exact inverse, or smooth motion errs more
    widens = any(effect.name == RateDependentHysteresis.name for effect in model.effects)
    return EXACT if widens or expected_error(model) is None else FROM_DATA


def least_preview(model: StageModel) -> float:
    """Shortest useful preview [samples]."""
    return max(1.0, BEYOND * model.total_delay.total)


def check_preview(model: StageModel, preview: int) -> None:
    """Refuse a preview that is too short for a model, with a ModelError."""
    if preview < least_preview(model):
        raise ModelError(
            f'a preview of {preview} samples does not reach beyond the delay of the model, '
            f'{model.total_delay.total:g} samples; make it longer'
        )


def smoothed(x: Array, corner: float, sample_rate: float) -> Array:
    """Filter by a Gaussian low-pass without phase, whose gain is 1/2 at the corner [Hz]."""
    width = math.sqrt(2.0 * math.log(2.0)) * sample_rate / (2.0 * math.pi * corner)
    return np.asarray(gaussian_filter1d(x, width, mode='nearest'))


def is_filter(effect: type[Effect]) -> bool:
    """Tell whether an effect is a filter that is inverted together with G."""
    return effect.in_dynamics and not effect.in_delay_line and effect.change != 'passed'


def _response(model: StageModel, n: int) -> NDArray[np.complex128]:
    """Response of G, the delay and filtering effects at n // 2 + 1 frequencies."""
    z = np.exp(-2j * np.pi * np.fft.rfftfreq(n))
    delay = model.total_delay
    G = model.dynamics.response(np.fft.rfftfreq(n), 1.0) * z**delay.samples
    G = G * ((1.0 - delay.fraction) + delay.fraction * z)
    impulse, none = np.zeros((2, n))
    impulse[0] = 1.0
    t = np.arange(n) / model.sample_rate
    for setting in model.effects:
        effect = find_effect(setting.name)
        if not effect.in_dynamics or effect.in_delay_line:
            continue
        responses = []
        for v, x in ((none, impulse), (impulse / _slope(model.hysteresis), none)):
            operator = effect(model.sample_rate, setting.parameters)
            operator.reset(0.0, 0.0)
            responses.append(np.fft.rfft(operator.process(Block(t=t, v=v, x=x)).x))
        G = G * responses[0] + responses[1]
    return np.asarray(G, dtype=np.complex128)


@lru_cache(maxsize=1)
def _slope(h: Hysteresis) -> float:
    """Slope of a line for H; the iteration diverges if the line is much steeper than H."""
    return math.sqrt(np.ptp(h(h.span)) / np.ptp(h.span) * max(h.lowest_slope(), FLAT))
