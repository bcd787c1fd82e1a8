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
Of long records the beginnings are searched, and what follows is the check.

A diagnosis holds about 500 bytes a sample, so an hour at 20 kHz would take more memory than a
computer of the lab has.  Sections spread over the record will not do: creep and hysteresis come
out of what was before a section, and only a beginning has nothing before it.  A free run over the
rest takes no memory to speak of, and shows whether what was found goes on to hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.diagnosis.verdict import SMALLEST
from piezo_ident.memory import memories_of
from piezo_ident.model import StageModel
from piezo_ident.record import Record

__all__ = ['Rest', 'beginnings', 'rest_of', 'said_of']

#: samples that are predicted at once
WINDOW = 1_000_000
#: how much larger the error behind the beginning is where something has changed
WORSE = 2.0


@dataclass(frozen=True)
class Rest:
    """
    Free-run errors of a model on what was used, on what was not, and on all, % of stroke.

    ``100 rms(y - y_hat) / (max y - min y)``; the offset of each record is that of what was used.
    """

    used: float
    unused: float
    all: float


def beginnings(records: Sequence[Record], most: int) -> list[Record]:
    """
    Return the beginnings of records, in proportion to their lengths.

    Parameters
    ----------
    records : sequence of Record
    most : int
        Samples of all beginnings together; records that have no more come back as they are.
    """
    total = sum(record.n for record in records)
    if total <= most:
        return list(records)
    return [_beginning(record, max(1, record.n * most // total)) for record in records]


def _beginning(record: Record, n: int) -> Record:
    pieces = []
    for piece in record:
        pieces.append(piece if piece.n <= n else piece.cut(0, n))
        n -= pieces[-1].n
        if n == 0:
            break
    return Record(tuple(pieces), record.name, record.faults)


def rest_of(model: StageModel, records: Sequence[Record], used: Sequence[Record]) -> Rest:
    """
    Return the errors of a model before and behind the ends of the beginnings.

    Parameters
    ----------
    model : StageModel
    records, used : sequence of Record
        Whole records, and their beginnings.
    """
    stroke = max(r.stroke for r in records)
    # number, sum and sum of squares of y - y_hat, of what was used and what was not
    totals = np.zeros(2)
    counts = np.zeros(2)
    for record, beginning in zip(records, used, strict=True):
        sums = np.zeros((2, 3))
        left = beginning.n
        for piece, memory in zip(record, memories_of(model, record), strict=True):
            if not model.takes(piece):
                left -= piece.n
                continue
            stream = model.stream(memory)
            start = 0
            while start < piece.n:
                # a window lies on one side of the end
                stop = min(start + WINDOW, piece.n, start + left if left > 0 else piece.n)
                part = piece.cut(start, stop)
                e = part.y - stream.follow(part)
                sums[0 if left > 0 else 1] += e.size, e.sum(), e @ e
                left -= stop - start
                start = stop
        n, total, squares = sums.T
        offset = total[0] / max(n[0], 1.0)
        totals += squares - 2.0 * offset * total + n * offset**2
        counts += n
    totals, counts = np.append(totals, totals.sum()), np.append(counts, counts.sum())
    rms = np.sqrt(np.maximum(totals, 0.0) / np.maximum(counts, 1.0))
    return Rest(*(100.0 * rms / stroke).tolist())


def said_of(
    given: StageModel, refined: StageModel, records: Sequence[Record], used: Sequence[Record]
) -> str:
    """Return what a reader has to know of samples that were not used."""
    before, after = (rest_of(model, records, used) for model in (given, refined))
    n, of = (sum(r.n for r in some) for some in (used, records))
    seconds, whole = (sum(r.duration for r in some) for some in (used, records))
    text = (
        f'{n:,} of {of:,} samples were searched, the first {seconds:.4g} s of {whole:.4g} s '
        f'(--most-samples): on the rest the model errs by {before.unused:.3g} % of stroke as '
        f'given and by {after.unused:.3g} % refined, on what was searched by {after.used:.3g} %'
    )
    if after.unused > max(WORSE * after.used, SMALLEST):
        text += '; something changes later: give that part as a record of its own'
    return text
