# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Linear parts: continuous-time cascades, the published ARX model, delays, relaxation spectra."""

from __future__ import annotations

from dataclasses import dataclass
import math

from numba import njit
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import fftconvolve, firwin, lfilter

from .cores import Array, Rng

#: internal sampling rate [Hz]
RATE = 20000.0

#: frequencies over which a change of dynamics is measured [Hz]; what drives a stage is slow, and
#: its corners and harmonics reach higher
BAND = np.linspace(10.0, 900.0, 446)
WEIGHT = 1.0 / (1.0 + (BAND / 200.0) ** 4)

#: Gu, Li, Zhu, Su (2016), doi:10.1109/TMECH.2015.2465868, eqs. 4-5
PAPER_A = (
    -1.5157, 0.3685, 0.5132, 0.02363, -0.09831, -0.2931, 0.0842, 0.2921, -0.2582, 0.05803
)  # fmt: skip
PAPER_B = (
    0.02146, 0.02553, 0.01495, -0.001324, 0.001639, 0.01780, 0.02112, 0.01059, 0.001185, -0.001171
)  # fmt: skip


def _rms(x: NDArray[np.complex128]) -> float:
    """Return the weighted rms over `BAND`."""
    return float(np.sqrt(np.sum(WEIGHT * np.abs(x) ** 2) / np.sum(WEIGHT)))


@njit(cache=True, nogil=True)
def _run(A: Array, B: Array, C: Array, u: Array, out: Array) -> None:
    n = B.size
    x, new = np.zeros(n), np.zeros(n)
    for k in range(u.size):
        total = 0.0
        for i in range(n):
            total += C[i] * x[i]
        out[k] = total
        for i in range(n):
            total = B[i] * u[k]
            for j in range(n):
                total += A[i, j] * x[j]
            new[i] = total
        for i in range(n):
            x[i] = new[i]


@dataclass(frozen=True)
class Cascade:
    """
    Modes side by side, then first-order poles in a row; static gain 1.

    `modes`: tuple of (frequency [Hz], damping ratio, share): share w^2 / (s^2 + 2 zeta w s + w^2)
    each; the shares need not add up to 1; `poles`: corner frequencies of amplifier and sensor
    [Hz].
    """

    modes: tuple[tuple[float, float, float], ...]
    poles: tuple[float, ...] = ()

    def __call__(self, u: Array) -> Array:
        """Return the answer to an input held between samples, from rest at zero."""
        m = len(self.modes)
        n = 2 * m + len(self.poles)
        # states in seconds^-1 units of each mode, so that the exponential stays well scaled
        A, B, C = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        tap = np.zeros(n)
        for i, (frequency, zeta, share) in enumerate(self.modes):
            w = 2 * math.pi * frequency
            A[2 * i, 2 * i + 1] = w
            A[2 * i + 1, 2 * i] = -w
            A[2 * i + 1, 2 * i + 1] = -2 * zeta * w
            B[2 * i + 1] = w
            tap[2 * i] = share
        for j, corner in enumerate(self.poles):
            row, w = 2 * m + j, 2 * math.pi * corner
            A[row] += w * tap
            A[row, row] -= w
            tap = np.zeros(n)
            tap[row] = 1.0
        C[:] = tap
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n] = A, B
        held = expm(whole / RATE)
        out = np.empty(u.size)
        _run(
            np.ascontiguousarray(held[:n, :n]),
            np.ascontiguousarray(held[:n, n]),
            C,
            np.ascontiguousarray(u),
            out,
        )
        return out

    def response(self, frequency: Array) -> NDArray[np.complex128]:
        """Return the complex gain at frequencies [Hz], shape (n,)."""
        s = 1j * frequency
        parts = [k * f * f / (s * s + 2 * z * f * s + f * f) for f, z, k in self.modes]
        gain = np.sum(parts, axis=0)
        for corner in self.poles:
            gain = gain / (1 + s / corner)
        return np.asarray(gain)

    def loaded(self, change: float) -> Cascade:
        """
        Return the cascade with mass added to its first mode.

        `change`: wanted rms of the change of the complex gain over `BAND`.
        """
        (frequency, zeta, share), *others = self.modes
        before = self.response(BAND)
        low, high = 0.25, 1.0
        new = self
        for _ in range(40):
            ratio = 0.5 * (low + high)
            # the same dashpot on more mass
            new = Cascade(((frequency * ratio, zeta * ratio, share), *others), self.poles)
            if _rms(new.response(BAND) - before) > change:
                low = ratio
            else:
                high = ratio
        return new


