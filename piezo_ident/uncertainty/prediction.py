# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compute the band of predicted records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.model.free_run import FreeRun
from piezo_ident.model.initial_memory import is_at_rest
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.gaps import connected_pieces
from piezo_ident.record.record import Record
from piezo_ident.uncertainty.band import BandStream, FAR, FAST


def half_widths(
    model: StageModel,
    record: Record,
    predicted: Sequence[Array],
    level: float,
    estimated: Sequence[bool] | None = None,
) -> tuple[Array, ...]:
    """
    Compute the half width of the band of each piece of a record [m].

    `estimated` says for each piece whether its displacement gave the start.  The plays of such a
    piece may err until they are swept.  Without `estimated` only the voltage is known.  A start at
    rest then gives the plays, and the band contains the creep of earlier motion.
    """
    half = list[Array]()
    for pieces in connected_pieces(record):
        known = is_at_rest(model, pieces[0]) if estimated is None else not estimated[len(half)]
        stream = BandStream(model, level, plays=known, creep=estimated is not None)
        for piece in pieces:
            half.append(stream.follow(piece.v, predicted[len(half)]))
    return tuple(half)


def with_half_widths(run: FreeRun, level: float, half: tuple[Array, ...]) -> FreeRun:
    """Add half widths [m] to a free run, and a warning about infinite half widths."""
    warnings = [f'{run.record.name}: {text}' for text in unknown_parts(half)]
    return replace(run, interval=level, half_widths=half, warnings=(*run.warnings, *warnings))


def unknown_parts(half: Sequence[Array]) -> list[str]:
    """Return a warning with the share of infinite half widths; empty without any."""
    n, lost = sum(x.size for x in half), sum(int(np.isinf(x).sum()) for x in half)
    if not lost:
        return []
    return [
        f'the error is not known for {100.0 * lost / n:.2g} % of the samples: they lie more than '
        f'{FAR:.0%} outside the range of the model, or are over {FAST:g} times as fast as its data'
    ]
