# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Random models that have an inverse, and random motions."""

from dataclasses import replace

import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.model.modes.modal import balanced, Modal
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from scipy.ndimage import gaussian_filter1d


def random_hysteresis(rng: np.random.Generator, law: str) -> Hysteresis:
    """Return an H of a law that rises everywhere, narrow or wide, with a bent line."""
    while True:
        family = HysteresisLaw(law, np.sort(rng.uniform(0.002, 0.99, rng.integers(1, 40))))
        n = family.densities
        theta = np.zeros(family.size)
        theta[:n] = rng.uniform(0.0, 1.0, n) * (rng.uniform(size=n) < 0.6)
        # what the plays add, beside the line
        full = float(family.hysteresis(theta)([0.0, 1.0])[1])
        theta[:n] *= rng.uniform(0.0, 1.5) / max(full, 1e-9)
        theta[n : n + family.lags] = rng.normal(0.0, 0.01, family.lags)
        p2 = rng.uniform(0.3, 1.5)
        p1 = rng.uniform(-0.9, 1.0) * p2 / 3.0
        theta[-2:] = p1, p2
        if law != 'plays':
            theta[-3] = rng.uniform(-0.9, 0.9) * 0.5 * (p2 + min(0.0, 3.0 * p1))
        h = family.hysteresis(theta)
        if h.lowest_slope() > 0.02:
            return h


def falling_hysteresis(rng: np.random.Generator, law: str) -> Hysteresis:
    """Return an H of a law that falls where the voltage turns, until its narrowest play moves."""
    h = random_hysteresis(rng, law)
    weight = rng.uniform(0.3, 1.0)
    curves, bias = h.curves, h.bias
    if curves is not None:
        # its weight falls to 0.6 of itself over the span
        curves = np.vstack([[-0.2 * weight, 0.0, 0.0], curves])
    falls = replace(
        h,
        thresholds=np.append(0.001, h.thresholds),
        weights=np.append(weight, h.weights),
        p2=h.p2 - h.lowest_slope() - rng.uniform(0.1, 0.5) * weight,
        curves=curves,
        bias=None if bias is None else np.append(0.0, bias),
    )
    # the lowest slope may be that of a sweep with lags, where the narrowest play moves, too
    return falls if falls.lowest_slope() <= 0.0 else falling_hysteresis(rng, law)


