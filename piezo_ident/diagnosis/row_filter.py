# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Filter through G, creep in front of G and a short delay, and compute means of rows only.

A fit mostly needs means of the output of G over rows of some samples.  The state of G therefore
steps from one group of rows to the next.  A product of matrices adds the contribution of the
samples in between.  This takes about half the time of a filter that computes every sample.  Such a
system is called lifted; see P. P. Khargonekar, K. Poolla and A. Tannenbaum, IEEE Trans.
Autom. Control 30(11), 1985, pp. 1088-1096, doi:10.1109/TAC.1985.1103841.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.sections import rounding_of
from scipy.linalg import block_diag

#: fewest samples in a row, and in a run, for which the row filter is quicker than G itself
LEAST_IN_ROW, LEAST_IN_RUN = 3, 100_000
#: approximate number of samples in a group of rows
IN_GROUP = 48
#: largest share of the output that eq. (5) may lose by rounding: powers of A lose far more
LOST = 1e-12


def group_of(m: int) -> int:
    """Return the number of rows in a group, for m samples in a row."""
    return max(1, IN_GROUP // m)


def serves(parts: Sequence[Dynamics | Array], m: int, samples: int) -> bool:
    """Return whether a row filter can run the filters in series, and is quicker."""
    own = [part for part in parts if isinstance(part, Dynamics)]
    is_quick = bool(own) and m >= LEAST_IN_ROW and samples >= LEAST_IN_RUN
    return is_quick and all(G.sections is not None or rounding_of(G.a) < LOST for G in own)


class _Form(NamedTuple):
    """
    State-space form ``s(k+1) = A s(k) + B w(k)`` and ``y(k) = C s(k) + D w(k)``.

    Under w = 1 the state at rest is `rest` and the output is `gain`.
    """

    A: Array
    B: Array
    C: Array
    D: float
    rest: Array
    gain: float


class RowFilter:
    """
    Means of the output of G over rows of m samples.

    Parameters
    ----------
    parts : sequence of Dynamics or of ndarray, shape (k, 5)
        Filters in series.  They stay apart because a single filter of the total order would lose
        digits.  An array holds b_0, b_1, b_2, a_1 and a_2 of filters whose outputs are added to
        the signal.
    m : int
        Samples in a row.

    Notes
    -----
    ``s(k+1) = A s(k) + B w(k)`` and ``y(k) = C s(k) + D w(k)`` are the parts in the transposed
    direct form.  Over a group of K samples ``s(k+K) = A^K s(k) + sum_i A^(K-1-i) B w(k+i)``.
    """

    def __init__(self, parts: Sequence[Dynamics | Array], m: int) -> None:
        self._forms = [form for part in parts for form in _forms_of(part)]
        A, B, C, D = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
        for own in self._forms:
            A = np.block([[A, np.zeros((B.size, own.B.size))], [np.outer(own.B, C), own.A]])
            B = np.append(B, own.B * D)
            C = np.concatenate([own.D * C, own.C])
            D *= own.D
        size = B.size
        self._m, self._group = m, group_of(m)
        length = self._group * m
        # rows of `outputs` and `direct`: each output from the state before the group, and from
        # each input
        after, of_inputs = np.eye(size), np.zeros((size, length))
        outputs, direct = np.empty((length, size)), np.zeros((length, length))
        for k in range(length):
            outputs[k], direct[k] = C @ after, C @ of_inputs
            direct[k, k] = D
            after, of_inputs = A @ after, A @ of_inputs
            of_inputs[:, k] = B
        means = np.kron(np.eye(self._group), np.full(m, 1.0 / m))
        #: effect of the inputs, and of the state before a group, on the next state and on the
        #: means
        self._of_inputs = np.concatenate([of_inputs, means @ direct]).T.copy()
        self._of_state = np.concatenate([after, means @ outputs]).T.copy()
        self._s = np.zeros(size)

    def reset(self, x: float) -> float:
        """Come to rest under x, and return the output."""
        states = []
        for form in self._forms:
            states.append(x * form.rest)
            x *= form.gain
        self._s = np.concatenate(states)
        return x

    def process(self, x: Array) -> Array:
        """
        Compute the means of the next rows; shape (n // m,).

        x holds whole groups of rows, unless it is the last part.  A value that is not finite
        spoils its group.
        """
        length = self._group * self._m
        rows, groups = x.size // self._m, -(-x.size // length)
        if groups * length > x.size:
            x = np.concatenate([x, np.zeros(groups * length - x.size)])
        added = x.reshape(groups, length) @ self._of_inputs
        out = np.empty((groups, self._group))
        _step(added, self._of_state, self._s, out)
        return out.ravel()[:rows]


def _forms_of(part: Dynamics | Array) -> list[_Form]:
    """Return the transposed direct form of a part, or the forms of its sections in series."""
    if not isinstance(part, Dynamics):
        return [_beside_the_signal([_direct(section[3:], section[:3]) for section in part])]
    if part.sections is not None:
        return [_direct(section[3:], section[:3]) for section in part.sections]
    n = max(part.a.size, part.b.size - 1, 1)
    a, b = np.zeros(n), np.zeros(n + 1)
    a[: part.a.size], b[: part.b.size] = part.a, part.b
    return [_direct(a, b)]


def _direct(a: Array, b: Array) -> _Form:
    """Return the form with coefficients a_1 .. a_n and b_0 .. b_n."""
    own = np.eye(a.size, k=1)
    own[:, 0] = -a
    gain = float(b.sum() / (1.0 + a.sum()))
    rest = np.cumsum((b[1:] - a * gain)[::-1])[::-1]
    return _Form(own, b[1:] - a * b[0], np.eye(1, a.size)[0], float(b[0]), rest, gain)


def _beside_the_signal(forms: Sequence[_Form]) -> _Form:
    """Return the form whose output is the signal plus the outputs of filters of the signal."""
    return _Form(
        block_diag(*(form.A for form in forms)),
        np.concatenate([form.B for form in forms]),
        np.concatenate([form.C for form in forms]),
        1.0 + sum(form.D for form in forms),
        np.concatenate([form.rest for form in forms]),
        1.0 + sum(form.gain for form in forms),
    )


@kernel
def _step(added: Array, of_state: Array, s: Array, out: Array) -> None:
    size, wide = s.size, of_state.shape[1]
    new = np.empty(wide)
    for group in range(added.shape[0]):
        row = added[group]
        for i in range(wide):
            new[i] = row[i]
        for j in range(size):
            of_this, x = of_state[j], s[j]
            for i in range(wide):
                new[i] += of_this[i] * x
        for i in range(size):
            s[i] = alive(new[i])
        for i in range(out.shape[1]):
            out[group, i] = new[size + i]
