# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compute the band of a prediction by modes that axes share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.model.initial_memory import is_at_rest
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.modes.stream import MemorySpread
from piezo_ident.model.multi_axis import judged_models, MultiAxisModel
from piezo_ident.record.record import Record
from piezo_ident.uncertainty.band import BandStream


def modes_half_widths(
    model: MultiAxisModel,
    modes: SharedModes,
    seen: Mapping[str, Record],
    predicted: Mapping[str, Sequence[Array]],
    level: float,
) -> dict[str, tuple[Array, ...]]:
    """
    Compute the half width of the band of each piece of a record with shared modes, by axis [m].

    `seen` has the record of every axis, of which the voltage is used.  For a piece that does not
    start at rest, the band contains all possible plays until the motion has swept them.  The band
    always contains the creep of earlier motion.
    """
    each, order = judged_models(model), sorted(model.axes)
    half_widths: dict[str, list[Array]] = {axis: [] for axis in order}
    for i in range(len(seen[order[0]].pieces)):
        pieces = [seen[axis].pieces[i] for axis in order]
        v = np.column_stack([piece.v for piece in pieces])
        y = np.column_stack([predicted[axis][i] for axis in order])
        spread = np.zeros(y.shape)
        if not all(is_at_rest(each[a], x) for a, x in zip(order, pieces, strict=True)):
            spread = MemorySpread(modes).follow(v, y)
        for j, axis in enumerate(order):
            band = BandStream(each[axis], level, creep=False)
            half_widths[axis].append(band.follow(v[:, j], y[:, j]) + level * spread[:, j])
    return {axis: tuple(half) for axis, half in half_widths.items()}