def random_path(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a path within 0 .. 1: noise, a walk, a sine that grows or shrinks, or jumps."""
    match rng.integers(4):
        case 0:
            return rng.uniform(0.0, 1.0, n)
        case 1:
            return np.clip(0.5 + np.cumsum(rng.normal(0.0, 0.02, n)), 0.0, 1.0)
        case 2:
            size = np.linspace(rng.uniform(), rng.uniform(), n)
            return 0.5 - 0.5 * size * np.cos(rng.uniform(0.001, 0.5) * np.arange(n))
        case _:
            return np.repeat(rng.uniform(0.0, 1.0, n // 10 + 1), 10)[:n]


def random_dynamics(rng: np.random.Generator, damped: float = 1e-3) -> Dynamics:
    """Return a stable G: modes of some damping at least, zeros on both sides of the circle."""
    pairs = rng.integers(0, 4)
    w = rng.uniform(0.05, 2.5, pairs)
    poles = np.exp(w * (-(10.0 ** rng.uniform(np.log10(damped), -0.3, pairs)) + 1j))
    radius = rng.choice([0.5, 0.8, 1.3, 2.5], rng.integers(0, 4))
    zeros = radius * rng.choice([-1.0, 1.0], radius.size)
    a = np.atleast_1d(np.real(np.poly([*poles, *poles.conj()])))[1:]
    return Dynamics(a, np.atleast_1d(np.poly(zeros))).normalised()


def random_model(
    rng: np.random.Generator,
    law: str,
    effects: tuple[EffectSetting, ...] = (),
    damped: float = 1e-3,
) -> StageModel:
    """Return a model with a delay of any fraction that extends or retracts."""
    h = random_hysteresis(rng, law)
    Y = 50e-6 * rng.choice([-1.0, 1.0])
    return replace(
        PAPER,
        hysteresis=h,
        dynamics=random_dynamics(rng, damped),
        delay=Delay(int(rng.integers(0, 30)), float(rng.uniform(0.0, 0.99))),
        scaling=replace(PAPER.scaling, Y=Y, y0=float(rng.uniform(-1.0, 1.0)) * 50e-6),
        effects=effects,
    )


def smooth_motion(rng: np.random.Generator, model: StageModel, n: int = 3000) -> np.ndarray:
    """Return sines of up to 120 Hz that start and end softly, well within a model's reach."""
    u = np.array([0.25, 0.75])
    low, high = np.sort([float(model.without_dynamics().chain().reset(x, x)) for x in u])
    t = np.arange(n) / FS
    phase, f = rng.uniform(0.0, 2 * np.pi, 3), rng.uniform(1.0, 120.0, 3)
    waves = np.sin(2 * np.pi * np.outer(t, f) + phase) @ rng.dirichlet(np.ones(3))
    soft = np.minimum(1.0, np.minimum(t, t[::-1]) / 0.05) ** 2
    x = 0.5 * (low + high) + 0.5 * (high - low) * soft * waves
    return np.asarray(model.scaling.y(x))


def random_shared_modes(
    rng: np.random.Generator,
    axes: int = 2,
    softens: bool = True,
    strength: float = 0.1,
    creeps: bool = False,
) -> SharedModes:
    """Return coupled modes with plays in front and inside their loop; some soften or creep."""
    order = 2 * int(rng.integers(axes, axes + 3))
    w, damping = rng.uniform(0.2, 1.2, order // 2), rng.uniform(0.01, 0.1, order // 2)
    poles = np.exp(w * (1j - damping))
    blocks = np.array([[[p.real, p.imag], [-p.imag, p.real]] for p in poles])
    shape = rng.normal(0.0, 0.3, (axes, order // 2)) + 2.0 * np.eye(axes, order // 2)
    free = Modal(blocks, np.zeros((order, axes)), np.zeros((axes, order)), np.zeros((axes, axes)))
    static = np.linalg.inv(np.eye(order) - free.a)
    b, c = free.b.copy(), free.c.copy()
    for i in range(order // 2):
        b[2 * i + 1], c[:, 2 * i] = shape[:, i], shape[:, i]
        # each mode has its gain at rest
        b[2 * i + 1] *= 1e-6 * rng.uniform(0.3, 1.0) / static[2 * i, 2 * i + 1]
    linear = balanced(replace(free, b=b, c=c))
    gain = np.linalg.inv(linear.response(np.ones(1, complex))[0].real)
    f, levels = gain @ linear.c, axes if softens else 0
    nothing = np.zeros((axes, order))
    signals = [f, f, nothing] if softens else [f, nothing]
    plays = np.array([[0.0] * 3] * levels + [[0.3, 0.3, 0.4]] * 2 * axes)
    e = np.hstack([rng.uniform(0.2, 1.0) * strength * linear.b for _ in signals])
    modes = SharedModes(
        linear,
        e=e,
        h=np.zeros((axes, e.shape[1])),
        f=np.vstack(signals),
        g=np.vstack([np.zeros((e.shape[1] - axes, axes)), np.eye(axes)]),
        levels=levels,
        mu=plays,
        r=np.array([0.1, 0.4, 0.9]),
        memory=float(rng.uniform(30.0, 300.0)),
        range=(0.5, 1.6),
        v0=rng.uniform(3.0, 6.0, axes),
        y0=rng.uniform(0.0, 1e-5, axes),
        creep=rng.uniform(0.0, 0.03, (axes, 2)) if creeps else np.zeros((axes, 0)),
        taus=np.array([200.0, 3000.0]) if creeps else np.zeros(0),
    )
    again = modes.radius >= 0.999
    return random_shared_modes(rng, axes, softens, strength, creeps) if again else modes


def random_modes_model(rng: np.random.Generator, axes: int = 2, **options) -> MultiAxisModel:
    """Return a model of several axes that predicts by shared modes."""
    modes = random_shared_modes(rng, axes, **options)
    names = ['y', 'y_b', 'y_c', 'y_d'][:axes]
    scaling = replace(PAPER.scaling, range=(0.0, 10.0))
    return MultiAxisModel({a: replace(PAPER, scaling=scaling) for a in names}, modes)


def brittle_modes(model: MultiAxisModel) -> MultiAxisModel:
    """Return a model of two axes, 2 um/V about 3 V, whose modes run away above 10 V."""
    half = 0.5 * np.eye(2)
    linear = Modal(half[None], half, 2e-6 * np.eye(2), np.zeros((2, 2)))
    modes = replace(
        SharedModes.of(linear),
        e=np.eye(2),
        h=np.zeros((2, 2)),
        f=np.eye(2),
        g=np.zeros((2, 2)),
        # beyond the threshold the gain of the loop is 1.2
        mu=np.full((2, 1), 0.7),
        r=np.array([7.0]),
        v0=np.full(2, 3.0),
        y0=np.full(2, 1e-5),
    )
    return MultiAxisModel(model.axes, modes)


def random_voltages(rng: np.random.Generator, modes: SharedModes, n: int, size: float = 3.0):
    """Return smooth voltages about those of the fit, shape (n, axes)."""
    steps = rng.normal(size=(n, len(modes.v0)))
    smooth = gaussian_filter1d(steps, rng.uniform(3.0, 30.0), axis=0)
    return modes.v0 + size * smooth / np.abs(smooth).max()
