# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Turn records into named columns, and write NumPy's npz and MATLAB's mat.

``v_<name>`` and ``y_<name>`` are further axes, ``x_<name>`` further channels.  npz and mat hold
``segment_name`` and ``segment_start``, the first sample of each segment, counted from 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO
import zipfile

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.record.channels import column_of
from piezo_ident.record.record import Record

#: yields the columns block by block, each time it is called
Blocks = Callable[[], Iterator[Mapping[str, Array]]]

#: rows that are read and written together
ROWS = 65536


def blocks_of(record: Record, **further: Sequence[Array]) -> Blocks:
    """
    Return the columns of a record for the writers, its pieces one below the other.

    Further columns, one array a piece, replace the channels.
    """

    def blocks() -> Iterator[Mapping[str, Array]]:
        for i, piece in enumerate(record):
            own = {column_of(name): x for name, x in piece.channels.items()}
            own = {name: parts[i] for name, parts in further.items()} if further else own
            for a in range(0, piece.n, ROWS):
                columns = {'t': piece.time(a, a + ROWS)}
                for name, x in {'v': piece.v, 'y': piece.y, **own}.items():
                    columns[name] = x[a : a + ROWS]
                yield columns

    return blocks


def labels_of(record: Record) -> tuple[list[str], list[int]]:
    """Return the label and the first row of each stretch; empty for an unlabelled record."""
    labels: list[tuple[str, int]] = []
    offset = 0
    for piece in record:
        end = offset
        for s in piece.segments:
            labels += [('', end)] if offset + s.start > end else []
            labels.append((s.label, offset + s.start))
            end = offset + s.stop
        offset += piece.n
        labels += [('', end)] if end < offset else []
    names, starts = [name for name, _ in labels], [start for _, start in labels]
    return (names, starts) if any(names) else ([], [])


def write_npz(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a NumPy archive, one column after the other."""
    size = sum(block['t'].size for block in blocks())
    head = {'descr': '<f8', 'fortran_order': False, 'shape': (size,)}
    labels = {'segment_name': np.array(names), 'segment_start': np.array(starts)} if names else {}
    with zipfile.ZipFile(file, 'w', allowZip64=True) as archive:
        for name in (*next(blocks()), *labels):
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                to: Any = member  # the stubs know other files only
                if name in labels:
                    np.lib.format.write_array(to, labels[name], allow_pickle=False)
                    continue
                np.lib.format.write_array_header_1_0(to, head)
                for block in blocks():
                    member.write(np.ascontiguousarray(block[name], dtype='<f8').data)


def write_mat(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a MATLAB 5 file of column vectors."""
    import scipy.io  # takes longer than a short command

    parts = list(blocks())
    arrays: dict[str, Any] = {k: np.concatenate([block[k] for block in parts]) for k in parts[0]}
    if names:
        cells = np.empty(len(names), dtype=object)
        cells[:] = names
        arrays |= {'segment_name': cells, 'segment_start': np.asarray(starts, dtype=np.float64)}
    to: Any = file  # the stubs know paths only
    scipy.io.savemat(to, arrays, oned_as='column', long_field_names=True)
