# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimate the displacement of a measured record by an observer, as the model node does live.

The free run begins at rest, as in the node, and depends on the voltage alone.  The observer uses
displacement at least a horizon before the estimated sample.  A gap of up to 1 s is bridged, as
the voltage may go on unrecorded.  The node begins anew behind a gap of 0.5 s, as a stage then
ramps to rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, lines_between
from piezo_ident.model.observer import HORIZON, Observed, Observer
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.gaps import follows, played_before
from piezo_ident.record.record import Piece


def observe(model: StageModel, piece: Piece, horizon: int = HORIZON, **options: Any) -> Observed:
    """
    Run an observer along a piece of a record; NaN and infinite readings count as missing.

    Parameters
    ----------
    model : StageModel
    piece : Piece
    horizon : int, optional
        As for `Observer`; `options` are its other parameters.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('paper')
    >>> (piece,) = stage.play(pi.Program.load('minor_loops'))
    >>> moved = Piece(piece.v, piece.y + 1e-6, piece.sample_rate)
    >>> seen = observe(stage.model, moved)
    >>> f'{1e6 * seen.offset[-1]:.2f} um'
    '1.00 um'
    """
    model.check_rate(piece)
    free, felt = model.stream().follow(piece), np.zeros(piece.n)
    (seen,) = observe_pieces(model, [piece], [free], [felt], horizon, **options)
    return seen


def observe_pieces(
    model: StageModel,
    pieces: Sequence[Piece],
    free: Sequence[Array],
    felt: Sequence[Array],
    horizon: int = HORIZON,
    **options: Any,
) -> list[Observed]:
    """
    Run an observer along pieces that follow each other over short gaps.

    Parameters
    ----------
    model : StageModel
        The axis without the motion by other axes.
    pieces : sequence of Piece
        As `piezo_ident.record.readings.gaps.connected_pieces` gives them.  Readings outside the
        mask of a piece count as missing.
    free : sequence of ndarray
        Free run of each piece from rest, with the motion by other axes [m].
    felt : sequence of ndarray
        Motion by other axes in `free` [m].
    horizon : int, optional
        As for `Observer`; `options` are its other parameters.
    """
    if model.is_static:
        model = replace(model, sample_rate=pieces[0].sample_rate)
    observer = Observer(model, horizon=horizon, **options)
    past, last, done = np.full(horizon, np.nan), np.empty(0), list[Observed]()

    def follow(rows: Array, y: Array) -> Observed:
        nonlocal past
        v, run, other = rows
        y = np.concatenate([past, y - other])
        past = y[v.size :]
        seen = observer.process(v, run - other, y[: v.size])
        return replace(seen, estimate=seen.estimate + other)

    for k, piece in enumerate(pieces):
        rows = np.stack([piece.v, free[k], felt[k]])
        missing = follows(pieces[k - 1], piece) if k else 0
        if missing:
            # straight lines, as in the model node
            between = lines_between(last, rows[:, 0], missing)
            if played := played_before(pieces[k - 1], piece):
                between[0] = played.v
            follow(between, np.full(missing, np.nan))
            if played is None:
                observer.lose_memory()
        done.append(follow(rows, piece.measured))
        last = rows[:, -1]
    return done
