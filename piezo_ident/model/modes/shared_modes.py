# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Modes that several axes share, with creep, softening and hysteresis inside their loop.

The voltages about `v0` creep as those of a chain do, see `piezo_ident.effects.creep`:

    u_j = v_j - v0_j + sum_i c_ji l_ji,      l_ji follows v_j - v0_j with the time constant T_i

The state x follows u:

    x(k+1) = A x(k) + B u(k) + E p(k)

The displacements y about `y0` are

    y(k) = C x(k) + D u(k) + H p(k)

Signals z mix motion and voltage.  The extension of an actuator is an example.

    z(k) = F x(k) + G u(k)

Each signal z_j makes a push p_j.  The first `levels` signals soften:

    p_j = z_j (s - 1)

The level s is the rms of these signals, with the time constant `memory`.  It is 1 on average over
the records of the fit.  The other signals are hysteretic.  Their p_j is a sum of plays, and all
signals share a few thresholds.

A push acts on the stage as one more voltage.  It changes stiffness, damping and gain with the
motion.  With F = 0 the plays lie in front of the mechanics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, real_array
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.model.modes.kernels import Loop, LoopState, Passage, trajectory
from piezo_ident.model.modes.modal import Modal

#: share of the slowest mode that is left when a run begins at rest (taste)
SETTLED = 1e-3
#: largest number of samples for it (taste: a second at the fastest rates)
SETTLING = 20_000


