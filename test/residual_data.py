# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Residuals of known content for the tests of the residual: drives, noises, parts."""

import numpy as np
from piezo_ident.record.record import Piece, Segment
from piezo_ident.residual.stretches import ResidualPart
from scipy.signal import lfilter

RATE = 2000.0
STROKE = 70e-6


def drive() -> tuple[np.ndarray, tuple[Segment, ...]]:
    """10 s: rest, 1 Hz, 50 Hz, noise, holds, a triangle."""
    rng = np.random.default_rng(11)
    k = np.arange(6000) / RATE
    parts = [
        ('idle', np.zeros(2000)),
        ('sine:1Hz', 5 - 5 * np.cos(2 * np.pi * k)),
        ('sine:50Hz', 5 + 5 * np.sin(2 * np.pi * 50 * k[:3000])),
        ('noise', 5 + lfilter([0.1], [1, -0.9], rng.standard_normal(3000))),
        ('staircase', np.repeat([2.0, 6.0, 9.0, 1.0], 1000)),
        ('triangle', 10 * np.abs((k[:2000] * 3) % 2 - 1)),
    ]
    segments, start = [], 0
    for label, v in parts:
        segments.append(Segment(label, start, start + v.size))
        start += v.size
    return np.concatenate([v for _, v in parts]), tuple(segments)


V, SEGMENTS = drive()
T = np.arange(V.size) / RATE
Y_HAT = 7e-6 * lfilter([0.3], [1, -0.7], V)


def noise(seed: int = 0) -> np.ndarray:
    """White noise of 2 nm rms."""
    return 2e-9 * np.random.default_rng(seed).standard_normal(V.size)


def pink(n: int, rng: np.random.Generator) -> np.ndarray:
    """1/f noise of unit standard deviation."""
    spectrum = np.fft.rfft(rng.standard_normal(n))
    k = np.maximum(np.arange(spectrum.size), 1)
    x = np.fft.irfft(spectrum / np.sqrt(k), n)
    return x / x.std()


def creep(v: np.ndarray, rate: float, *, gain: float = 1e-7) -> np.ndarray:
    """Three relaxations of v, `gain` metres a volt each."""
    total = np.zeros(v.size)
    for tau in (0.1, 1.0, 10.0):
        a = np.exp(-1 / (rate * tau))
        total += gain * lfilter([1 - a], [1, -a], v)
    return total


def misfit(v: np.ndarray) -> np.ndarray:
    """Return what a model may leave: odd and even harmonics of the drive, and a lag [m]."""
    return 1e-7 * (np.sin(v) + 0.02 * v**2) + 2e-8 * lfilter([0.003], [1, -0.997], v)


def part_of(e: np.ndarray, *, labelled: bool = True, record: str = 'r') -> ResidualPart:
    piece = Piece(V, Y_HAT + e, RATE, 0.0, SEGMENTS if labelled else ())
    return ResidualPart(record, piece, e)
