# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A simulated stage of two axes that pull at one another, softening and hysteretic or not."""

from dataclasses import replace

import numpy as np
from piezo_ident.fitting.modes.periods import PeriodicRecord
from piezo_ident.model.modes.modal import balanced, to_modal
from piezo_ident.model.modes.shared_modes import SharedModes
from scipy.linalg import expm

RATE, SAMPLES = 2000.0, 2048


def linear_stage():
    """Return two modes that both axes drive and show, each of a gain of 1 at rest."""
    shapes = np.array([[1.0, 0.5], [0.4, -0.8]])
    a, b, c = np.zeros((4, 4)), np.zeros((4, 2)), np.zeros((2, 4))
    for i, (frequency, damping) in enumerate(((190.0, 0.03), (310.0, 0.02))):
        w = 2 * np.pi * frequency
        part = expm(np.array([[0, 1, 0], [-w * w, -2 * damping * w, w * w], [0, 0, 0]]) / RATE)
        at = slice(2 * i, 2 * i + 2)
        a[at, at], b[at] = part[:2, :2], np.outer(part[:2, 2], shapes[:, i])
        c[:, 2 * i] = shapes[:, i]
    return balanced(to_modal(a, b, c, np.zeros((2, 2))))


def uncoupled_stage():
    """Return the same modes, each of one axis alone."""
    plain = linear_stage()
    b, c = plain.b.copy(), plain.c.copy()
    for mode in range(2):
        at = slice(2 * mode, 2 * mode + 2)
        b[at, 1 - mode] = 0
        c[1 - mode, at] = 0
    return replace(plain, b=b, c=c)


def loop_stage(*, softening=0.04, plays=0.08):
    """Return a stage whose first two signals soften and whose others are hysteretic."""
    linear = linear_stage()
    # the extension of each actuator, of rms 1 under voltages of rms 1
    gain = np.linalg.inv(linear.response(np.ones(1, complex))[0].real)
    size = np.array([2.7, 3.9])
    f, g = (gain @ x / size[:, None] for x in (linear.c, linear.d))
    e, h = np.hstack([linear.b] * 2), np.hstack([linear.d] * 2)
    pushes = np.concatenate([softening * size, plays * size])
    return replace(
        SharedModes.of(linear),
        e=e * pushes,
        h=h * pushes,
        f=np.vstack([f, f]),
        g=np.vstack([g, g]),
        levels=2,
        mu=np.array([[0.0, 0.0]] * 2 + [[0.4, 0.6]] * 2),
        r=np.array([0.4, 1.0]),
        memory=100.0,
    )


def modes(a):
    """Return the frequencies in Hz and damping ratios of the modes of A, slowest first."""
    poles = np.linalg.eigvals(a)
    s = np.log(poles[poles.imag > 1e-9]) * RATE
    s = s[np.argsort(np.abs(s))]
    return np.abs(s) / (2 * np.pi), -s.real / np.abs(s)


def multisine(rng, amplitude, count=2):
    """Return voltages of rms `amplitude` up to 0.4 of the rate, shape (samples, count)."""
    lines = np.zeros((SAMPLES // 2 + 1, count), complex)
    last = int(0.4 * SAMPLES)
    lines[1:last] = np.exp(2j * np.pi * rng.random((last - 1, count)))
    u = np.fft.irfft(lines, SAMPLES, axis=0)
    return amplitude * u / u.std(axis=0)


def record(model, rng, amplitude, name='record', *, noise=0.0, periods=2):
    u = multisine(rng, amplitude)
    y = model.steady(u) if isinstance(model, SharedModes) else answer(model, u)
    y = np.array([y] * periods)
    y += noise * y.std() * rng.standard_normal(y.shape)
    return PeriodicRecord(name, f'{amplitude:g}', RATE, np.array([u] * periods), y)


def error(model, record):
    """Return the error of a model over the last period of a record, in steady state."""
    return record.error(model.steady(record.u[-1]))


def percent(model, records):
    """Return 100 rms(y - y_hat) / rms(y) over records."""
    errors = [np.linalg.norm(error(model, r)) / np.linalg.norm(r.y[-1]) for r in records]
    return 100 * float(np.sqrt(np.mean(np.square(errors))))


def answer(linear, u):
    z = np.exp(2j * np.pi * np.arange(SAMPLES // 2 + 1) / SAMPLES)
    lines = np.einsum('kpm,km->kp', linear.response(z), np.fft.rfft(u, axis=0))
    return np.fft.irfft(lines, SAMPLES, axis=0)


def records(model, rng, amplitudes=(0.5, 1.0, 1.5), count=4, noise=0.0):
    return [
        record(model, rng, amplitude, f'{amplitude:g}/{i}', noise=noise)
        for amplitude in amplitudes
        for i in range(count)
    ]
