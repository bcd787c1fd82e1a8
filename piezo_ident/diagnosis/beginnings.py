# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Of long records the beginnings are searched, and what follows is the check.

A search holds about 500 bytes a sample, so an hour at 20 kHz would take more memory than a
computer of the lab has.  Sections spread over the record will not do: creep and hysteresis come
out of what was before a section, and only a beginning has nothing before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.diagnosis.verdict import SMALLEST
from piezo_ident.effects import find_effect
from piezo_ident.identification.prepare import same_rate
from piezo_ident.model.initial_memory import connected_pieces, start_memory
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record

__all__ = ['Rest', 'beginnings', 'rest_of', 'said_of', 'share_of']

#: samples that are predicted at once
WINDOW = 1_000_000
#: how much larger the error behind the beginning is where something has changed
WORSE = 2.0


@dataclass(frozen=True)
class Rest:
    """
    Free-run errors of a model on what was searched, on what was not, and on all, % of stroke.

    ``100 rms(y - y_hat) / (max y - min y)``; the offset of each record is that of what was
    searched.
    """

    used: float
    unused: float
    all: float


def beginnings(model: StageModel, records: Sequence[Record], most: int) -> list[Record]:
    """
    Return the beginnings of records, in proportion to their lengths.

    Parameters
    ----------
    model : StageModel
        Pieces of another sampling rate are left out.
    records : sequence of Record
    most : int
        Samples of all beginnings together; records that have no more come back as they are.
    """
    found = [(record, [p for p in record if _fits(model, p)]) for record in records]
    total = sum(p.n for _, pieces in found for p in pieces)
    if total <= most:
        return list(records)
    cut = []
    for record, pieces in found:
        begun = _begun(pieces, max(1, sum(p.n for p in pieces) * most // total))
        if begun:
            cut.append(Record(tuple(begun), record.name, record.faults))
    return cut


def _fits(model: StageModel, piece: Piece) -> bool:
    return same_rate(piece.sample_rate, model.sample_rate)


def _neighbours(record: Record) -> Iterator[tuple[Piece | None, Piece]]:
    for pieces in connected_pieces(record):
        yield from zip((None, *pieces[:-1]), pieces, strict=True)


def _begun(pieces: Sequence[Piece], n: int) -> list[Piece]:
    begun: list[Piece] = []
    for piece in pieces:
        if n <= 0:
            break
        begun.append(piece if piece.n <= n else piece.cut(0, n))
        n -= begun[-1].n
    return begun


def rest_of(
    model: StageModel,
    records: Sequence[Record],
    used: Sequence[Record],
    tick: Callable[[], None] = lambda: None,
) -> Rest:
    """
    Return the errors of a model before and behind the ends of the beginnings.

    Parameters
    ----------
    model : StageModel
    records, used : sequence of Record
        Whole records, and their beginnings.
    tick : callable, optional
        Called window by window; may raise `piezo_ident.common.errors.Cancelled`.

    Raises
    ------
    ModelError
        When an effect of the model cannot run on a piece.
    """
    begun = {record.name: record.n for record in used}
    stroke = max(record.stroke for record in records)
    # number, sum and sum of squares of y - y_hat, of what was used and what was not
    totals, counts = np.zeros(2), np.zeros(2)
    for record in records:
        sums = np.zeros((2, 3))
        left = begun.get(record.name, 0)
        for before, piece in _neighbours(record):
            if not _fits(model, piece):
                continue
            if before is None:
                stream = model.stream(start_memory(model, piece))
            else:
                stream.bridge(before, piece)
            start = 0
            while start < piece.n:
                tick()
                # a window lies on one side of the end
                stop = min(start + WINDOW, piece.n, start + left if left > 0 else piece.n)
                part = piece.cut(start, stop)
                e = part.y - stream.follow(part)
                sums[0 if left > 0 else 1] += e.size, e.sum(), e @ e
                left -= stop - start
                start = stop
        n, total, squares = sums.T
        offset = (total[0] if n[0] else total.sum()) / max(n[0] or n.sum(), 1.0)
        totals += squares - 2.0 * offset * total + n * offset**2
        counts += n
    totals, counts = np.append(totals, totals.sum()), np.append(counts, counts.sum())
    rms = np.sqrt(np.maximum(totals, 0.0) / np.maximum(counts, 1.0))
    return Rest(*(100.0 * rms / stroke).tolist())


def said_of(
    given: StageModel,
    refined: StageModel,
    records: Sequence[Record],
    used: Sequence[Record],
    fitted: str,
    tick: Callable[[], None] = lambda: None,
) -> str:
    """
    Return what a reader has to know of samples that were not searched.

    Parameters
    ----------
    given, refined : StageModel
    records, used : sequence of Record
        Whole records, and their beginnings.
    fitted : str
        How what was found was fitted.
    tick : callable, optional
        See `rest_of`.

    Raises
    ------
    ModelError
        When an effect of a model cannot run on a piece.
    """
    before, after = (rest_of(model, records, used, tick) for model in (given, refined))
    text = (
        f'{share_of(records, used)}; {fitted}; on the rest the model errs by {before.unused:.3g} '
        f'% of stroke as given and by {after.unused:.3g} % refined, on what was searched by '
        f'{after.used:.3g} %'
    )
    # what follows time is switched off in the refined model
    driven = [s.name for s in refined.effects if find_effect(s.name).time_driven]
    if after.unused > max(WORSE * after.used, SMALLEST) and not driven:
        text += '; something changes later: give that part as a record of its own'
    return text


def share_of(records: Sequence[Record], used: Sequence[Record]) -> str:
    """Return how much of the records was searched."""
    n, of = (sum(r.n for r in some) for some in (used, records))
    seconds, whole = (sum(r.duration for r in some) for some in (used, records))
    return (
        f'{n:,} of {of:,} samples were searched, the first {seconds:.4g} s of {whole:.4g} s '
        '(--most-samples)'
    )
