# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Output error refinement of a modal model against a frequency response, and the choice of its order.

Levenberg-Marquardt on poles, B, C and D together, with exact derivatives; a step that would leave
the unit circle is refused, so a stable start stays stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.frequency_response import frequency_response, LineResponse
from piezo_ident.axes.modal import Modal, narrowest, RADIUS, resolved
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.axes.subspace import subspace
from piezo_ident.common.errors import IdentificationError

#: a higher order has to lower the held-out error by this part of it
WORTH = 0.02
#: every so many lines serve the choice of the order
THIN = 3
#: steps of each order that is tried
STEPS = 6


def linear_fit(response: LineResponse, order: int, *, iterations: int) -> Modal:
    """Identify a stable modal model of a frequency response."""
    return refined(subspace(response, order), response, iterations=iterations)


def refined(model: Modal, response: LineResponse, *, iterations: int = 20) -> Modal:
    """
    Lower the error of a stable model's response, summed over lines, inputs and outputs.

    That of each output counts in parts of its own response, whatever its stroke.
    """
    z, scale = response.z, response.size
    limit = narrowest(response.samples)
    model = replace(model, blocks=resolved(model.blocks, limit))
    error = (model.response(z) - response.g) / scale
    cost, damping, slow = float(np.sum(np.abs(error) ** 2)), 1e-3, 0
    for _ in range(iterations):
        shape = (-1, *response.g.shape)
        columns = (_derivatives(model, z).reshape(shape) / scale).reshape(-1, response.g.size)
        hessian = columns.real @ columns.real.T + columns.imag @ columns.imag.T
        flat = error.ravel()
        gradient = columns.real @ flat.real + columns.imag @ flat.imag
        size = np.sqrt(np.diag(hessian)) + 1e-30
        hessian /= np.outer(size, size)
        before = cost
        for _ in range(8):
            damped = hessian + damping * np.eye(len(hessian))
            step = -np.linalg.solve(damped, gradient / size) / size
            tried = _moved(model, step, limit)
            if tried.radius < RADIUS:
                error_tried = (tried.response(z) - response.g) / scale
                cost_tried = float(np.sum(np.abs(error_tried) ** 2))
                if cost_tried < cost:
                    model, error, cost = tried, error_tried, cost_tried
                    break
            damping *= 5
        else:
            break
        damping /= 5
        slow = slow + 1 if before - cost < 1e-3 * before else 0
        if slow == 2:
            break
    return model


def linear_error(model: Modal, record: PeriodicRecord) -> float:
    """
    Return 100 rms(y - yhat) / rms(y) of a linear model over the last period, settled.

    Quadratic mean over the outputs.
    """
    samples = record.u.shape[1]
    u = np.fft.rfft(record.u[-1], axis=0)
    response = model.response(np.exp(2j * np.pi * np.arange(len(u)) / samples))
    answer = np.einsum('kpm,km->kp', response, u)
    error = record.error(np.fft.irfft(answer, samples, axis=0))
    shares = np.nanmean(error**2, axis=0) / np.mean(record.y[-1] ** 2, axis=0)
    return 100 * float(np.sqrt(np.mean(shares)))


def choose_order(
    records: Sequence[PeriodicRecord], held_out: Sequence[PeriodicRecord], *, orders: Sequence[int]
) -> tuple[Modal, dict[int, float]]:
    """
    Fit models of rising order, and choose by the error on records held out.

    Returns
    -------
    Modal
        Of the lowest order whose error another order does not beat by more than `WORTH`.
    dict
        Error in % of each order that was tried.
    """
    response = frequency_response(records)
    # neighbours say nearly the same: enough for the choice
    thin = replace(response, lines=response.lines[::THIN], g=response.g[::THIN])
    found: dict[int, Modal] = {}
    errors: dict[int, float] = {}
    for order in orders:
        try:
            model = linear_fit(thin, order, iterations=STEPS)
        except IdentificationError:  # too few lines for any order from here on
            break
        found[order] = model
        errors[order] = float(
            np.sqrt(np.mean([linear_error(model, record) ** 2 for record in held_out]))
        )
    if not found:
        raise IdentificationError(f'{len(response.lines)} lines determine none of {orders}')
    best = min(errors.values())
    order = min(o for o, e in errors.items() if e <= best * (1 + WORTH))
    return refined(found[order], response, iterations=20), errors


def _derivatives(model: Modal, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return dG/dtheta for poles, B, C, D in this order, shape (parameters, k p m)."""
    states, reach = model.states(z), model.reach(z)
    lines, order, inputs = states.shape
    outputs = reach.shape[1]
    total = order + order * inputs + outputs * order + outputs * inputs
    out = np.zeros((total, lines, outputs, inputs), complex)
    first, second = reach[:, :, ::2], reach[:, :, 1::2]
    for i, oscillates in enumerate(model.oscillates):
        r0, r1 = first[:, :, i, None], second[:, :, i, None]
        x0, x1 = states[:, 2 * i, None, :], states[:, 2 * i + 1, None, :]
        if oscillates:
            out[2 * i], out[2 * i + 1] = r0 * x0 + r1 * x1, r0 * x1 - r1 * x0
        else:
            out[2 * i], out[2 * i + 1] = r0 * x0, r1 * x1
    at = order
    for i in range(order):
        for j in range(inputs):
            out[at, :, :, j] = reach[:, :, i]
            at += 1
    for o in range(outputs):
        for i in range(order):
            out[at, :, o, :] = states[:, i]
            at += 1
    for o in range(outputs):
        for j in range(inputs):
            out[at, :, o, j] = 1
            at += 1
    return out.reshape(total, -1)


def moved_blocks(
    blocks: NDArray[np.float64], step: NDArray[np.float64], limit: float
) -> NDArray[np.float64]:
    """Return blocks with their two numbers each moved by `step`, shape (n,); modes stay within."""
    blocks = blocks.copy()
    first, second = step[::2], step[1::2]
    oscillates = blocks[:, 0, 1] != 0
    blocks[:, 0, 0] += first
    blocks[:, 1, 1] += np.where(oscillates, first, second)
    blocks[:, 0, 1] += np.where(oscillates, second, 0)
    blocks[:, 1, 0] -= np.where(oscillates, second, 0)
    return resolved(blocks, limit)


def _moved(model: Modal, step: NDArray[np.float64], limit: float) -> Modal:
    parts, at = [], model.order
    for old in (model.b, model.c, model.d):
        parts.append(old + step[at : at + old.size].reshape(old.shape))
        at += old.size
    return Modal(moved_blocks(model.blocks, step[: model.order], limit), *parts)
