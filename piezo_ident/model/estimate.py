# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimate the displacement of a measured record by an observer, as the model node does live.

The free run begins at rest, as in the node, and depends on the voltage alone.  The observer uses
displacement at least a horizon before the estimated sample.  A gap of up to 1 s is bridged; the
node begins anew behind a gap of 0.5 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, line_between
from piezo_ident.model.observer import HORIZON, Observed, Observer
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.gaps import follows, played_before
from piezo_ident.record.record import Piece


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Voltage [V], free run, displacement and motion by other axes [m], shapes (n,)."""

    v: Array
    free: Array
    y: Array
    felt: Array


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
    past, done = np.full(horizon, np.nan), list[Observed]()
    before: _Stretch | None = None

    def follow(piece: _Stretch) -> Observed:
        nonlocal past
        y = np.concatenate([past, piece.y - piece.felt])
        past = y[piece.v.size :]
        seen = observer.process(piece.v, piece.free - piece.felt, y[: piece.v.size])
        return replace(seen, estimate=seen.estimate + piece.felt)

    for k, piece in enumerate(pieces):
        stretch = _Stretch(piece.v, free[k], piece.measured, felt[k])
        missing = 0 if before is None else follows(pieces[k - 1], piece)
        if before is not None and missing:
            played = played_before(pieces[k - 1], piece)
            gap = _between(before, stretch, missing)
            follow(gap if played is None else replace(gap, v=played.v))
            if played is None:
                observer.lose_memory()
        done.append(follow(stretch))
        before = stretch
    return done


def _between(one: _Stretch, other: _Stretch, missing: int) -> _Stretch:
    """Fill a gap by straight lines, as the model node does; its displacement is missing."""

    def line(before: Array, after: Array) -> Array:
        return line_between(float(before[-1]), float(after[0]), missing)

    return _Stretch(
        line(one.v, other.v),
        line(one.free, other.free),
        np.full(missing, np.nan),
        line(one.felt, other.felt),
    )
