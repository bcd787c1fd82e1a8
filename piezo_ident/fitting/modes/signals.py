# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Signals inside the loop that a model may gain: softening, plays in the mechanics, plays of inputs.

A signal begins as the extension of the actuators, G(0)^-1 y, or as their voltages.  Its rms over
the records of the fit is 1.  It begins without effect: E and H are zero.  A fit then mixes motion
and voltage anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.modes.periods import PeriodicRecord
from piezo_ident.model.modes.shared_modes import SharedModes

#: of the plays, in units of the rms of their signals
THRESHOLDS = (0.05, 0.15, 0.4, 1.0, 2.0)


def with_softening(model: SharedModes, records: Sequence[PeriodicRecord]) -> SharedModes:
    """Let the extensions of the actuators soften the stage; their level is 1 in the records."""
    if model.signals:
        raise ModelError(
            f'the model has {model.signals} signals of plays already; call with_softening first'
        )
    new = _with(model, *_extension(model), records, plays=False)
    return replace(new, levels=new.signals)


def with_loop_plays(model: SharedModes, records: Sequence[PeriodicRecord]) -> SharedModes:
    """Add plays of the extensions of the actuators: hysteresis inside the mechanics."""
    return _with(model, *_extension(model), records)


def with_input_plays(model: SharedModes, records: Sequence[PeriodicRecord]) -> SharedModes:
    """Add plays of the voltages."""
    inputs = model.linear.b.shape[1]
    f, g = np.zeros((inputs, model.linear.order)), np.eye(inputs)
    return _with(model, f, g, records)


def _extension(model: SharedModes) -> tuple[Array, Array]:
    """Return F and G of G(0)^-1 y: the voltages that would hold the outputs at rest."""
    back = np.linalg.pinv(model.linear.gain)
    return back @ model.linear.c, back @ model.linear.d


def _with(
    model: SharedModes,
    f: Array,
    g: Array,
    records: Sequence[PeriodicRecord],
    *,
    plays: bool = True,
) -> SharedModes:
    squares = []
    for record in records:
        u = record.mean_u
        z = model.run(np.concatenate([u, u])).x[len(u) :] @ f.T + u @ g.T
        squares.append(z.var(axis=0))
    size = np.sqrt(np.mean(squares, axis=0))[:, None]
    r = np.array(THRESHOLDS)
    # each play as if the thresholds were spread evenly, as Rayleigh's law has it
    weights = np.diff(r, prepend=0.0) if plays else np.zeros(len(r))
    old = np.zeros((model.signals, len(r)))
    if model.signals > model.levels:
        old = model.mu
    order, outputs = model.linear.order, len(model.linear.c)
    many = len(f)
    return replace(
        model,
        e=np.hstack([model.e, np.zeros((order, many))]),
        h=np.hstack([model.h, np.zeros((outputs, many))]),
        f=np.vstack([model.f, f / size]),
        g=np.vstack([model.g, g / size]),
        mu=np.vstack([old, np.tile(weights, (many, 1))]),
        r=r,
    )
