# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulated stage of two axes, with creep in one axis and hysteresis inside its mechanics.

Two modes carry both axes, so either voltage moves both displacements:

    q_i'' + 2 zeta_i w_i q_i' + w_i^2 q_i = w_i^2 phi_i (u + p),      e = Phi^-1 q

u are the voltages and e the extensions of the actuators, in volts.  The stiffness of each actuator
is hysteretic: its yielding since the start pushes a second time,

    p = h (s - z),   s = e - c u,   dz = ds (1 - (|z| / z0 where |z| grows, else 0))

This is the law of Bouc and Wen with n = 1, A = 1 and beta = gamma = 1 / (2 z0).  Small loops lose
energy and stiffness in proportion to their amplitude, as in Rayleigh's law.  s mixes stress and
field, so the loops also open where a mode rings.  A sum of plays can only approximate this stage.

    y = gain Phi^T q, and of the axis that creeps  + gain sum_k g_k (u filtered by 1 / (1 + T_k s))
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
import math
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError, DataError, ModelError
from piezo_ident.common.files import load_yaml
from piezo_ident.common.kernel import ordered_kernel
from piezo_ident.excitation.axes import build_axes
from piezo_ident.excitation.program import Program, Sequence
from piezo_ident.model.files import check_keys, number, numbers
from piezo_ident.model.simulated_stage import seed_of, SimulatedStage, stage_from_dict
from piezo_ident.record.record import Piece, Record
from scipy.linalg import expm

#: number of steps of the mechanics in a sample
STEPS = 4
_KEYS = ('axes', 'sample_rate', 'gain', 'modes', 'hysteresis', 'creep', 'noise_rms', 'seed')


@dataclass(frozen=True, eq=False)
class TwoAxisStage:
    """
    Sampled stage of two axes; the module has the equations.

    Attributes
    ----------
    axes : tuple of str
        Names of the axes; the first name is empty.
    sample_rate : float
        Sampling rate [Hz].
    gain : float
        Gain [m/V].
    frequency, damping : ndarray, shape (2,)
        Frequency [Hz] and damping ratio of the modes.
    shape : ndarray, shape (2, 2)
        Phi, one row for each mode.
    hysteresis : tuple of float
        h, c and z0 [1, 1, V]; h = 0 makes a linear stage.
    creep_axis : int
        Index of the axis that creeps.
    creep_gain, creep_time : ndarray, shape (m,)
        Shares g and time constants T of creep [1, s].
    noise_rms : float
        Rms noise of the sensors [m].
    seed : int
        Seed of the noise.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.TwoAxisStage.load('two_axes')
    >>> record = stage.play(pi.Program.load('two_axes'))
    >>> pi.Axes.of(record.pieces[0]).output_names
    ('y', 'y_b')
    """

    axes: tuple[str, ...]
    sample_rate: float
    gain: float
    frequency: Array
    damping: Array
    shape: Array
    hysteresis: tuple[float, float, float]
    creep_axis: int
    creep_gain: Array
    creep_time: Array
    noise_rms: float = 0.0
    seed: int = 0

    @classmethod
    def load(cls, name_or_path: str | os.PathLike[str]) -> TwoAxisStage:
        """
        Read a stage: ``two_axes``, or a file of the user.

        Raises
        ------
        ConfigError
            If the file cannot be read or is invalid.

        Examples
        --------
        >>> import piezo_ident as pi
        >>> pi.TwoAxisStage.load('two_axes').sample_rate
        2000.0
        """
        path = find_config(name_or_path, 'stage')
        return two_axis_stage_from_dict(load_yaml(path), str(path))

    def run(self, rng: np.random.Generator) -> TwoAxisRun:
        """Start a run that takes the commands block by block, from rest at 0 V."""
        return TwoAxisRun(self, rng)

    def play(
        self,
        program: Program | Many[Sequence],
        rng: np.random.Generator | None = None,
        name: str = 'simulated',
    ) -> Record:
        """
        Play a program on every axis, with random signals of its own, and record the measurement.

        Parameters
        ----------
        program : Program, or two of Sequence
        rng : numpy.random.Generator, optional
            Generator of the sensor noise; by default one with the seed of the stage.
        name : str, optional
            Name of the record.

        Raises
        ------
        ConfigError
            If the program cannot be built at the sampling rate of the stage.
        """
        if isinstance(program, Program):
            program = build_axes(program, 2, self.sample_rate)
        first, second = program
        run = self.run(np.random.default_rng(self.seed) if rng is None else rng)
        v = np.column_stack([first.v, second.v])
        y = run.process(v)
        label = self.axes[1]
        channels = {f'v_{label}': v[:, 1], f'y_{label}': y[:, 1]}
        piece = Piece(v[:, 0], y[:, 0], self.sample_rate, 0.0, first.segments, channels)
        return Record((piece,), name)


