# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Second-order sections of effects, by the bilinear transform."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.operators.c_code import CCode, Numbers, read_c


@kernel
def _run(x: Array, c: Array, state: Array) -> Array:
    # c: n0, n1, a1, a2; state: the last input and two numbers of the transposed direct form.
    # The filter processes differences of its input, so that its output at rest is exactly zero.
    n0, n1, a1, a2 = c[0], c[1], c[2], c[3]
    last, s0, s1 = state[0], state[1], state[2]
    out = np.empty(x.size)
    for k in range(x.size):
        d = x[k] - last
        last = x[k]
        y = n0 * d + s0
        s0 = alive(n1 * d - a1 * y + s1)
        s1 = -a2 * y
        out[k] = y
    state[0], state[1], state[2] = last, s0, s1
    return out


def slope_of_mode(frequency: float, sample_rate: float) -> float:
    """
    Compute c in ``s/w -> c (1 - z^-1)/(1 + z^-1)``, exact at the frequency w of the mode.

    Raises ModelError if the frequency is not below half the sampling rate.
    """
    if not frequency < sample_rate / 2.0:
        raise ModelError(
            f'a mode at {frequency:g} Hz needs more than {2 * frequency:g} samples a second, '
            f'and there are {sample_rate:g}; lower its frequency'
        )
    return float(1.0 / np.tan(np.pi * frequency / sample_rate))


class SecondOrderSection:
    """
    ``g (M(s) - 1) + k R(s)`` with M = w^2/D, R = w s/D and D = s^2 + 2 zeta w s + w^2.

    With S = s/w the sum is ``(-g (S^2 + 2 zeta S) + k S) / (S^2 + 2 zeta S + 1)``.  Its zero at
    frequency 0 is the difference of the input that the filter processes.

    Parameters
    ----------
    frequency, damping : float
        Frequency w / 2 pi [Hz] and damping ratio zeta.
    gain, rate_gain : float
        Gains g and k.
    sample_rate : float
        Sampling rate [Hz].

    Raises
    ------
    ModelError
        If the frequency is not below half the sampling rate.
    """

    def __init__(
        self, frequency: float, damping: float, gain: float, rate_gain: float, sample_rate: float
    ) -> None:
        c = slope_of_mode(frequency, sample_rate)
        a0 = c * c + 2 * damping * c + 1.0
        self._c = np.array(
            [
                -gain * (c * c + 2 * damping * c) + rate_gain * c,
                gain * (c * c - 2 * damping * c) + rate_gain * c,
                2.0 - 2.0 * c * c,
                c * c - 2 * damping * c + 1.0,
            ]
        )
        self._c /= a0
        self._state = np.zeros(3)

    @property
    def coefficients(self) -> Array:
        """Coefficients n_0, n_1, a_1 and a_2 of the filter of differences."""
        return self._c

    def reset(self, x0: float) -> None:
        """Come to rest under a constant input; the output is then zero."""
        self._state = np.array([x0, 0.0, 0.0])

    def process(self, x: Array) -> Array:
        """Filter a signal, shape (n,)."""
        out: Array = _run(np.ascontiguousarray(x), self._c, self._state)
        return out


def sections_in_c(sections: Sequence[SecondOrderSection], signal: str) -> CCode:
    """Write C code that adds the sections of a signal, given by its name in C, to x."""
    names = 'n0', 'n1', 'a1', 'a2'
    rows = np.array([z.coefficients for z in sections]).T
    numbers: Numbers = {'n': len(sections), **dict(zip(names, rows, strict=True))}
    return read_c(__package__, 'second_order', numbers, signal=signal)
