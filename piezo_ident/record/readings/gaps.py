# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Bridge short gaps in a record for fitting.

Reading splits a record where samples are missing, but the stage keeps its memory.  In a short gap
the voltage moves on to its next value, and the plays move with it.  Straight lines join pieces of
one clock.  If the displacement alone is missing, the voltage joins pieces over any time.  Every
fit and every error leaves out a gap, and the time `SETTLING` after it.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.record.record import Piece, Record, Segment

#: longest gap that is bridged by a straight line [s]
LONGEST = 1.0
#: most lost readings in a row that a regression or a spectrum runs over
FEW = 9
#: time after a gap in which the dynamics answer to the voltage in the gap [s]
SETTLING = 0.01


@dataclass(frozen=True, eq=False)
class Bridged:
    """
    A piece with its gaps filled.

    `sound` samples were measured without a fault, and `SETTLING` after a gap.  `gaps` and `filled`
    count the gaps without a voltage, and their samples.
    """

    piece: Piece
    sound: Mask
    gaps: int = 0
    filled: int = 0


def follows(one: Piece, other: Piece) -> int | None:
    """Return the number of missing samples between pieces; None for different clocks."""
    if abs(other.sample_rate / one.sample_rate - 1.0) > 1e-6:
        return None
    elapsed = (other.start_time - one.start_time) * one.sample_rate
    missing = round(elapsed) - one.n
    longest = max(LONGEST * one.sample_rate, other.before.n if other.before else 0)
    # ticks of one clock, however it was rounded in the file
    if abs(elapsed - round(elapsed)) > 0.1 or not 0 <= missing <= longest:
        return None
    return missing


def played_before(one: Piece, other: Piece) -> Piece | None:
    """Return the samples between two pieces whose displacement alone is unknown."""
    before = other.before
    return before if before is not None and before.n == follows(one, other) else None


def connected_pieces(record: Record) -> list[list[Piece]]:
    """Return the pieces of a record in groups with short gaps."""
    groups: list[list[Piece]] = []
    for piece in record:
        connects = groups and follows(groups[-1][-1], piece) is not None
        if connects and set(groups[-1][-1].channels) == set(piece.channels):
            groups[-1].append(piece)
        else:
            groups.append([piece])
    return groups


def bridged(record: Record) -> list[Bridged]:
    """Join each group of `connected_pieces` of a record over its short gaps."""
    return [_joined(group) for group in connected_pieces(record)]


def _joined(pieces: list[Piece]) -> Bridged:
    first = pieces[0]
    if len(pieces) == 1:
        return Bridged(first, first.mask)
    starts = [0]
    for one, other in itertools.pairwise(pieces):
        starts.append(starts[-1] + one.n + (follows(one, other) or 0))
    n = starts[-1] + pieces[-1].n
    played: list[tuple[int, Piece]] = [(0, first)]
    for (one, other), start in zip(itertools.pairwise(pieces), starts[1:], strict=True):
        if before := played_before(one, other):
            played.append((start - before.n, before))
        played.append((start, other))

    def fill(parts: list[tuple[int, Array]]) -> tuple[Array, Mask]:
        known = np.zeros(n, dtype=bool)
        for start, x in parts:
            known[start : start + x.size] = True
        values = np.concatenate([x for _, x in parts])
        return np.interp(np.arange(n), np.flatnonzero(known), values), known

    y, measured = fill([(start, p.y) for start, p in zip(starts, pieces, strict=True)])
    v, driven = fill([(start, p.v) for start, p in played])
    sound = measured.copy()
    for piece, start in zip(pieces, starts, strict=True):
        sound[start : start + piece.n] = piece.mask
    settle = max(1, round(SETTLING * first.sample_rate))
    for start in starts[1:]:
        sound[start : start + settle] = False
    return Bridged(
        piece=Piece(
            v=v,
            y=y,
            sample_rate=first.sample_rate,
            start_time=first.start_time,
            segments=_segments(pieces, starts),
            channels={
                k: fill([(start, p.channels[k]) for start, p in played])[0] for k in first.channels
            },
            sound=sound if any(p.sound is not None for p in pieces) else None,
        ),
        sound=sound,
        gaps=len(true_runs(~driven)),
        filled=int(n - driven.sum()),
    )


def _segments(pieces: list[Piece], starts: list[int]) -> tuple[Segment, ...]:
    """Return the segments on the joined clock; a gap does not end a segment."""
    segments: list[Segment] = []
    end = 0
    for piece, start in zip(pieces, starts, strict=True):
        for s in piece.segments:
            moved = Segment(s.label, s.start + start, s.stop + start)
            goes_on = s.start == 0 and segments and segments[-1].stop == end and start > 0
            if goes_on and segments[-1].label == s.label:
                segments[-1] = Segment(s.label, segments[-1].start, moved.stop)
            else:
                segments.append(moved)
        end = start + piece.n
    return tuple(segments)
