# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Take the axes of a record apart.

An axis has the name of its displacement in a record:

| axis | voltage | displacement | its motion, as a channel of the others |
|---|---|---|---|
| first | ``v`` | ``y`` | ``motion`` |
| ``b`` | ``v_b`` | ``y_b`` | ``motion_b`` |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array, interpolated
from piezo_ident.common.errors import DataError
from piezo_ident.record.channels import role_of
from piezo_ident.record.record import Piece, Record

MOTION = 'motion'


def voltage_of(axis: str) -> str:
    """
    Name the column of the voltage of an axis.

    >>> voltage_of('y'), voltage_of('y_b')
    ('v', 'v_b')
    """
    return f'v{axis[1:]}'


def motion_of(axis: str) -> str:
    """Name the channel with the motion of an axis by its own voltage."""
    return f'{MOTION}{axis[1:]}'


def axes_of(records: Sequence[Record]) -> tuple[str, ...]:
    """
    List the axes whose voltage and displacement the records hold; the first axis is ``y``.

    Raises
    ------
    DataError
        When the records do not hold the same axes.
    """
    of_each = [
        (
            record.name,
            'y',
            *sorted(k for k in p.channels if role_of(k) == 'y' and voltage_of(k) in p.channels),
        )
        for record in records
        for p in record
    ]
    if len({axes[1:] for axes in of_each}) > 1:
        told = '; '.join(f'{name} holds {", ".join(axes)}' for name, *axes in of_each)
        raise DataError(f'{told}; give records of the same axes')
    return next(iter(of_each), ('', 'y'))[1:]


def is_measured(record: Record, axis: str) -> bool:
    """Tell whether a record holds the displacement of an axis."""
    return all(np.isfinite(columns_of(p).get(axis, np.nan)).any() for p in record)


def axis_record(
    record: Record, axis: str, motions: Mapping[str, Sequence[Array]] | None = None
) -> Record:
    """
    Reduce a record to one axis.

    Parameters
    ----------
    record : Record
    axis : str
        The voltage and displacement of this axis become v and y.  A segment in which the axis
        rests loses its label.
    motions : mapping of str to sequence of ndarray, optional
        Motions by axis, an array for each piece [m].  Those of the other axes become channels.
    """
    span = max(float(np.ptp(columns_of(p)[voltage_of(axis)])) for p in record)

    def seen(piece: Piece, moved: Mapping[str, Array]) -> Piece:
        columns = columns_of(piece)
        v, sound = columns[voltage_of(axis)], piece.sound
        y = columns.get(axis, np.full(piece.n, np.nan))
        if axis != 'y':
            known = np.isfinite(y)
            sound = None if known.all() or not known.any() else known
            y = y if sound is None else interpolated(y, ~known)
        kept = (s for s in piece.segments if np.ptp(v[s.start : s.stop]) > 1e-3 * span)
        before = piece.before and seen(
            piece.before, {k: np.full(piece.before.n, m[0]) for k, m in moved.items()}
        )
        others = {k: x for k, x in piece.channels.items() if not role_of(k)}
        return replace(
            piece,
            v=v,
            y=y,
            sound=sound,
            segments=tuple(kept),
            before=before,
            channels={**others, **{motion_of(k): m for k, m in moved.items()}},
        )

    pieces = tuple(
        seen(piece, {k: m[i] for k, m in (motions or {}).items() if k != axis})
        for i, piece in enumerate(record)
    )
    return Record(pieces, record.name, record.faults)


def columns_of(piece: Piece) -> dict[str, Array]:
    """List all signals of a piece by their columns: voltages, displacements, further channels."""
    return {**piece.channels, 'v': piece.v, 'y': piece.y}
