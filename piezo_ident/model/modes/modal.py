# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A linear stage of several axes in modal coordinates.

    x(k+1) = A x(k) + B u(k),    y(k) = C x(k) + D u(k)

A has the blocks [[a, b], [-b, a]] for poles a +- ib, and diag(a, b) for two real poles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError

#: largest distance of a pole from the origin after `to_modal`
RADIUS = 0.9999


@dataclass(frozen=True, eq=False)
class Modal:
    """
    A linear model in modal coordinates.

    Attributes
    ----------
    blocks : ndarray, shape (n / 2, 2, 2)
        Blocks of A in the order of the states.
    b, c, d : ndarray, shapes (n, inputs), (outputs, n), (outputs, inputs)
    """

    blocks: Array
    b: Array
    c: Array
    d: Array

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.b)

    @property
    def oscillates(self) -> NDArray[np.bool_]:
        """Which blocks hold a pair of complex poles."""
        return np.asarray(self.blocks[:, 0, 1] != 0)

    @property
    def a(self) -> Array:
        """A as one matrix."""
        a = np.zeros((self.order, self.order))
        for i, block in enumerate(self.blocks):
            a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
        return a

    @property
    def radius(self) -> float:
        """Distance of the outermost pole from the origin; a stable model has less than 1."""
        return float(np.abs(np.linalg.eigvals(self.blocks)).max())

    @property
    def gain(self) -> Array:
        """Gain at rest, shape (outputs, inputs)."""
        return np.asarray(self.response(np.ones(1, complex))[0].real)

    def resolvent(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Compute (z - A)^-1 block by block, shape (k, n / 2, 2, 2)."""
        a, b = self.blocks[:, 0, 0], self.blocks[:, 0, 1]
        c, d = self.blocks[:, 1, 0], self.blocks[:, 1, 1]
        zz = z[:, None]
        adjugate = np.empty((len(z), len(a), 2, 2), complex)
        adjugate[:, :, 0, 0] = zz - d
        adjugate[:, :, 0, 1] = b
        adjugate[:, :, 1, 0] = c
        adjugate[:, :, 1, 1] = zz - a
        return np.asarray(adjugate / ((zz - a) * (zz - d) - b * c)[:, :, None, None])

    def states(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Compute (z - A)^-1 B, shape (k, n, inputs)."""
        b = self.b.reshape(-1, 2, self.b.shape[1])
        return np.asarray(
            np.einsum('kbij,bjm->kbim', self.resolvent(z), b).reshape(len(z), self.order, -1)
        )

    def reach(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Compute C (z - A)^-1, shape (k, outputs, n)."""
        c = self.c.reshape(len(self.c), -1, 2)
        return np.asarray(
            np.einsum('pbi,kbij->kpbj', c, self.resolvent(z)).reshape(len(z), -1, self.order)
        )

    def response(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Compute C (z - A)^-1 B + D, shape (k, outputs, inputs)."""
        return np.asarray(self.c @ self.states(z) + self.d)


def narrowest(samples: int) -> float:
    """
    Compute the largest radius of a mode that a period resolves.

    A narrower resonance shows in one line at most, where it fits noise.
    """
    return float(np.exp(-np.pi / samples))


def resolved(blocks: Array, limit: float) -> Array:
    """Draw complex poles of blocks that lie beyond a distance from the origin in to it."""
    radius = np.hypot(blocks[:, 0, 0], blocks[:, 0, 1])
    beyond = (blocks[:, 0, 1] != 0) & (radius > limit)
    return blocks * np.where(beyond, limit / np.where(beyond, radius, 1), 1)[:, None, None]


def to_modal(a: Array, b: Array, c: Array, d: Array) -> Modal:
    """
    Bring a model into modal coordinates.

    Complex poles beyond `RADIUS` are mirrored at that circle; real poles are clipped to it.

    Raises
    ------
    ModelError
        If A has no basis of eigenvectors, or an odd number of real poles.
    """
    poles, vectors = np.linalg.eig(a)
    complexes = [i for i in np.argsort(np.angle(poles)) if poles[i].imag > 1e-12]
    reals = [i for i in np.argsort(-poles.real) if abs(poles[i].imag) <= 1e-12]
    if len(reals) % 2:
        raise ModelError(f'an order of {len(a)} is odd; take an even one')
    basis, blocks = [], []
    for i in complexes:
        basis += [vectors[:, i].real, vectors[:, i].imag]
        pole = complex(poles[i])
        if abs(pole) > RADIUS:
            pole *= (RADIUS / abs(pole)) ** 2
        blocks.append([[pole.real, pole.imag], [-pole.imag, pole.real]])
    values = np.clip([poles[i].real for i in reals], -RADIUS, RADIUS)
    basis += [vectors[:, i].real for i in reals]
    blocks += [[[v, 0.0], [0.0, w]] for v, w in zip(values[::2], values[1::2], strict=True)]
    t = np.array(basis).T
    try:
        return Modal(np.array(blocks, dtype=float), np.linalg.solve(t, b), c @ t, np.array(d))
    except np.linalg.LinAlgError as error:
        raise ModelError(f'the modes of an order of {len(a)} coincide; take another') from error


def balanced(model: Modal) -> Modal:
    """Scale the two states of each block so that B and C are of equal size there."""
    b = np.linalg.norm(model.b.reshape(-1, 2 * model.b.shape[1]), axis=1)
    c = np.sqrt((model.c**2).sum(axis=0).reshape(-1, 2).sum(axis=1))
    scale = np.repeat(np.sqrt(np.where((b > 0) & (c > 0), c, 1) / np.where(b > 0, b, 1)), 2)
    return Modal(model.blocks, model.b * scale[:, None], model.c / scale, model.d)
