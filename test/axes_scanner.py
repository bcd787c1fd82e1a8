# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A small scanner of two axes at 1 kHz, of the model's own laws, and its records."""

from dataclasses import replace

import numpy as np
import piezo_ident as pi
from piezo_ident.live.predictor import run_of
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis

RATE = 1000.0
AXES = ('y', 'y_b')
#: what the first axis moves of the second, and the second of the first
CROSS = 0.01, 0.02
#: what a model knows of its error from its identification [% of stroke]
ERRORS = {'errors': {'held_out': 0.02}}


def chain(weights, pole, Y):
    """Return the model of an axis: three plays and a lag."""
    G = Dynamics(a=np.array([-pole]), b=np.array([1.0 - pole]))
    H = Hysteresis(thresholds=np.array([0.1, 0.2, 0.4]), weights=np.array(weights), p1=0.0, p2=0.7)
    return StageModel(RATE, Scaling(0.0, 10.0, 0.0, Y, (0.0, 10.0)), H, G, Delay(1))


def path(model, source, share):
    """Return a model with what another axis moves of it, a share of that motion."""
    shape = {'channel': source, 'gain': share / model.scaling.Y, 'frequency': 150.0}
    return replace(model, effects=(EffectSetting('cross_coupling', shape),))


def scanner():
    first, second = chain([0.1, 0.1, 0.1], 0.5, 50e-6), chain([0.15, 0.1, 0.05], 0.6, 40e-6)
    return pi.MultiAxisModel(
        {'y': path(first, 'motion_b', CROSS[1]), 'y_b': path(second, 'motion', CROSS[0])}
    )


def creeping():
    """Return the scanner with a first axis that creeps."""
    creep = EffectSetting('creep', {'gain': [0.02, 0.03], 'time_constant': [0.3, 20.0]})
    axes = {a: replace(x, identification=ERRORS) for a, x in scanner().axes.items()}
    first = axes['y']
    return pi.MultiAxisModel({**axes, 'y': replace(first, effects=(creep, *first.effects))})


def grown(model, axis, gain=1.03):
    """Return a stage that moves more on one axis than its model."""
    one = model.axes[axis]
    more = replace(one, hysteresis=one.hysteresis.scaled(gain))
    return pi.MultiAxisModel({**model.axes, axis: more})


def moving(stage, earlier=0.0):
    """Return a run of a stage that stood at the highest voltages for some seconds, if at all."""
    run, n = run_of(stage, AXES), round(earlier * RATE)
    if n:
        way = np.linspace(0.0, 10.0, 500)
        before = np.concatenate([way, np.full(n, 10.0), way[::-1]])
        run.process(np.stack([before] * 2), np.arange(before.size) / RATE)
    return run


def answer(stage, v, earlier=0.0):
    """Return what a stage of this past does under voltages of both axes, a row each [m]."""
    return moving(stage, earlier).process(v, np.arange(v.shape[1]) / RATE)


def sweeps(n, rng, turns=40):
    """Return a voltage [V] that turns at random levels, from 0 V to 10 V and back to 0 V."""
    levels = np.concatenate([[0.0, 10.0, 0.0], rng.uniform(0.0, 10.0, turns), [0.0]])
    at = np.cumsum(np.concatenate([[0.0], np.abs(np.diff(levels)) + 0.5]))
    return np.interp(np.linspace(0.0, at[-1], n), at, levels)


def raster(n, fast=5.0, slow=0.25, span=8.0):
    """Return voltages [V] of a fast and a slow triangle about 5 V, from 0 V by a ramp."""
    t = np.arange(n) / RATE
    soft = np.minimum(t / 0.5, 1.0)
    return [soft * (1.0 + span * 2 * np.abs((f * t) % 1.0 - 0.5)[::-1]) for f in (fast, slow)]


def play(v, v_b, seed=0, name='scan', noise=2e-9, **options):
    """Return what the scanner does under two voltages, as a record."""
    y = scanner().simulate({'v': v, 'v_b': v_b})
    rng = np.random.default_rng(seed)
    y = {axis: x + noise * rng.standard_normal(x.size) for axis, x in y.items()}
    channels = {'v_b': v_b, 'y_b': y['y_b']}
    return pi.Record.from_arrays(
        v, y['y'], sample_rate=RATE, channels=channels, name=name, **options
    )