class TwoAxisRun:
    """
    Run of a stage of two axes, block by block; the result does not depend on the blocks.

    There are no converters: `clipped_input` and `clipped_output` are always 0.
    """

    def __init__(self, stage: TwoAxisStage, rng: np.random.Generator) -> None:
        self.stage = stage
        self.clipped_input = self.clipped_output = 0
        self._rng = rng
        a, b = _sampled(stage)
        self._mechanics = a, b, np.ascontiguousarray(np.linalg.inv(stage.shape.T))
        creep = -np.expm1(-1.0 / (stage.sample_rate * stage.creep_time))
        self._creep = creep, stage.creep_gain, np.zeros(creep.size)
        # position and speed of each mode; s and z of each actuator
        self._state, self._memory = np.zeros((2, 2)), np.zeros((2, 2))

    def process(self, v: ArrayLike) -> Array:
        """
        Compute the readings [m], shape (n, 2), for the next commands [V], shape (n, 2).

        A reading is taken before the command of the same sample acts.
        """
        u = np.ascontiguousarray(v, dtype=np.float64)
        if u.ndim != 2 or u.shape[1] != 2:
            raise DataError(f'voltages of shape {u.shape} do not fit two axes; give (n, 2)')
        stage, y = self.stage, np.empty_like(u)
        h, c, z0 = stage.hysteresis
        _move(
            u, *self._mechanics, stage.shape, h, c, z0, *self._creep, stage.creep_axis,
            self._state, self._memory, y,
        )  # fmt: skip
        y *= stage.gain
        if stage.noise_rms > 0:
            y += stage.noise_rms * self._rng.standard_normal(y.shape)
        return y


def _sampled(stage: TwoAxisStage) -> tuple[Array, Array]:
    """Compute transition and input of each mode over a step, shapes (2, 2, 2) and (2, 2)."""
    a, b = np.empty((2, 2, 2)), np.empty((2, 2))
    for i, (frequency, zeta) in enumerate(zip(stage.frequency, stage.damping, strict=True)):
        w = 2.0 * math.pi * frequency
        held = np.zeros((3, 3))
        held[:2] = [[0.0, 1.0, 0.0], [-w * w, -2.0 * zeta * w, w * w]]
        step = expm(held / (STEPS * stage.sample_rate))
        a[i], b[i] = step[:2, :2], step[:2, 2]
    return a, b


@ordered_kernel
def _move(
    u: Array,
    a: Array,
    b: Array,
    inverse: Array,
    shape: Array,
    h: float,
    c: float,
    z0: float,
    creep: Array,
    creep_gain: Array,
    crept: Array,
    creep_axis: int,
    state: Array,
    memory: Array,
    y: Array,
) -> None:
    f = np.zeros(2)
    for k in range(u.shape[0]):
        for j in range(2):
            y[k, j] = shape[0, j] * state[0, 0] + shape[1, j] * state[1, 0]
        for m in range(crept.size):
            y[k, creep_axis] += creep_gain[m] * crept[m]
            crept[m] += creep[m] * (u[k, creep_axis] - crept[m])
        for _ in range(STEPS):
            for j in range(2):
                # e solves q = Phi e: each mode carries the extensions, weighted by its shape
                e = inverse[0, j] * state[0, 0] + inverse[1, j] * state[1, 0]
                s = e - c * u[k, j]
                ds, z = s - memory[j, 0], memory[j, 1]
                if ds * z < 0.0:
                    # back to zero without yielding; ds keeps the rest of the way
                    back = min(abs(ds), abs(z))
                    z += math.copysign(back, ds)
                    ds -= math.copysign(back, ds)
                if ds > 0.0:
                    z = z0 - (z0 - z) * math.exp(-ds / z0)
                elif ds < 0.0:
                    z = -z0 + (z0 + z) * math.exp(ds / z0)
                memory[j, 0], memory[j, 1] = s, z
                f[j] = u[k, j] + h * (s - z)
            for i in range(2):
                push = shape[i, 0] * f[0] + shape[i, 1] * f[1]
                x0, x1 = state[i, 0], state[i, 1]
                state[i, 0] = a[i, 0, 0] * x0 + a[i, 0, 1] * x1 + b[i, 0] * push
                state[i, 1] = a[i, 1, 0] * x0 + a[i, 1, 1] * x1 + b[i, 1] * push


