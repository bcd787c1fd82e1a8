# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The inverse of G and the delay, as a filter that looks ahead.

    Q(f) = conj(G) / (|G|^2 + (epsilon G(0))^2)

G has zeros outside the unit circle, where a causal inverse grows without end, and a delay, which
none makes up for; a filter that knows the wanted motion some time ahead has neither limit.  Where
the stage hardly moves, above its modes, epsilon keeps the voltage small.  There a model from data
knows little, too: a corner of a scan, made up for in full, makes the real stage ring.

It is the stable inversion of S. Devasia, D. Chen and B. Paden, "Nonlinear inversion-based output
tracking", IEEE Trans. Automatic Control 41(7), 1996, doi:10.1109/9.508898, for a linear system,
with the weight on the voltage of S. Devasia, "Should model-based inverse inputs be used as
feedforward under plant uncertainty?", ibid. 47(11), 2002, doi:10.1109/TAC.2002.804478.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
import math

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

#: gain of G, as a share of the static one, below which it is not made up for: of a model that is
#: exact, and of one from data, which knows little of what hardly moves
EXACT, FROM_DATA = 3e-2, 0.1
#: what may lie outside of the filter, as a share of the sum of its magnitudes
OUTSIDE = 1e-7
#: the same, where rounding leaves more
ROUNDING = 1e-5
#: the same, of what matters
REACH = 1e-3
#: slope of H that is none
FLAT = 1e-6
#: lengths of the filter that are tried [samples], and the shortest in parts of the delay
SHORTEST, LONGEST, OF_DELAY = 1 << 11, 1 << 19, 8
#: what a shortened filter may miss before the present sample, as a share of the sum of its
#: magnitudes, and its most samples there
MISSED, MOST_BEHIND = 1e-6, 8192
#: corner of what no filter is long enough for [1 / `LONGEST`]: a quarter of it holds so many time
#: constants as `OUTSIDE` takes; and its share of the static gain that an iteration makes up for
SLOW, LITTLE = -4.0 * math.log(OUTSIDE) / (2.0 * math.pi), 0.2
#: damping below which a mode rings
RINGS = 0.2
#: delays of the model that a preview must reach for the filter to be worth anything
BEYOND = 1.2


@dataclass(frozen=True, eq=False)
class LinearInverse:
    """
    The filter.

    Its `taps`, shape (ahead + 1 + behind,), begin with the earliest; it needs `ahead` samples
    after and `behind` before the present one.
    """

    taps: Array
    ahead: int
    behind: int

    @property
    def reach(self) -> int:
        """Samples before and after which the wanted motion matters by less than `REACH`."""
        size = np.cumsum(np.abs(self.taps))
        first, last = np.searchsorted(size, size[-1] * np.array([REACH, 1.0 - REACH]))
        return int(max(self.ahead - first, last - self.ahead, 0))

    def shortened(self, most: int) -> LinearInverse:
        """Return a filter that looks ahead by so many samples at most, of the same static gain."""
        ahead = min(self.ahead, most)
        size = np.abs(self.taps[::-1])
        idle = int(np.argmax(np.cumsum(size) > MISSED * size.sum()))
        behind = min(max(self.behind - idle, 0), MOST_BEHIND)
        taps = self.taps[self.ahead - ahead : self.ahead + 1 + behind]
        return LinearInverse(taps * (self.taps.sum() / taps.sum()), ahead, behind)

    def __call__(self, x: Array) -> Array:
        """Return the filtered signal; beyond its ends it rests.  Shape (n,)."""
        padded = np.pad(x, (self.behind, self.ahead), mode='edge')
        return np.asarray(oaconvolve(padded, self.taps, mode='valid'))