@dataclass(frozen=True)
class ARX:
    """The published ARX(10, 10) model, scaled to static gain 1."""

    def __call__(self, u: Array) -> Array:
        """Return the answer from rest at zero."""
        a, b = np.array([1.0, *PAPER_A]), np.array(PAPER_B)
        return np.asarray(lfilter(b * a.sum() / b.sum(), a, u))


@dataclass(frozen=True)
class Linear:
    """
    Modes side by side, a sensor's pole, a delay.

    `modes`: tuple of (frequency [Hz], damping ratio, share): The shares add up to 1; neighbours of
    one sign have an antiresonance between them; `pole`: corner of the sensor [Hz]; `delay`: [s],
    of any fraction of a sample.
    """

    modes: tuple[tuple[float, float, float], ...]
    pole: float
    delay: float

    def __call__(self, h: Array, rate: float, later: float = 0.0) -> Array:
        """Return the answer to h held between samples, from rest at h[0]."""
        x = h - h[0]
        total = np.zeros(h.size)
        for frequency, zeta, share in self.modes:
            w = 2 * math.pi * frequency
            whole = np.zeros((3, 3))
            whole[0, 1], whole[1, 0], whole[1, 1], whole[1, 2] = w, -w, -2 * zeta * w, w
            held = expm(whole / rate)
            a1, a2 = -float(np.trace(held[:2, :2])), float(np.linalg.det(held[:2, :2]))
            # the first two samples of the answer to a pulse
            first = float(held[0, 2])
            second = float(held[0, :2] @ held[:2, 2])
            total += share * lfilter([0.0, first, second + a1 * first], [1.0, a1, a2], x)
        pole = math.exp(-2 * math.pi * self.pole / rate)
        y = lfilter([1.0 - pole], [1.0, -pole], total)
        return np.asarray(delayed(y, self.delay + later, rate) + h[0])


def make_linear(rng: Rng, rate: float, highest: float = 1500.0) -> Linear:
    """Draw two or three light modes, a sensor's pole and a delay of 0 to 6 samples."""
    top = 0.38 * rate
    first = math.exp(rng.uniform(math.log(200.0), math.log(min(highest, top / 1.7))))
    places, frequency = [first], first
    for _ in range(int(rng.integers(1, 3))):
        frequency *= rng.uniform(1.6, 2.8)
        if frequency < top:
            places.append(frequency)
    # the lowest mode carries most; a higher one of its sign makes an antiresonance
    shares = rng.uniform(0.03, 0.2, len(places)) * rng.choice([1.0, 1.0, -1.0], len(places))
    shares[0] = 1.0 - shares[1:].sum()
    zetas = np.exp(rng.uniform(math.log(0.005), math.log(0.05), len(places)))
    modes = tuple(zip(map(float, places), map(float, zetas), map(float, shares), strict=True))
    pole = rng.uniform(0.15, 0.4) * rate
    return Linear(modes, pole, rng.uniform(0.0, 6.0) / rate)


def ridden(h: Array, change: float, frequency: float) -> Array:
    """
    Return what is added when a part of the motion goes through a mode of its own.

    `h`: input of the dynamics; `change`: wanted rms of the change of the complex gain over `BAND`;
    `frequency`: of the mode [Hz].
    """
    stiff = 3000.0
    mode = Cascade(((frequency, 0.03, 1.0),), (stiff,))
    share = change / _rms(mode.response(BAND) - 1 / (1 + 1j * BAND / stiff))
    return np.asarray(share * (mode(h) - lag(h, stiff)))


