# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Output error refinement of a modal model against a frequency response, and the choice of its order.

Poles, B, C and D are fitted together, with exact derivatives.  A step that would leave the unit
circle is refused, so a stable start stays stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.choice import simplest
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.damped import DampingSchedule, descend
from piezo_ident.fitting.modes.frequency_response import frequency_response, LineResponse
from piezo_ident.fitting.modes.periods import percent_of, PeriodicRecord
from piezo_ident.fitting.modes.subspace import subspace
from piezo_ident.model.modes.modal import Modal, narrowest, RADIUS, resolved
from piezo_ident.model.modes.shared_modes import SharedModes

#: a higher order has to lower the held-out error by this part of it
ORDER_GAIN = 0.02
#: every so many lines serve the choice of the order
THIN = 3
#: steps of each order that is tried
STEPS = 6
#: damping of the steps, and the end of a fit (taste)
SCHEDULE = DampingSchedule(1e-3, 1e-9, worse=6.0, better=6.0, tries=8, slow=3e-3, slow_steps=3)


def refined(model: Modal, response: LineResponse, *, iterations: int = 20) -> Modal:
    """
    Lower the error of a stable model's response, summed over lines, inputs and outputs.

    The error of each output counts relative to its own response.
    """
    z, scale, limit = response.z, response.size, narrowest(response.samples)

    def error(tried: Modal) -> NDArray[np.complex128]:
        return np.asarray((tried.response(z) - response.g) / scale)

    def cost(tried: Modal) -> float:
        stable = tried.radius < RADIUS
        return float(np.sum(np.abs(error(tried)) ** 2)) if stable else float('inf')

    def equations(now: Modal) -> tuple[Array, Array]:
        shape = (-1, *response.g.shape)
        columns = (_derivatives(now, z).reshape(shape) / scale).reshape(-1, response.g.size)
        both, flat = np.hstack([columns.real, columns.imag]), error(now).ravel()
        return both @ both.T, both @ np.concatenate([flat.real, flat.imag])

    def step(now: Modal, normal: tuple[Array, Array], damping: float) -> Modal:
        hessian, gradient = normal
        size = np.sqrt(np.diag(hessian)) + 1e-30
        damped = hessian / np.outer(size, size) + damping * np.eye(len(hessian))
        return _moved(now, -np.linalg.solve(damped, gradient / size) / size, limit)

    start = replace(model, blocks=resolved(model.blocks, limit))
    return descend(start, cost, equations, step, SCHEDULE, iterations)


def choose_order(
    records: Sequence[PeriodicRecord], held_out: Sequence[PeriodicRecord], *, orders: Sequence[int]
) -> tuple[Modal, dict[int, float]]:
    """
    Fit models of rising order, and choose by the error on records held out.

    Returns
    -------
    Modal
        The lowest order with an error within `ORDER_GAIN` of the least error.
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
            model = refined(subspace(thin, order), thin, iterations=STEPS)
        except IdentificationError:  # too few lines for any order from here on
            break
        found[order] = model
        modes = SharedModes.of(model)
        errors[order] = percent_of(held_out, [modes.steady(r.u[-1]) for r in held_out])
    if not found:
        raise IdentificationError(f'{len(response.lines)} lines determine none of {orders}')
    order = simplest(errors, errors.__getitem__, size=int, factor=1 + ORDER_GAIN)
    return refined(found[order], response, iterations=20), errors


def _derivatives(model: Modal, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return dG/dtheta for poles, B, C, D in this order, shape (parameters, k p m)."""
    states, reach = model.states(z), model.reach(z)
    lines, order, inputs = states.shape
    outputs = reach.shape[1]
    out = np.zeros((order, lines, outputs, inputs), complex)
    first, second = reach[:, :, ::2], reach[:, :, 1::2]
    for i, oscillates in enumerate(model.oscillates):
        r0, r1 = first[:, :, i, None], second[:, :, i, None]
        x0, x1 = states[:, 2 * i, None, :], states[:, 2 * i + 1, None, :]
        if oscillates:
            out[2 * i], out[2 * i + 1] = r0 * x0 + r1 * x1, r0 * x1 - r1 * x0
        else:
            out[2 * i], out[2 * i + 1] = r0 * x0, r1 * x1
    of_in, of_out, each = np.eye(inputs), np.eye(outputs), np.ones(lines)
    parts = (
        out,
        np.einsum('kpi,jm->ijkpm', reach, of_in),
        np.einsum('kim,op->oikpm', states, of_out),
        np.einsum('k,op,jm->ojkpm', each, of_out, of_in),
    )
    return np.concatenate([part.reshape(-1, lines * outputs * inputs) for part in parts])


def moved_blocks(blocks: Array, step: Array, limit: float) -> Array:
    """Return blocks with their two numbers each moved by `step`, shape (n,); modes stay within."""
    blocks = blocks.copy()
    first, second = step[::2], step[1::2]
    oscillates = blocks[:, 0, 1] != 0
    blocks[:, 0, 0] += first
    blocks[:, 1, 1] += np.where(oscillates, first, second)
    blocks[:, 0, 1] += np.where(oscillates, second, 0)
    blocks[:, 1, 0] -= np.where(oscillates, second, 0)
    return resolved(blocks, limit)


def _moved(model: Modal, step: Array, limit: float) -> Modal:
    parts, at = [], model.order
    for old in (model.b, model.c, model.d):
        parts.append(old + step[at : at + old.size].reshape(old.shape))
        at += old.size
    return Modal(moved_blocks(model.blocks, step[: model.order], limit), *parts)
