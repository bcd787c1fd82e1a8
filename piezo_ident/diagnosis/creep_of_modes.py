# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Add the creep of each axis to shared modes, if slow motion that is held out shows it.

As in `selection.comparison`, parts of the time and whole kinds of motion are held out.  Errors of
a kind count relative to their rms without creep.  Otherwise creep would imitate errors of the
modes on wide motion, and spoil the prediction of other motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis.held_out import held_out_kinds, stretches
from piezo_ident.effects.creep import AT_ONCE
from piezo_ident.fitting.modes.creep_fit import SlowMotion
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.record.channels import Axes
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import Record
from piezo_ident.selection.comparison import EFFECT
from piezo_ident.selection.motion_kinds import interleaved

#: elements of creep, from `AT_ONCE` to the longest piece, and parts of the time (taste)
ELEMENTS, PARTS = 5, 40


def with_creep(modes: SharedModes, records: Sequence[Record]) -> SharedModes:
    """
    Add creep to each axis if at most `EFFECT` of the held-out slow mean square is left with it.

    Slow motion is the mean of blocks of `AT_ONCE`.
    """
    pieces = [(record.name, piece) for record in map(without_faults, records) for piece in record]
    size = max(1, round(AT_ONCE * pieces[0][1].sample_rate))
    pieces = [(name, piece) for name, piece in pieces if piece.n >= size]
    if not pieces:
        return modes
    each, longest = [Axes.of(piece) for _, piece in pieces], max(piece.n for _, piece in pieces)
    taus = np.geomspace(size, max(longest, 10 * size), ELEMENTS)
    slow = SlowMotion.joined([SlowMotion.of(modes, axes, taus, size) for axes in each])
    labels = [x for p in pieces for x, a, b in stretches(*p, size) for _ in range(a, b)]
    parts = interleaved(PARTS)[np.arange(len(labels)) * PARTS // len(labels)]
    creep = np.zeros((len(modes.v0), ELEMENTS))
    for j in range(len(creep)):
        columns = (axes.inputs[: len(axes.inputs) // size * size, j] for axes in each)
        kinds, _ = held_out_kinds(labels, [x for v in columns for x in v.reshape(-1, size)])
        squares = np.bincount(kinds, slow.w[:, j] ** 2) / np.bincount(kinds)
        one = slow.of_axis(j, np.sqrt(np.where(squares > 0, squares, 1))[kinds])
        left = [np.mean(one.held_out(sets) ** 2) for sets in (parts, kinds)]
        if np.sqrt(np.prod(left)) <= EFFECT * np.mean(one.w**2):
            creep[j] = one.shares(np.ones(len(labels), dtype=bool))
    seen = creep.any(axis=0)
    return replace(modes, creep=creep[:, seen], taus=taus[seen])