def delayed(x: Array, seconds: float, rate: float = RATE) -> Array:
    """
    Return a signal that starts from rest, delayed by any time, band-limited.

    Whole samples are shifted, the fraction is a windowed sinc of 64 taps.
    """
    samples = seconds * rate
    whole = math.floor(samples + 1e-9)
    fraction = samples - whole
    out = np.empty_like(x)
    whole = min(whole, x.size)
    out[:whole], out[whole:] = x[0], x[: x.size - whole]
    if fraction < 1e-6:
        return out
    half = 32
    taps = np.arange(-half, half + 1)
    place = taps - fraction
    kernel = np.sinc(place) * np.i0(14.0 * np.sqrt(np.maximum(1 - (place / (half + 1)) ** 2, 0)))
    kernel /= kernel.sum()
    padded = np.concatenate([np.full(half, out[0]), out, np.full(half, out[-1])])
    return np.asarray(np.convolve(padded, kernel, mode='valid'))


def lag(x: Array, corner: float, order: int = 1, rate: float = RATE) -> Array:
    """Return x behind equal first-order lags, held between samples, from rest at x[0]."""
    pole = math.exp(-2 * math.pi * corner / rate)
    y = x
    for _ in range(order):
        y, _ = lfilter([1.0 - pole], [1.0, -pole], y, zi=[pole * y[0]])
    return np.asarray(y)


@njit(cache=True, nogil=True)
def _relax(h: Array, pole: Array, weight: Array, up: float, out: Array) -> None:
    x = np.full(pole.size, h[0])
    whole = weight.sum()
    for k in range(h.size):
        behind = 0.0
        for i in range(pole.size):
            x[i] = pole[i] * x[i] + (1.0 - pole[i]) * h[k]
            behind += weight[i] * (x[i] - h[k])
        out[k] = (1.0 + whole) * h[k] + (up if behind < 0 else 1.0) * behind


def relaxation(h: Array, law: str, amount: float, up: float = 1.0, rate: float = RATE) -> Array:
    """
    Return h with creep, every change of h relaxing on its own (Boltzmann's superposition).

    A unit step of h becomes ``1 + amount ln(1 + t / t0)`` with the law `log`, whose relaxation
    spectrum is exactly exp(-t0 / tau) d ln tau, and ``1 + amount ((1 + t / t0)^nu - 1) / nu`` with
    the law `power`, whose spectrum is (tau / t0)^nu exp(-t0 / tau) / Gamma(1 - nu) d ln tau; 60
    exponentials from 4 ms to 4000 s stand for it.

    `law`: {'log', 'power'}; `amount`: per factor e of time, early on; `up`: multiplies what is
    still missing after rises; 0 makes them immediate; `rate`: [Hz].
    """
    t0, nu = 0.02, 0.12
    tau = np.geomspace(0.004, 4000.0, 60)
    spectrum = np.exp(-t0 / tau) * math.log(tau[1] / tau[0])
    if law == 'power':
        spectrum *= (tau / t0) ** nu / math.gamma(1.0 - nu)
    out = np.empty(h.size)
    _relax(np.ascontiguousarray(h), np.exp(-1.0 / (rate * tau)), amount * spectrum, up, out)
    return out


def band(rng: np.random.Generator, n: int, low: float, high: float) -> Array:
    """Return noise of unit rms between two frequencies [Hz], shape (n,)."""
    taps = min(8001, 2 * (n // 8) + 1)
    kernel = firwin(taps, [low, high], pass_zero=False, fs=RATE)
    x = fftconvolve(rng.standard_normal(n + taps - 1), kernel, mode='valid')
    return np.asarray(x / max(float(x.std()), 1e-12))


def pink(white: Array) -> Array:
    """Return white noise with a density of 1/f."""
    spectrum = np.fft.rfft(white)
    spectrum[0] = 0.0
    spectrum[1:] /= np.sqrt(np.arange(1, spectrum.size))
    return np.asarray(np.fft.irfft(spectrum, white.size))
