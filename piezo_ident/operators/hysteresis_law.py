# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Families (laws) of H that are linear in their coefficients, for fixed thresholds.

- ``plays``: q_i F_i, v^3 and v, the law of the paper, eqs. (3) and (6).
- ``square``: plays, and v^2.
- ``bias``: square, hat_j(r_i) (v - low) (F_i - low), and hat_j(r_i) (high - v) (F_i - low).
- ``preisach``: square, and hat_j(r_i) times Bernstein polynomials in F_i as densities.
- ``duhem``: preisach, and lags of v, v^2 and v^3 along the path of v, at a few rates.
- ``any``: all of these terms, from which the terms of each law can be selected.

hat_j are piecewise linear functions of the threshold on a few even nodes.  All coefficients are >=
0, except for lags and powers of v.  Every play therefore keeps a weight >= 0 wherever it stands.
`preisach` is a Preisach operator.  Its density is q_i plus cubic polynomials in the play output:
Brokate and Sprekels, "Hysteresis and Phase Transitions", 1996, sections 2.3 to 2.5,
doi:10.1007/978-1-4612-4048-8.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import functools
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, frozen_array, Integers, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.operators.hysteresis import Hysteresis, POWERS
from piezo_ident.operators.parts import columns_of_parts
from piezo_ident.operators.play import initial_memory
from scipy.optimize import lsq_linear

LawName = Literal['plays', 'square', 'bias', 'preisach', 'duhem', 'any']
#: laws that a stage may have, from the narrowest to the widest
LAWS: tuple[LawName, ...] = ('plays', 'square', 'bias', 'preisach', 'duhem')
#: number of nodes of the hats over the threshold, and degree of the density over the play output
NODES, DEGREE = 5, 3
#: rates of the lags along the path, per span of the voltage
RATES = (1.0, 2.0, 4.0, 8.0, 16.0)


