# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Tables written part by part, to the bytes that writing them at once gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, ExitStack
import csv
import io
from pathlib import Path
import shutil
import tempfile
from typing import Any, BinaryIO
import zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ['PART_WRITERS', 'AddRows', 'csv_parts', 'npz_parts']

#: rows of a CSV file taken together
_ROWS = 65536

#: takes the next rows of each column
AddRows = Callable[[Mapping[str, NDArray[np.float64]]], None]


@contextmanager
def csv_parts(
    file: BinaryIO, columns: Sequence[str], names: Sequence[str] = (), starts: ArrayLike = ()
) -> Iterator[AddRows]:
    """
    Write a CSV file whose numbers read back exactly.

    Parameters
    ----------
    file : binary file
    columns : sequence of str
        Their names, in order.
    names, starts : sequence of str, array_like of int
        Label of each stretch and the row at which it begins; no names, no column of labels.

    Yields
    ------
    callable
        Takes the next rows.
    """
    first = np.asarray(starts, dtype=np.int64)
    labels = [_quoted(name) for name in names]
    header = [*columns, *(['segment'] if labels else [])]
    file.write((','.join(header) + '\n').encode())
    written = 0

    def add(part: Mapping[str, NDArray[np.float64]]) -> None:
        nonlocal written
        n = part[columns[0]].size
        for i in range(0, n, _ROWS):
            texts: list[Iterable[str]] = [
                map(repr, part[name][i : i + _ROWS].tolist()) for name in columns
            ]
            if labels:
                rows = written + np.arange(i, min(i + _ROWS, n))
                texts.append(labels[j] for j in np.searchsorted(first, rows, 'right') - 1)
            lines = map(','.join, zip(*texts, strict=True))
            file.write(('\n'.join(lines) + '\n').encode())
        written += n

    yield add


def _quoted(text: str) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator='').writerow([text, ''])
    return line.getvalue()[:-1]


@contextmanager
def npz_parts(
    file: BinaryIO, columns: Sequence[str], names: Sequence[str] = (), starts: ArrayLike = ()
) -> Iterator[AddRows]:
    """
    Write a NumPy archive, by way of a file for each column in the same folder.

    Parameters
    ----------
    file, columns, names, starts
        As for `csv_parts`.

    Yields
    ------
    callable
        Takes the next rows.
    """
    folder = Path(file.name).parent
    with ExitStack() as stack:
        stores = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=folder)) for name in columns
        }

        def add(part: Mapping[str, NDArray[np.float64]]) -> None:
            for name, store in stores.items():
                store.write(np.ascontiguousarray(part[name], dtype='<f8').data)

        yield add
        with zipfile.ZipFile(file, 'w', allowZip64=True) as archive:
            for name, store in stores.items():
                size = store.tell() // 8
                store.seek(0)
                head = {'descr': '<f8', 'fortran_order': False, 'shape': (size,)}
                with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                    to: Any = member  # the stubs know other files only
                    np.lib.format.write_array_header_1_0(to, head)
                    shutil.copyfileobj(store, member, 1 << 20)
            if names:
                for name, x in (
                    ('segment_name', np.array(names)),
                    ('segment_start', np.asanyarray(starts)),
                ):
                    with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                        to = member
                        np.lib.format.write_array(to, x, allow_pickle=False)


#: by suffix
PART_WRITERS: Mapping[str, Callable[..., AbstractContextManager[AddRows]]] = {
    '.csv': csv_parts,
    '.npz': npz_parts,
}
