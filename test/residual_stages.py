# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Residuals of a stage that is no sum of plays: a Duhem loop fitted by plays."""

import numpy as np
from piezo_ident.operators.play import play_columns

RATE = 2000.0


def duhem(u: np.ndarray, rate: float = 4.0) -> np.ndarray:
    """Dh = rate |du| (f(u) - h) + 0.35 du with a bent f: no Preisach operator."""
    h, out = 0.0, np.zeros(u.size)
    target = 0.5 * u + 0.12 * np.tanh(3 * (u - 0.5))
    du = np.diff(u, prepend=u[0])
    for k, (step, f) in enumerate(zip(du.tolist(), target.tolist(), strict=True)):
        h += (f - h) * -np.expm1(-rate * abs(step)) + 0.35 * step
        out[k] = h
    return 0.3 * u + out


def foreign(v: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return displacement and what ten plays make of it, in strokes, with a noise of 3e-5."""
    u = v / 10.0
    y = duhem(u)
    X = np.column_stack([*play_columns(u, np.arange(10) / 10), np.ones(u.size)])
    y_hat = X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]
    return (y + 3e-5 * rng.standard_normal(y.size)) / np.ptp(y), y_hat / np.ptp(y)


def drives(seconds: float = 8.0) -> dict[str, np.ndarray]:
    """Drives [V] with periods of no whole number of samples, and without any."""
    t = np.arange(round(seconds * RATE)) / RATE
    rng = np.random.default_rng(1)
    frequency = np.arange(0.5, 40.0, 1.0)
    tones = np.cos(2 * np.pi * np.outer(t, frequency) + rng.uniform(0, 6.28, frequency.size))
    multisine = tones.sum(axis=1)
    steps = np.repeat(rng.uniform(0, 10, t.size // 500), 500)
    return {
        'sines': 5 - 5 * np.cos(2 * np.pi * np.where(t < seconds / 2, 1.37, 13.7) * t),
        'triangle': 10 * np.abs((6.13 * t) % 1 * 2 - 1) * np.minimum(1.0, 0.2 + t / seconds),
        'multisine': 5 + 4.8 * multisine / np.abs(multisine).max(),
        'chirp': 5 - 5 * np.cos(2 * np.pi * (1 + 3 * t) * t),
        'steps': np.convolve(np.append(np.zeros(20), steps), np.ones(20) / 20, 'same')[: t.size],
    }
