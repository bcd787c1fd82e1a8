# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Creep of shared modes is found where slow motion shows it, and predicts unseen slow motion."""

from dataclasses import replace

import axes_stage as stage
import numpy as np
import piezo_ident as pi
from piezo_ident.diagnosis.creep_of_modes import with_creep
from piezo_ident.diagnosis.shared_modes import find_shared_modes, Multisines
from piezo_ident.identification.settings import silent
from piezo_ident.record.channels import Axes
from random_models import random_modes_model

#: a stage of 1 um/V
STILL = replace(
    stage.loop_stage().grown(np.full(2, 1e-6 - 1.0), np.zeros(2)), memory=300.0, v0=np.full(2, 5.0)
)
#: the second axis creeps
CREEPS = replace(
    STILL, creep=np.array([[0.0, 0.0], [0.03, 0.03]]), taus=stage.RATE * np.array([0.3, 3.0])
)
HOLD, HOLDS = 1000, 30


def record(truth, seed):
    """Return multisines of three amplitudes, and voltages that hold for 0.5 s."""
    rng, parts, labels = np.random.default_rng(seed), [], []
    for amplitude in (0.5, 1.0, 1.5):
        for i in range(2):
            parts.append(np.tile(stage.multisine(rng, amplitude), (3, 1)))
            labels.append(f'multisine:{amplitude:g}-{i}')
    parts.append(np.repeat(rng.uniform(-2.5, 2.5, (HOLDS, 2)), HOLD, axis=0))
    v = 5.0 + np.vstack(parts)
    y = truth.simulate(v)
    y += 0.002 * y.std() * rng.standard_normal(y.shape)
    starts = np.cumsum([0, *map(len, parts[:-1])]).tolist()
    return pi.Record.from_arrays(
        v[:, 0],
        y[:, 0],
        sample_rate=stage.RATE,
        channels={'v_b': v[:, 1], 'y_b': y[:, 1]},
        segments=([*labels, 'hold'], starts),
        name=f'record {seed}',
    )


def slow_error(modes, record):
    """Return the rms error of each axis where voltages hold, about its mean."""
    axes = Axes.of(record.pieces[0])
    return (axes.outputs - modes.simulate(axes.inputs))[-HOLDS * HOLD :].std(axis=0)


def test_creep_of_one_axis_is_found_and_predicts_unseen_holds():
    known, unseen = record(CREEPS, 1), record(CREEPS, 2)
    axes = {
        a: replace(x, sample_rate=stage.RATE, scaling=replace(x.scaling, Y=5e-6))
        for a, x in random_modes_model(np.random.default_rng(0)).axes.items()
    }
    chains = pi.MultiAxisModel(axes)
    found = find_shared_modes(chains, Multisines.of(axes, [known]), [known], silent, tests=True)
    creep = found.modes.creep
    assert not creep[0].any() and 0.04 < creep[1].sum() < 0.09
    assert found.modes.creep_told.startswith(', with creep of 0 and ')
    without = replace(found.modes, creep=0 * creep)
    errors, before = (slow_error(x, unseen) for x in (found.modes, without))
    assert errors[1] < 0.4 * before[1] and errors[0] < 1.05 * before[0]


def test_without_creep_none_is_added():
    known = record(STILL, 3)
    assert not with_creep(STILL, [known]).taus.size
    # nor for hysteresis that the modes lack
    for share in (0.8, 0.0):
        assert not with_creep(replace(STILL, mu=share * STILL.mu), [known]).taus.size