def load_stage(name_or_path: str | os.PathLike[str]) -> SimulatedStage | TwoAxisStage:
    """Read a stage of one axis, or of two axes if its file has the key ``axes``."""
    path = find_config(name_or_path, 'stage')
    data = load_yaml(path)
    return (two_axis_stage_from_dict if 'axes' in data else stage_from_dict)(data, str(path))


def two_axis_stage_from_dict(data: Mapping[str, Any], name: str = 'stage') -> TwoAxisStage:
    """Build a stage from plain data, or raise ConfigError; see ``config/stage_two_axes.yaml``."""
    try:
        return _stage(data, name)
    except ModelError as error:
        raise ConfigError(str(error)) from None


def _stage(data: Mapping[str, Any], name: str) -> TwoAxisStage:
    check_keys(data, _KEYS, '', name)
    parts = {key: data.get(key) for key in ('modes', 'hysteresis', 'creep')}
    for key, part in parts.items():
        if not isinstance(part, Mapping):
            raise ConfigError(f'{name}: {key} must be a mapping, see config/stage_two_axes.yaml')
    modes, hysteresis, creep = (dict(part) for part in parts.values() if part is not None)
    rows = modes.get('shape')
    if not isinstance(rows, list) or len(rows) != 2:
        raise ConfigError(f'{name}: shape must be two rows of two numbers')
    shape = np.array([numbers({'shape': row}, 'shape', name) for row in rows])
    axes = data.get('axes')
    if not isinstance(axes, list) or len(axes) != 2 or axes[0] or not str(axes[1]).isidentifier():
        raise ConfigError(f"{name}: axes = {axes!r} must be '' and a second name, as in ['', b]")
    if creep.get('axis') not in axes:
        raise ConfigError(f'{name}: creep.axis = {creep.get("axis")!r} must be one of {axes}')
    where = f'{name}: hysteresis'
    stage = TwoAxisStage(
        ('', str(axes[1])),
        number(data, 'sample_rate', name),
        number(data, 'gain', name),
        numbers(modes, 'frequency', name),
        numbers(modes, 'damping', name),
        shape,
        (
            number(hysteresis, 'share', where),
            number(hysteresis, 'field', where),
            number(hysteresis, 'scale', where),
        ),
        axes.index(creep['axis']),
        numbers(creep, 'gain', name),
        numbers(creep, 'time_constant', name),
        number(data, 'noise_rms', name, 0.0),
        seed_of(data, name),
    )
    _check(stage, name)
    return stage


def _check(stage: TwoAxisStage, name: str) -> None:
    """Refuse impossible values."""
    h, _, z0 = stage.hysteresis
    values = {
        key: getattr(stage, key) for key in ('sample_rate', 'gain', 'hysteresis', 'noise_rms')
    }
    if bad := [key for key, x in values.items() if not np.isfinite(x).all()]:
        raise ConfigError(f'{name}: {", ".join(bad)} must be finite')
    sizes: Many[tuple[str, Array, tuple[int, ...]]] = (
        ('frequency', stage.frequency, (2,)),
        ('damping', stage.damping, (2,)),
        ('shape', stage.shape, (2, 2)),
        ('time_constant', stage.creep_time, stage.creep_gain.shape),
    )
    for key, x, shape in sizes:
        if x.shape != shape or not np.isfinite(x).all() or not (key == 'shape' or np.all(x > 0)):
            kind = 'finite' if key == 'shape' else 'positive'
            raise ConfigError(f'{name}: {key} must be {shape} {kind} numbers')
    if not (stage.sample_rate > 2 * stage.frequency.max() and stage.gain != 0):
        raise ConfigError(
            f'{name}: sample_rate = {stage.sample_rate:g} Hz must be above twice the highest '
            f'mode, {stage.frequency.max():g} Hz, and gain = {stage.gain:g} not 0'
        )
    if abs(np.linalg.det(stage.shape)) < 1e-6:
        raise ConfigError(f'{name}: the rows of shape are the same mode; make them differ')
    if not (0 <= h < 1 and z0 > 0):
        raise ConfigError(f'{name}: hysteresis needs 0 <= share < 1 and scale > 0')
    if stage.noise_rms < 0:
        raise ConfigError(f'{name}: noise_rms must not be negative')
