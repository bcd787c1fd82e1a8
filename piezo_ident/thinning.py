# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
A long record, thinned to whole sections that stand for it.

An hour at 20 kHz has no more to say about hysteresis and dynamics than minutes of it, but it says
it in twelve times the memory.  So the record is cut where the stage is at rest, its memory
known, and sections are kept that

1. hold every kind of segment that there is,
2. hold as many of its labels as fit into half of what is kept,
3. are spread evenly over the time, first and last of all,

until the samples asked for are reached.  What lasts (creep, drift, hum) keeps its absolute time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import itertools

import numpy as np
from piezo_ident.record import Piece, Record

__all__ = ['MOST', 'thinned']

#: samples that are looked at as they are: five minutes at 20 kHz
MOST = 6_000_000
#: a section is at least this share of what is kept
SHORTEST = 1 / 60
#: the stage is at rest within this share of the range above the lowest voltage
REST = 0.01

#: number of the record and the piece, first sample and the one behind the last
Section = tuple[int, int, int, int]


def thinned(records: Sequence[Record], most: int = MOST) -> tuple[list[Record], str]:
    """
    Return records of about so many samples, and what was left out.

    Parameters
    ----------
    records : sequence of Record
    most : int, optional
        Samples in all.

    Returns
    -------
    records : list of Record
        The same ones where they are not longer than that.
    said : str
        One line for people; empty when nothing was left out.
    """
    total = sum(record.n for record in records)
    if total <= most:
        return list(records), ''
    low = min(record.voltage_range[0] for record in records)
    high = max(record.voltage_range[1] for record in records)
    sections = [
        (i, j, start, stop)
        for i, record in enumerate(records)
        for j, piece in enumerate(record)
        for start, stop in _sections(piece, low + REST * (high - low), int(SHORTEST * most))
    ]
    kept = sorted(_chosen(sections, records, most))
    found = [_rebuilt(records[i], [s for s in kept if s[0] == i]) for i in _in_order(kept)]
    n = sum(record.n for record in found)
    said = (
        f'{len(kept)} of {len(sections)} sections, {n} of {total} samples, stand for the whole: '
        'every kind of segment, and what is spread evenly over the time'
    )
    return found, said


def _in_order(kept: Sequence[Section]) -> list[int]:
    return list(dict.fromkeys(section[0] for section in kept))


def _sections(piece: Piece, rest: float, shortest: int) -> list[tuple[int, int]]:
    """Cut a piece where it is at rest, into sections of at least so many samples."""
    calm = piece.v <= rest
    # the first sample of each stretch at rest
    rests = np.flatnonzero(calm[1:] & ~calm[:-1]) + 1
    if not rests.size:
        # its memory is never known; every place is as good
        rests = np.arange(shortest, piece.n, shortest)
    marks = [0]
    for at in rests.tolist():
        if at - marks[-1] >= shortest and piece.n - at >= shortest:
            marks.append(at)
    return list(itertools.pairwise([*marks, piece.n]))


def _labels(records: Sequence[Record], section: Section) -> set[str]:
    i, j, start, stop = section
    segments = records[i].pieces[j].segments
    return {s.label for s in segments if s.start < stop and s.stop > start}


def _chosen(sections: Sequence[Section], records: Sequence[Record], most: int) -> list[Section]:
    order = _spread(len(sections))
    labels = [_labels(records, section) for section in sections]
    kinds = [{label.partition(':')[0] for label in found} for found in labels]
    chosen: dict[int, None] = {}
    taken = 0
    # labels may all differ, so that half is left for what is spread
    for marks, limit in ((kinds, most), (labels, most // 2), (None, most)):
        seen: set[str] = set()
        for k in order:
            _, _, start, stop = sections[k]
            new = marks is None or not marks[k] <= seen
            if new and (k in chosen or taken + stop - start <= limit or not chosen):
                seen |= marks[k] if marks is not None else set()
                taken += 0 if k in chosen else stop - start
                chosen[k] = None
    return [sections[k] for k in chosen]


def _spread(n: int) -> list[int]:
    """Return 0 .. n-1, first the ends, then halves of halves: wherever it ends it is spread."""
    order, depth = {0: None, n - 1: None}, 1
    while len(order) < n:
        steps = 2**depth
        order.update(dict.fromkeys(k * (n - 1) // steps for k in range(1, steps, 2)))
        depth += 1
    return list(order)


def _rebuilt(record: Record, kept: Sequence[Section]) -> Record:
    """Return a record of some of its sections; neighbours stay one piece."""
    spans: list[list[int]] = []
    for _, j, start, stop in kept:
        if spans and spans[-1][0] == j and spans[-1][2] == start:
            spans[-1][2] = stop
        else:
            spans.append([j, start, stop])
    pieces = [record.pieces[j].cut(start, stop) for j, start, stop in spans]
    return replace(record, pieces=tuple(pieces))