@dataclass(frozen=True, eq=False)
class SharedModes:
    """
    The equations of the module with their numbers.

    Attributes
    ----------
    linear : Modal
        A, B, C, D: the stage at the level s = 1 without its plays.
    e, h, f, g : ndarray, shapes (n, q), (outputs, q), (q, n), (q, inputs)
        Matrices of the q signals: e and h apply their pushes, f and g form them.
    levels : int
        Number of signals that soften; they come first.
    mu : ndarray, shape (q, thresholds)
        Weights of the plays, zero for signals that soften.
    r : ndarray, shape (thresholds,)
        Thresholds in units of z.
    memory : float
        Time constant of the level [samples].
    range : tuple of float
        Lowest and highest level s that changes the softening.
    v0, y0 : ndarray, shapes (inputs,) and (outputs,)
        Voltages [V] and displacements [m] about which the equations hold.
    creep : ndarray, shape (inputs, m)
        Shares c_ji of the elements of creep.
    taus : ndarray, shape (m,)
        Their time constants T_i [samples].
    """

    linear: Modal
    e: Array
    h: Array
    f: Array
    g: Array
    levels: int
    mu: Array
    r: Array
    memory: float
    range: tuple[float, float]
    v0: Array
    y0: Array
    creep: Array
    taus: Array

    @classmethod
    def of(cls, linear: Modal) -> SharedModes:
        """Make shared modes without signals, about zero."""
        order, (outputs, inputs) = linear.order, linear.d.shape
        return cls(
            linear,
            e=np.zeros((order, 0)),
            h=np.zeros((outputs, 0)),
            f=np.zeros((0, order)),
            g=np.zeros((0, inputs)),
            levels=0,
            mu=np.zeros((0, 1)),
            r=np.ones(1),
            memory=300.0,
            range=(0.3, 2.0),
            v0=np.zeros(inputs),
            y0=np.zeros(outputs),
            creep=np.zeros((inputs, 0)),
            taus=np.zeros(0),
        )

    @property
    def signals(self) -> int:
        """Number of signals z."""
        return len(self.f)

    def grown(self, shares: Array, zeros: Array) -> SharedModes:
        """Increase the gain of each output by a share, about zeros [m]."""
        by = 1.0 + shares
        linear = replace(self.linear, c=by[:, None] * self.linear.c, d=by[:, None] * self.linear.d)
        return replace(
            self, linear=linear, h=by[:, None] * self.h, y0=zeros + by * (self.y0 - zeros)
        )

    @property
    def creep_told(self) -> str:
        """Creep of each axis in words that follow others; empty without creep."""
        shares = ' and '.join(f'{100 * x:.2g}' for x in self.creep.sum(axis=1))
        return f', with creep of {shares} % of the voltages' if self.taus.size else ''

    def creep_of(self, axis: int) -> tuple[Array, Array]:
        """List shares and time constants [samples] of the creep of an axis, by its place."""
        seen = self.creep[axis] != 0.0
        return self.creep[axis][seen], self.taus[seen]

    @property
    def loop(self) -> Loop:
        """Arrays and numbers for the compiled loops."""
        one, (low, high), kept = self.linear, self.range, math.exp(-1 / self.memory)
        arrays = one.blocks, one.b, one.c, one.d, self.e, self.h, self.f, self.g, self.mu, self.r
        blocks, b, c, d, e, h, f, g, mu, r = map(np.ascontiguousarray, arrays)
        creep, share = np.ascontiguousarray(self.creep), -np.expm1(-1 / self.taus)
        return Loop(blocks, b, c, d, e, h, f, g, mu, r, self.levels, low, high, kept, creep, share)

    def a_at(self, s: float) -> Array:
        """Compute A at a level s, the plays at rest."""
        soft = slice(0, self.levels)
        s = float(np.clip(s, *self.range))
        return np.asarray(self.linear.a + (s - 1) * self.e[:, soft] @ self.f[soft])

    @property
    def radius(self) -> float:
        """Outermost pole over the range of levels, the plays at rest; below 1 it is stable."""
        levels = (self.range[0], 1.0, self.range[1]) if self.levels else (1.0,)
        return max(float(np.abs(np.linalg.eigvals(self.a_at(s))).max()) for s in levels)

    def check_inputs(self, v: Array) -> None:
        """Refuse voltages of another shape than (n, inputs) with a DataError."""
        inputs = self.linear.b.shape[1]
        if v.ndim != 2 or v.shape[1] != inputs:
            raise DataError(
                f'voltages of shape {v.shape} do not fit {inputs} inputs; give (samples, inputs)'
            )

    def simulate(self, v: ArrayLike) -> Array:
        """
        Simulate the displacements under voltages in free run, from rest under the first sample.

        Parameters
        ----------
        v : array_like, shape (n, inputs)
            [V]

        Returns
        -------
        ndarray, shape (n, outputs)
            [m]

        Raises
        ------
        ModelError
            When the displacements grow without bound.
        """
        from piezo_ident.model.modes.stream import ModesStream

        return ModesStream(self).process(np.asarray(v, dtype=np.float64))

    def of_axes(self, v: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Simulate the axes in alphabetical order; voltages [V], displacements [m] by axis."""
        order = sorted(v)
        columns = np.column_stack([real_array(v[axis]) for axis in order])
        return dict(zip(order, self.simulate(columns).T, strict=True))

    @property
    def settling(self) -> int:
        """Samples after which the modes have settled."""
        radius = min(self.radius, np.exp(math.log(SETTLED) / SETTLING))
        return math.ceil(math.log(SETTLED) / math.log(radius)) if radius > 0 else 1

    def steady(self, u: Array) -> Array:
        """
        Compute the steady motion under one period of voltages about `v0`, without its mean.

        The period, shape (n, inputs), is run through once before.
        """
        y = self.run(np.concatenate([u, u])).y[len(u) :]
        return np.asarray(y - y.mean(axis=0))

    def run(self, v: Array, state: LoopState | None = None) -> Passage:
        """
        Run the equations under voltages v about `v0`, and move `state` on.

        All states are zero before, if none is given.
        """
        v = np.ascontiguousarray(v, dtype=np.float64)
        self.check_inputs(v)
        n, q, k = len(v), *self.mu.shape
        run = Passage(
            np.zeros((n, self.linear.order)),
            np.zeros((n, q)),
            np.zeros((n, q)),
            np.zeros((n, q, k)),
            np.zeros((n, q, k), np.uint8),
            np.zeros(n),
            np.zeros((n, len(self.h))),
            np.zeros(v.shape),
        )
        loop = self.loop
        done = trajectory(v, loop, LoopState.at_zero(loop) if state is None else state, run)
        if done < n:
            raise ModelError(
                f'the shared modes run away at sample {done} of {n}; make the motion smaller, or '
                'diagnose again'
            )
        return run


def modes_to_dict(modes: SharedModes) -> dict[str, Any]:
    """Write shared modes as the plain data of a model file."""
    data = {x.name: getattr(modes.linear, x.name) for x in fields(Modal)}
    without = {'linear'} if modes.taus.size else {'linear', 'creep', 'taus'}
    own = [x.name for x in fields(SharedModes) if x.name not in without]
    return data | {name: getattr(modes, name) for name in own}


def modes_from_dict(data: Any, axes: int, name: str) -> SharedModes:
    """Build the shared modes of a number of axes from a model file, or raise ModelError."""
    try:
        # an older file has no creep
        data = {'creep': [], 'taus': [], **data}
        n, q, k, m = len(data['b']), len(data['f']), len(data['r']), len(data['taus'])
        shapes = {
            'blocks': (n // 2, 2, 2), 'b': (n, axes), 'c': (axes, n), 'd': (axes, axes),
            'e': (n, q), 'h': (axes, q), 'f': (q, n), 'g': (q, axes), 'mu': (q, k), 'r': (k,),
            'v0': (axes,), 'y0': (axes,), 'range': (2,), 'levels': (), 'memory': (),
            'creep': (axes, m), 'taus': (m,),
        }  # fmt: skip
        # a list without rows has lost its number of columns
        arrays = {x: np.array(data[x], dtype=np.float64).reshape(s) for x, s in shapes.items()}
        low, high = map(float, arrays['range'])
        within = {
            'blocks': n % 2 == 0, 'memory': arrays['memory'] > 0, 'taus': arrays['taus'] > 0,
            'levels': 0 <= arrays['levels'] <= q, 'range': 0 <= low <= 1 <= high,
        }  # fmt: skip
        sound = {x: np.isfinite(z) & within.get(x, True) for x, z in arrays.items()}
        if wrong := [x for x, each in sound.items() if not np.all(each)]:
            raise ValueError(f'{", ".join(wrong)} out of range')
        del arrays['range']
        levels, memory = int(arrays.pop('levels')), float(arrays.pop('memory'))
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f'{name}: modes: {error!r}; see docs/two_axes.md') from None
    linear = Modal(*(arrays.pop(x.name) for x in fields(Modal)))
    modes = SharedModes(linear, levels=levels, memory=memory, range=(low, high), **arrays)
    if not modes.radius < 1:
        raise ModelError(
            f'{name}: modes: unstable (pole at radius {modes.radius:.6g}); diagnose again'
        )
    return modes
