# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The public benchmark of a mass on a Bouc-Wen spring, made from its equations.

    m y'' + c y' + k y + z = u,      z' = alpha y' - beta (gamma |y'| z + delta y' |z|)

J. P. Noel, M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", 2016,
doi:10.4121/12967592: values, sampling, excitation and noise are theirs, the realisations are not.
The hysteresis is inside the loop: it bends the force of the spring, not the input.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import kernel
from scipy.signal import chirp, decimate

Array = NDArray[np.float64]

#: sampling [Hz], steps of the integration a sample, samples a period
RATE, FINE, PERIOD = 750.0, 20, 8192
#: mass [kg], damping [N s/m], stiffness [N/m], and the law of the spring
M, C, K = 2.0, 10.0, 5e4
ALPHA, BETA, GAMMA, DELTA = 5e4, 1e3, 0.8, -1.1
#: rms force [N], band [Hz], rms noise of the displacement [m]
FORCE, BAND, NOISE = 50.0, (5.0, 150.0), 8e-6


@kernel
def _newmark(u: Array, h: float, out: Array) -> None:
    # constant mean acceleration; the force of the spring is found by repetition
    y = v = a = z = rate = 0.0
    for i in range(u.size):
        y_next, v_next, z_next = y + h * v + 0.25 * h * h * a, v + 0.5 * h * a, z + h * rate
        for _ in range(8):
            left = u[i] - C * v_next - K * y_next - z_next
            a_next = left / (M + 0.5 * h * C + 0.25 * h * h * K)
            speed = v_next + 0.5 * h * a_next
            end = ALPHA * speed - BETA * (
                GAMMA * abs(speed) * z_next + DELTA * speed * abs(z_next)
            )
            z_next = z + 0.5 * h * (rate + end)
        y, v, a, z, rate = y_next + 0.25 * h * h * a_next, speed, a_next, z_next, end
        out[i] = y


def respond(fine: Array) -> tuple[Array, Array]:
    """Return force [N] and displacement [m] at `RATE`, of a force at `FINE` times that rate."""
    y = np.empty_like(fine)
    _newmark(fine, 1.0 / (RATE * FINE), y)
    for factor in (4, 5):
        y = decimate(y, factor, ftype='fir', zero_phase=True)
    return fine[::FINE].copy(), y


def multisine(rng: np.random.Generator, periods: int) -> Array:
    """Return a force with random phases, equal amplitudes in the band, at `FINE` times `RATE`."""
    lines = np.arange(PERIOD // 2) * RATE / PERIOD
    spectrum = np.zeros(PERIOD * FINE // 2 + 1, complex)
    inside = np.flatnonzero((lines >= BAND[0]) & (lines <= BAND[1]))
    spectrum[inside] = np.exp(2j * np.pi * rng.random(inside.size))
    x = np.fft.irfft(spectrum, PERIOD * FINE)
    return np.tile(FORCE * x / x.std(), periods)


def records(seed: int) -> dict[str, tuple[Array, Array]]:
    """Return `fit`, two noisy periods from rest, and `multisine` and `sweep` to judge by."""
    rng = np.random.default_rng([2016, seed])
    u, y = respond(multisine(rng, 2))
    made = {'fit': (u, y + NOISE * rng.standard_normal(y.size))}
    u, y = respond(multisine(rng, 2))
    # one period in steady state is judged; the model needs the one before it
    made['multisine'] = u, y
    t = np.arange(round(10.0 * RATE * FINE)) / (RATE * FINE)
    made['sweep'] = respond(40.0 * chirp(t, 20.0, t[-1], 50.0, 'linear', -90))
    return made


def rms_error(predicted: Array, y: Array, name: str) -> float:
    """Return the rms error on what is judged [m]."""
    start = PERIOD if name == 'multisine' else 0
    return float(np.sqrt(np.mean((y - predicted)[start:] ** 2)))
