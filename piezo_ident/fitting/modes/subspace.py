# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A modal model from a frequency response, without a start: subspace of the frequency domain.

The method is from McKelvey, Akcay and Ljung (1996), doi:10.1109/9.508900.  The span of the
inputs is projected off the response at the lines.  The rest spans the observability matrix of the
stage.  A shifts this matrix by one row.  B, C and D follow by least squares, in turns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.modes.frequency_response import LineResponse
from piezo_ident.model.modes.modal import balanced, Modal, to_modal

#: rows of blocks in the observability matrix, at most
ROWS = 120
#: turns of B and C
TURNS = 3


def subspace(response: LineResponse, order: int) -> Modal:
    """
    Identify a stable modal model of an even order.

    Raises
    ------
    IdentificationError
        Where the response has too few lines for the order.
    """
    outputs, inputs = response.g.shape[1:]
    # an output of a short stroke counts as much as one of a long one
    size = response.size
    response = replace(response, g=response.g / size)
    rows = min(ROWS, len(response.lines) // (2 * max(inputs, outputs)))
    if order % 2 or not 0 < order < (rows - 1) * outputs:
        raise IdentificationError(
            f'order {order} is odd, or too high for a response of {len(response.lines)} lines'
        )
    observability = _observability(response, rows)[:, :order]
    shifted = np.linalg.lstsq(observability[:-outputs], observability[outputs:], rcond=None)[0]
    a = np.asarray(shifted, dtype=np.float64)
    nothing = np.zeros((order, inputs)), np.zeros((outputs, inputs))
    model = to_modal(a, nothing[0], observability[:outputs], nothing[1])
    for _ in range(TURNS):
        model = _with_c(_with_b(model, response), response)
    return balanced(replace(model, c=size * model.c, d=size * model.d))


def _observability(response: LineResponse, rows: int) -> Array:
    """Return an orthonormal basis of the span of G off the span of the inputs, strongest first."""
    inputs = response.g.shape[2]
    powers = response.z[None, :] ** np.arange(rows)[:, None]
    spans = []
    for x in (np.broadcast_to(np.eye(inputs), (len(powers.T), inputs, inputs)), response.g):
        block = powers[:, None, :, None] * x.transpose(1, 0, 2)[None]
        block = block.reshape(rows * x.shape[1], -1)
        spans.append(np.hstack([block.real, block.imag]))
    by_inputs, by_outputs = spans
    gram = by_inputs @ by_inputs.T
    # orthogonal but for rounding: lines may lie close to one another
    gram += 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram))
    mixed = by_outputs @ by_inputs.T
    left = by_outputs @ by_outputs.T - mixed @ np.linalg.solve(gram, mixed.T)
    return np.asarray(np.linalg.eigh((left + left.T) / 2)[1][:, ::-1])


def _least_squares(columns: NDArray[np.complex128], values: NDArray[np.complex128]) -> Array:
    return np.asarray(
        np.linalg.lstsq(
            np.vstack([columns.real, columns.imag]),
            np.vstack([values.real, values.imag]),
            rcond=None,
        )[0]
    )


def _with_b(model: Modal, response: LineResponse) -> Modal:
    reach = model.reach(response.z)
    outputs = len(model.c)
    direct = np.broadcast_to(np.eye(outputs), (len(reach), outputs, outputs))
    columns = np.concatenate([reach, direct], axis=2).reshape(-1, model.order + outputs)
    found = _least_squares(columns, response.g.reshape(-1, response.g.shape[2]))
    order = model.order
    return balanced(Modal(model.blocks, found[:order], model.c, found[order:]))


def _with_c(model: Modal, response: LineResponse) -> Modal:
    states = model.states(response.z)
    inputs = model.b.shape[1]
    direct = np.broadcast_to(np.eye(inputs), (len(states), inputs, inputs))
    columns = np.concatenate([states, direct], axis=1).transpose(0, 2, 1)
    columns = columns.reshape(-1, model.order + inputs)
    values = response.g.transpose(0, 2, 1).reshape(-1, response.g.shape[1])
    found = _least_squares(columns, values).T
    order = model.order
    return balanced(Modal(model.blocks, model.b, found[:, :order], found[:, order:]))