def linear_inverse(model: StageModel, *, iterated: bool = False) -> LinearInverse:
    """
    Return the inverse of all that is linear and fast in a model: G, the delay, and their changes.

    Its static gain is exact.  ModelError when G has no static gain, or rings or waits for longer
    than `LONGEST` samples.  Where an iteration makes up for it, as for creep, a little that G does
    more slowly than that may be left out, with its share of the static gain.
    """
    gain = model.dynamics.gain
    if gain == 0.0 or not np.isfinite(gain):
        raise ModelError('this model has no inverse: its G is without a static gain')
    n = SHORTEST
    # a longer delay would come round
    while n < OF_DELAY * model.total_delay.samples:
        n *= 2
    left = np.inf
    while n <= LONGEST:
        G = _response(model, n)
        Q = np.conj(G) / (np.abs(G) ** 2 + (least_gain(model) * np.abs(G[0])) ** 2)
        taps = np.roll(np.fft.irfft(Q, n), n // 2)
        size = np.abs(taps)
        before, after = np.cumsum(size), np.cumsum(size[::-1])[::-1]
        # half of it stays empty, so that nothing has come round
        last, left = left, float(before[n // 4] + after[-(n // 4)]) / float(before[-1])
        # where poles lie close together, digits are lost that no length brings back
        if left < OUTSIDE or 0.5 * last < left < ROUNDING:
            share = 0.5 * max(OUTSIDE, 4.0 * left) * float(before[-1])
            start = min(int(np.searchsorted(before, share)), n // 2)
            stop = max(n - int(np.searchsorted(after[::-1], share)), n // 2 + 1)
            cut = taps[start:stop]
            # the static gain of the whole model without effects; what they change is small
            return LinearInverse(cut / (cut.sum() * G[0].real), n // 2 - start, stop - 1 - n // 2)
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
        f'{model.total_delay.total:g} samples, and the pole or zero of G that dies away last has '
        f'the radius {slowest:.6f}; identify again with a lower order'
    )


def lowest_mode(model: StageModel) -> float:
    """Return the frequency of the lowest mode that rings [Hz]; infinite where none does."""
    modes = model.dynamics.modes(model.sample_rate)
    return min((mode.frequency for mode in modes if mode.damping < RINGS), default=math.inf)


def least_gain(model: StageModel) -> float:
    """Return the gain of G, as a share of the static one, below which it is not made up for."""
    # plays that widen with speed are undone with G as it is, or smooth motion is missed by more
    widens = any(effect.name == RateDependentHysteresis.name for effect in model.effects)
    return EXACT if widens or expected_error(model) is None else FROM_DATA


def least_preview(model: StageModel) -> float:
    """Return the samples that a motion must be known ahead, or a little more."""
    return max(1.0, BEYOND * model.total_delay.total)


def check_preview(model: StageModel, preview: int) -> None:
    """Refuse a preview that is too short for a model, with a ModelError."""
    if preview < least_preview(model):
        raise ModelError(
            f'a preview of {preview} samples does not reach beyond the delay of the model, '
            f'{model.total_delay.total:g} samples; make it longer'
        )


def smoothed(x: Array, corner: float, sample_rate: float) -> Array:
    """Return a signal behind a Gaussian low-pass without phase, a half at the corner [Hz]."""
    width = math.sqrt(2.0 * math.log(2.0)) * sample_rate / (2.0 * math.pi * corner)
    return np.asarray(gaussian_filter1d(x, width, mode='nearest'))


def is_filter(effect: type[Effect]) -> bool:
    """Return whether an effect is undone with G, as a filter of its own."""
    return effect.in_dynamics and not effect.in_delay_line and effect.change != 'passed'


def _response(model: StageModel, n: int) -> NDArray[np.complex128]:
    """Return G with its delay, and with effects that filter it, at n // 2 + 1 frequencies."""
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
        of = []
        for v, x in ((none, impulse), (impulse / _slope(model.hysteresis), none)):
            operator = effect(model.sample_rate, setting.parameters)
            operator.reset(0.0, 0.0)
            of.append(np.fft.rfft(operator.process(Block(t=t, v=v, x=x)).x))
        G = G * of[0] + of[1]
    return np.asarray(G, dtype=np.complex128)


@lru_cache(maxsize=1)
def _slope(h: Hysteresis) -> float:
    """Return the slope of H as a line; with one much steeper than H nothing would converge."""
    return math.sqrt(np.ptp(h(h.span)) / np.ptp(h.span) * max(h.lowest_slope(), FLAT))