@dataclass(frozen=True, eq=False)
class HysteresisLaw:
    """
    Family of H that is linear in its coefficients; ModelError for an unknown name.

    The thresholds, shape (m,), are above zero and ascending.  The law holds for voltages in the
    span (`Hysteresis.span`).  Both are normalised.

    >>> law = HysteresisLaw('square', [0.25, 0.5])
    >>> law.size, law.lower.tolist()
    (5, [0.0, 0.0, -inf, -inf, -inf])
    >>> law.hysteresis([0.2, 0.1, -0.05, 0.0, 1.0]).p0
    -0.05
    """

    name: LawName
    thresholds: Array
    span: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        if self.name not in (*LAWS, 'any'):
            raise ModelError(f'hysteresis: unknown law {self.name!r}; known are {", ".join(LAWS)}')
        object.__setattr__(self, 'thresholds', frozen_array(self.thresholds))

    @property
    def densities(self) -> int:
        """Number of leading coefficients, which are >= 0; lags and powers follow them."""
        return self.size - (2 if self.name == 'plays' else 3) - self.lags

    @property
    def lags(self) -> int:
        """Number of coefficients of lags along the path."""
        return 3 * len(RATES) if self.name in ('duhem', 'any') else 0

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return int(self._parameters.shape[0])

    @property
    def lower(self) -> Array:
        """Lower bounds of the coefficients, shape (size,)."""
        return np.where(np.arange(self.size) < self.densities, 0.0, -np.inf)

    def roughness(self, density: float, change: float) -> Array:
        """
        Compute the rows of a penalty on the roughness of H, dimensionless; shape (k, size).

        The rows divide q_i by `density` times the gap below r_i.  They divide other densities, and
        differences between neighbouring coefficients of one polynomial, by `change`.
        """
        m, n = self.thresholds.size, self.densities
        sizes = np.eye(n, self.size) / change
        gaps = np.maximum(np.diff(self.thresholds, prepend=0.0), 1e-12)
        sizes[:m] *= (change / density / gaps)[:, None]
        width = 2 if self.name == 'bias' else DEGREE + 1
        differences = [
            (np.eye(self.size)[j + 1] - np.eye(self.size)[j]) / change
            for j in range(m, n - 1)
            if (j - m) % width < width - 1
        ]
        return np.vstack([sizes, *differences])

    @functools.cached_property
    def _parameters(self) -> Array:
        """
        Parameters of H for each coefficient alone, shape (size, 5 m + 3 + lags).

        The columns are q, c_1 .. c_3 and kappa of every play, then p0, p1 and p2, then d_1 .. d_3
        of every rate.
        """
        m = self.thresholds.size
        plays = np.zeros((m, POWERS + 2, m))
        plays[:, 0] = np.eye(m)
        more: list[Array] = []
        low, high = self.span
        for hat in self._hats() if self.name in ('bias', 'any') else ():
            for q, kappa in ((0.0, 1.0 / (high - low)), (1.0, -1.0 / (high - low))):
                part = np.zeros((POWERS + 2, m))
                part[0], part[-1] = q * hat, kappa * hat
                more.append(part)
        for hat in self._hats() if self.name in ('preisach', 'duhem', 'any') else ():
            width = np.maximum(high - low - self.thresholds, 0.0)
            for density in _bernstein():
                part = np.zeros((POWERS + 2, m))
                for power, b in enumerate(density):
                    scale = (power + 1) * np.where(width > 0.0, width, np.inf) ** power
                    part[power] = b * hat / scale
                more.append(part)
        rows = np.concatenate([plays, np.array(more).reshape(-1, POWERS + 2, m)])
        powers = np.eye(3)[1 if self.name == 'plays' else 0 :]
        n, k = rows.shape[0], self.lags
        whole = np.zeros((n + k + powers.shape[0], rows[0].size + 3 + k))
        whole[:n, : rows[0].size] = rows.reshape(n, -1)
        whole[n : n + k, rows[0].size + 3 :] = np.eye(k)
        whole[n + k :, rows[0].size : rows[0].size + 3] = powers
        return whole

    def _hats(self) -> Iterator[Array]:
        """Yield piecewise linear functions of the threshold as shares of a density; shape (m,)."""
        r = self.thresholds
        if not r.size:
            yield from [r] * NODES
            return
        middles = 0.5 * (r[1:] + r[:-1])
        width = np.diff(np.concatenate([[0.0], middles, [r[-1]]]))
        nodes = np.linspace(0.0, r[-1], NODES)
        for j in range(NODES):
            yield width * np.interp(r, nodes, np.eye(NODES)[j])

    def hysteresis(self, coefficients: ArrayLike) -> Hysteresis:
        """Make the H of coefficients, shape (size,); values below their bound are set to it."""
        theta = np.maximum(np.asarray(coefficients, dtype=np.float64), self.lower)
        has_curves = self.name in ('preisach', 'duhem', 'any')
        return self._of(theta @ self._parameters, has_curves, self.name in ('bias', 'any'))

    def _of(
        self, row: Array, has_curves: bool, has_bias: bool, plays: Mask | None = None
    ) -> Hysteresis:
        """Make the H of a row of parameters; `plays` drops other plays, and lags of zero."""
        n = (POWERS + 2) * self.thresholds.size
        x, (p0, p1, p2) = row[:n].reshape(POWERS + 2, -1), row[n : n + 3].tolist()
        lags = row[n + 3 :].reshape(-1, 3)
        rates = np.array(RATES[: len(lags)]) / (self.span[1] - self.span[0])
        relaxations = np.column_stack([rates, lags])
        r = self.thresholds
        if plays is not None:
            r, x, relaxations = r[plays], x[:, plays], relaxations[lags.any(axis=1)]
        curves, bias = x[1:-1].T if has_curves else None, x[-1] if has_bias else None
        lagging = relaxations if relaxations.size else None
        return Hysteresis(r, x[0], p1, p2, p0, curves, bias, self.span, lagging)

    def deviations(self, covariance: Array) -> Array:
        """Compute the standard deviations of q_i, p1 and p2 from a covariance, shape (m + 2,)."""
        m = self.thresholds.size
        n = (POWERS + 2) * m
        chosen = [*range(m), n + 1, n + 2]
        T = self._parameters[:, chosen]
        variance = np.sum(T * (covariance @ T), axis=0)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def parts(self, places: Sequence[int]) -> Iterator[tuple[Hysteresis, Mask]]:
        """Yield the H of each coefficient at `places` alone, and a mask of its thresholds."""
        return (self._parts[place] for place in places)

    @functools.cached_property
    def _parts(self) -> tuple[tuple[Hysteresis, Mask], ...]:
        m, parts = self.thresholds.size, []
        for row in self._parameters:
            x = row[: (POWERS + 2) * m].reshape(POWERS + 2, m)
            moved = x.any(axis=0)
            parts.append((self._of(row, bool(x[1:-1].any()), bool(x[-1].any()), moved), moved))
        return tuple(parts)

    @functools.cached_property
    def slopes(self) -> Array:
        """
        Contribution of each coefficient to the slopes of H, sweeps included; shape (k, size).

        H rises if ``slopes @ coefficients`` is positive.  The slopes of `bias` are not linear in
        the coefficients.
        """
        return np.column_stack([part.slopes(sweeps=True)[1] for part, _ in self._parts])

    def columns(
        self, v: Array, memory: ArrayLike | None = None, places: Sequence[int] | None = None
    ) -> Iterator[Array]:
        """
        Yield the contribution to H of each coefficient under a normalised v; shapes (n,).

        The memory, shape (m,), holds the play outputs before the first sample; by default the
        stage last came down to zero.  `places` selects coefficients, by default all.
        """
        start = initial_memory(float(v[0]), self.thresholds) if memory is None else memory
        start = np.asarray(start, dtype=np.float64)
        places = range(self.size) if places is None else places
        return columns_of_parts(v, ((part, start[own]) for part, own in self.parts(places)))

    def within(self, wider: HysteresisLaw) -> Integers:
        """
        Find the places of the coefficients among the coefficients of a wider law, shape (size,).

        The wider law has the same thresholds.  `duhem` holds all coefficients except those of
        `bias`.
        """
        m, n = self.thresholds.size, wider.densities
        middle = n - NODES * (DEGREE + 1)
        inner = {'bias': (m, middle), 'preisach': (middle, n), 'duhem': (middle, n)}
        start, stop = inner.get(self.name, (m, n if self.name == 'any' else m))
        powers = range(wider.size - (2 if self.name == 'plays' else 3), wider.size)
        lags = range(n, n + self.lags)
        return np.array([*range(m), *range(start, stop), *lags, *powers])

    def coefficients(self, hysteresis: Hysteresis) -> Array:
        """Compute the coefficients of an H, shape (size,); ModelError for another family."""
        h, m = hysteresis, self.thresholds.size
        if not np.array_equal(h.thresholds, self.thresholds):
            raise ModelError(
                f'hysteresis: the {h.thresholds.size} thresholds of H are not the {m} of the law; '
                'make the law from the thresholds of H'
            )
        plays = np.zeros((POWERS + 2, m))
        plays[0] = h.weights
        if h.curves is not None:
            plays[1 : 1 + h.curves.shape[1]] = h.curves.T
        if h.bias is not None:
            plays[-1] = h.bias
        lags = np.zeros(self.lags)
        if h.relaxations is not None:
            rates = np.array(RATES) / (self.span[1] - self.span[0])
            if not self.lags or not np.array_equal(h.relaxations[:, 0], rates):
                raise ModelError(f'hysteresis: this H does not belong to the law {self.name!r}')
            lags = h.relaxations[:, 1:].ravel()
        wanted = np.concatenate([plays.ravel(), [h.p0, h.p1, h.p2], lags])
        theta = np.zeros(self.size)
        theta[:m], theta[-2:] = h.weights, (h.p1, h.p2)
        theta[self.densities : self.densities + self.lags] = lags
        if self.name != 'plays':
            theta[-3] = h.p0
        if plays[1:].any():
            theta = lsq_linear(self._parameters.T, wanted, (self.lower, np.inf), method='bvls').x
        if not np.allclose(theta @ self._parameters, wanted, rtol=1e-6, atol=1e-9):
            raise ModelError(f'hysteresis: this H does not belong to the law {self.name!r}')
        return theta


def _bernstein() -> Iterator[Array]:
    """Yield the coefficients of 1, s, s^2, ... of each Bernstein polynomial on 0 .. 1."""
    for j in range(DEGREE + 1):
        b = np.zeros(DEGREE + 1)
        for power in range(j, DEGREE + 1):
            b[power] = comb(DEGREE, j) * comb(DEGREE - j, power - j) * (-1.0) ** (power - j)
        yield b
