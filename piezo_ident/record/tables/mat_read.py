# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Read MATLAB files by SciPy in a child process.

SciPy's reader takes memory for any shape that a damaged file announces, and some damage ends its
process with SIGSEGV.  A child process therefore reads the file, with a limit on its memory, and
sends the columns back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
import json
import math
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
from typing import Any, cast, IO, TypeAlias

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.files import UNPACKED_SIZE

#: most columns of a matrix, and most structs of an array of structs
WIDTH = 32
#: fields with the samples of a signal in files of dSPACE's ControlDesk and of Simulink; the name
#: of the signal is a field beside it
_TITLED = ('Data', 'values')

#: names, columns, and names of columns by the paths to them
Columns: TypeAlias = tuple[tuple[str, ...], dict[str, NDArray[Any]], dict[str, str]]


def read_variables(path: Path, wanted: str, needed: Iterable[str] | None) -> Columns:
    """
    Return the names of all variables of a MATLAB file of version 4 to 7, and the wanted ones.

    `wanted` is a regular expression; numbers keep their shape, texts and cells of texts become
    arrays of str.  If the file lacks a `needed` variable, or `needed` is None, the result is all
    columns of numbers with their names instead, also columns in structs (see `flat`).
    The last mapping gives the name of a column by the path to it, if a title names the column.
    ValueError for a damaged or too large file, or a wanted variable without numbers or texts.
    """
    asked = str(path), wanted, '*' if needed is None else ','.join(needed)
    command = [sys.executable, '-m', __name__, *asked]
    # the child imports from the places of this process
    env = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(
            command,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
        ) as child,
    ):
        result = None
        # a child that fails sends nothing, or only a part
        with suppress(TypeError, ValueError):
            result = _received(cast('IO[bytes]', child.stdout))
        if child.wait() or result is None:
            errors.seek(0)
            lines = errors.read().decode(errors='replace').strip().splitlines()
            raise ValueError(lines[-1] if lines else f'SciPy ended with {child.returncode}')
    return result


def _send(columns: Columns, to: IO[bytes]) -> None:
    names, arrays, paths = columns
    kinds = {name: (x.dtype.str, x.shape) for name, x in arrays.items()}
    to.write(json.dumps([names, kinds, paths]).encode() + b'\n')
    for x in arrays.values():
        # a view: a copy would halve the length of a record that fits into the memory
        to.write(np.ascontiguousarray(x).reshape(-1).view(np.uint8).data)


def _received(source: IO[bytes]) -> Columns:
    names, kinds, paths = json.loads(source.readline())
    arrays = {}
    for name, (kind, shape) in kinds.items():
        dtype = np.dtype(kind)
        data = source.read(dtype.itemsize * math.prod(shape))
        arrays[name] = np.ndarray(shape, dtype, data)
    return tuple(names), arrays, paths


def _read(path: str, wanted: str, asked: str) -> Columns:
    """Read a file in the child; see `read_variables`."""
    import scipy.io

    names = [name for name, *_ in scipy.io.whosmat(path)]
    has_all = {*asked.split(',')} <= {*names}
    used = [name for name in names if not has_all or re.fullmatch(wanted, name)]
    # without names SciPy would read all variables
    read = scipy.io.loadmat(path, variable_names=used) if used else {}
    arrays: dict[str, Any] = {}
    paths: dict[str, str] = {}
    for name in used:
        value = read[name]
        if has_all or name == 'segment_name':
            arrays[name] = _plain(name, value)
            continue
        columns = [*flat(name, value)]
        plain = flat(name, value, titled=False)
        paths |= {p: key for (p, _), (key, _) in zip(plain, columns, strict=True) if p != key}
        arrays |= columns
    return tuple(names if has_all else arrays), arrays, paths


def flat(name: str, value: Any, *, titled: bool = True) -> Iterator[tuple[str, NDArray[Any]]]:
    """
    Yield the columns of numbers in a variable: fields of structs, columns of narrow matrices.

    With `titled`, the name beside the samples of a signal replaces their path.

    >>> import numpy as np
    >>> [(name, x.size) for name, x in flat('m', np.zeros((100, 2)))]
    [('m.1', 100), ('m.2', 100)]
    >>> [name for name, _ in flat('s', np.zeros(9, dtype=[('t', float), ('u', float)]))]
    ['s.t', 's.u']
    """
    x = value if isinstance(value, np.ndarray) else np.asarray(value)
    for key in x.dtype.names or ():
        part = x[key]
        if part.dtype != object:
            yield from flat(f'{name}.{key}', part, titled=titled)
        elif part.size <= WIDTH:
            is_titled = titled and key in _TITLED
            titles = [_title(struct) if is_titled else '' for struct in x.ravel()]
            for i, (title, cell) in enumerate(zip(titles, part.ravel(), strict=True), 1):
                plain = key if part.size == 1 else f'{i}.{key}'
                # two signals may have one title
                title = title if titles.count(title) == 1 else ''
                yield from flat(f'{name}.{title or plain}', cell, titled=titled)
    if x.dtype.kind in 'biufM':
        if sum(size != 1 for size in x.shape) <= 1:
            yield name, x.ravel()
        elif x.ndim == 2 and min(x.shape) <= WIDTH:
            for i, column in enumerate(x if x.shape[0] < x.shape[1] else x.T, 1):
                yield f'{name}.{i}', column


def _title(struct: Any) -> str:
    """Return the name and the unit of the data of a struct, empty without a name."""
    texts = [
        str(np.ravel(struct[key])[0])
        for key in ('Name', 'label', 'Unit')
        if key in struct.dtype.names and np.ravel(struct[key]).dtype.kind == 'U'
        if np.size(struct[key])
    ]
    # the end of a path through a model
    name = re.sub(r'.*/|["{}.]', '', texts[0]) if texts else ''
    return f'{name} [{texts[1]}]' if name and len(texts) > 1 else name


def _plain(name: str, array: Any) -> NDArray[Any]:
    if isinstance(array, np.ndarray) and array.dtype.kind in 'bfiucU':
        return array
    cells = [np.ravel(cell) for cell in array.ravel()] if isinstance(array, np.ndarray) else []
    if not cells or not all(cell.dtype.kind == 'U' and cell.size <= 1 for cell in cells):
        raise ValueError(f'{name} holds something else than numbers or texts')
    return np.array([''.join(cell.tolist()) for cell in cells])


if __name__ == '__main__':
    with suppress(ImportError, OSError, ValueError):
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (UNPACKED_SIZE, most))
    try:
        _send(_read(*sys.argv[1:]), sys.stdout.buffer)
    # SciPy, zlib and struct each have errors of their own for the same damage
    except Exception as error:  # noqa: BLE001
        sys.exit(' '.join(str(error).split()) or type(error).__name__)
