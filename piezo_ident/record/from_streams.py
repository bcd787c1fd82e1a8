# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""A record from streams of blocks, whether they come live or from a bag."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.record.assemble import assemble, ReadOptions
from piezo_ident.record.join import join
from piezo_ident.record.ordering import at_times
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.stream import BlockStream

__all__ = [
    'APPLIED',
    'SPARSE',
    'record_of_streams',
    'tolerance_of',
]

#: key of what the amplifier got, which carries the quantity voltage
APPLIED = 'applied_voltage'
#: commanded and applied voltage may differ by this share of the range
TOLERANCE = 1e-3
#: fault of a further channel of a lower rate, or that ended early
SPARSE = 'sparse_channel'
#: most of a segment by time, or of a further channel, that may be missing before it is not used
MAX_MISSING = 0.05


def record_of_streams(
    streams: Mapping[str, BlockStream],
    *,
    name: str,
    tolerance: float | None = None,
    options: ReadOptions | None = None,
    sample_rate: float | None = None,
    faults: Iterable[Fault] = (),
) -> Record:
    """
    Make a record of streams of blocks.

    Parameters
    ----------
    streams : mapping of str to BlockStream
        Those of ``voltage``, ``displacement``, ``x_<name>``, and ``applied_voltage``.  Where
        command and applied voltage differ, the amplifier's guard was at work: the stage did not
        get the command, so these samples are cut out.  An ``x_<name>`` that lacks more than
        `MAX_MISSING` of the samples is left out.
    name : str
        What errors call the data, and the record's name.
    tolerance : float, optional
        Difference of command and applied voltage that counts as none [V]; a thousandth of the
        range when absent.
    options, sample_rate, faults
        As for `piezo_ident.record.assemble.assemble`.

    Raises
    ------
    DataError
        For data that cannot be used without a guess.
    """
    sparse = _sparse(streams)
    needed = {key: s for key, s in streams.items() if key != APPLIED and key not in sparse}
    try:
        joined = join(needed, {APPLIED: streams[APPLIED]} if APPLIED in streams else None)
    except DataError as error:
        raise DataError(f'{name}: {error}') from None
    met, t, columns, segments = (
        [*faults, *sparse.values(), *joined.faults],
        joined.t,
        joined.columns,
        joined.segments,
    )
    if APPLIED in columns and np.array_equal(columns['voltage'], columns[APPLIED]):
        del columns[APPLIED]
    if APPLIED in columns:
        v, applied = columns['voltage'], columns.pop(APPLIED)
        wrong = _guarded(v, applied, tolerance)
        unknown = int(np.count_nonzero(np.isnan(applied)))
        if unknown:
            where = at_times(t[np.isnan(applied)][:1])
            met.append(Fault('applied_unknown', where, unknown, 'taken as commanded'))
        if wrong.any():
            if wrong.all():
                raise DataError(
                    f'{name}: the applied voltage is nowhere the commanded one; look at the '
                    "guards of the amplifier's driver"
                )
            worst = float(np.abs(v - applied)[wrong].max())
            where = f'{at_times(t[_begins(wrong)])}, by up to {worst:.3g} V'
            count = int(np.count_nonzero(wrong))
            met.append(Fault('guarded_voltage', where, count, 'cut out, record split there'))
            keep = np.flatnonzero(~wrong)
            names, starts = segments
            t, columns = t[keep], {key: x[keep] for key, x in columns.items()}
            segments = (names, np.searchsorted(keep, starts).tolist())
    return assemble(
        t,
        columns.pop('voltage'),
        columns.pop('displacement'),
        segments,
        {key[2:]: x for key, x in columns.items()},
        name=name,
        options=options,
        sample_rate=sample_rate,
        faults=met,
    )


def _sparse(streams: Mapping[str, BlockStream]) -> dict[str, Fault]:
    """Return the further channels for whose sake too many other samples would be cut out."""
    n = min(streams['voltage'].n, streams['displacement'].n)
    return {
        key: Fault(SPARSE, f'{key}, {stream.n} samples beside {n}', n - stream.n, 'left out')
        for key, stream in streams.items()
        if key.startswith('x_') and stream.n < (1.0 - MAX_MISSING) * n
    }


def tolerance_of(v: NDArray[np.float64]) -> float:
    """Return the difference of command and applied voltage that counts as none [V]."""
    finite = v[np.isfinite(v)]
    span = float(np.ptp(finite)) if finite.size else 0.0
    return TOLERANCE * (span or float(np.abs(finite).max(initial=1.0)))


def _guarded(
    v: NDArray[np.float64], applied: NDArray[np.float64], tolerance: float | None
) -> NDArray[np.bool_]:
    """Tell where another voltage was applied than commanded."""
    if tolerance is None:
        tolerance = tolerance_of(v)
    return np.asarray(np.abs(v - applied) > tolerance)  # False where either is NaN


def _begins(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.flatnonzero(mask & ~np.concatenate([[False], mask[:-1]]))
