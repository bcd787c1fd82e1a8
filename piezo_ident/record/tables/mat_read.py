# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
MATLAB files, read by SciPy in a process of its own.

SciPy's reader takes memory for whatever shape a damaged file announces, and some damage ends its
process with SIGSEGV.  So a child process reads the file and hands the arrays back as .npz.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.files import UNPACKED_SIZE

#: columns of a matrix, and structs of an array of them, at most
WIDTH = 32

#: what dSPACE's ControlDesk and Simulink call the samples of a signal, whose name stands beside
_TITLED = ('Data', 'values')
#: names of lists in what the child writes: all variables, columns that a title names, and what
#: MATLAB calls these; MATLAB allows no such names
_ALL, _TITLES, _PATHS = '*', '*titles', '*paths'


def read_variables(
    path: Path, wanted: str, needed: Iterable[str] | None
) -> tuple[tuple[str, ...], dict[str, NDArray[Any]], dict[str, str]]:
    """
    Return the names of all variables of a MATLAB file of version 4 to 7, and the wanted ones.

    The last mapping gives the name of a column by the path to it, where a title names the column.

    `wanted` is a regular expression; numbers keep their shape, texts and cells of texts become
    arrays of str.  Where the file lacks one of those `needed`, or they are None, all numbers in it
    are returned, those in structs too (see `flat`), and the names are theirs.  ValueError when the
    file is damaged or too large, or a wanted variable is no array of numbers or texts.
    """
    asked = '*' if needed is None else ','.join(needed)
    with tempfile.TemporaryDirectory(prefix='piezo_ident_mat_') as folder:
        target = Path(folder) / 'arrays.npz'
        done = subprocess.run(
            [sys.executable, '-m', __name__, str(path), wanted, asked, str(target)],
            # what this process imports from, the child does
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors='replace',
            check=False,
        )
        if done.returncode:
            lines = done.stderr.strip().splitlines()
            raise ValueError(lines[-1] if lines else f'SciPy ended with {done.returncode}')
        with np.load(target, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    names, titles, paths = (arrays.pop(key).tolist() for key in (_ALL, _TITLES, _PATHS))
    return tuple(names), arrays, dict(zip(paths, titles, strict=True))


def flat(name: str, value: Any, *, titled: bool = True) -> Iterator[tuple[str, NDArray[Any]]]:
    """
    Yield the columns of numbers in a variable: fields of structs, columns of narrow matrices.

    With `titled`, a name that stands beside the samples of a signal takes the place of their path.

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
                # two may be called alike
                title = title if titles.count(title) == 1 else ''
                yield from flat(f'{name}.{title or plain}', cell, titled=titled)
    if x.dtype.kind in 'biufM':
        if sum(size != 1 for size in x.shape) <= 1:
            yield name, x.ravel()
        elif x.ndim == 2 and min(x.shape) <= WIDTH:
            for i, column in enumerate(x if x.shape[0] < x.shape[1] else x.T, 1):
                yield f'{name}.{i}', column


def _title(struct: Any) -> str:
    """Return the name and the unit that a struct has for its data, empty where it has none."""
    texts = [
        str(np.ravel(struct[key])[0])
        for key in ('Name', 'label', 'Unit')
        if key in struct.dtype.names and np.ravel(struct[key]).dtype.kind == 'U'
        if np.size(struct[key])
    ]
    # of a path through a model, its end
    name = re.sub(r'.*/|["{}.]', '', texts[0]) if texts else ''
    return f'{name} [{texts[1]}]' if name and len(texts) > 1 else name


def _main(path: str, wanted: str, asked: str, target: str) -> None:
    """Do what `read_variables` has the child process do."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (UNPACKED_SIZE, most))
    import scipy.io

    names = [name for name, *_ in scipy.io.whosmat(path)]
    whole = {*asked.split(',')} <= {*names}
    used = [name for name in names if not whole or re.fullmatch(wanted, name)]
    # without names it would read all of them
    read = scipy.io.loadmat(path, variable_names=used) if used else {}
    arrays: dict[str, Any] = {}
    paths: dict[str, str] = {}
    for name in used:
        if whole or name == 'segment_name':
            arrays[name] = _plain(name, read[name])
        else:
            columns = [*flat(name, read[name])]
            plain = flat(name, read[name], titled=False)
            paths |= {path: key for (path, _), (key, _) in zip(plain, columns, strict=True)}
            arrays |= columns
    arrays[_ALL] = np.array(names if whole else [*arrays], dtype=str)
    titled = [(path, name) for path, name in paths.items() if path != name]
    arrays[_PATHS], arrays[_TITLES] = np.array(titled, dtype=str).reshape(-1, 2).T
    np.savez(target, **arrays)


def _plain(name: str, array: Any) -> NDArray[Any]:
    if isinstance(array, np.ndarray) and array.dtype.kind in 'bfiucU':
        return array
    cells = [np.ravel(cell) for cell in array.ravel()] if isinstance(array, np.ndarray) else []
    if not cells or not all(cell.dtype.kind == 'U' and cell.size <= 1 for cell in cells):
        raise ValueError(f'{name} holds something else than numbers or texts')
    return np.array([''.join(cell.tolist()) for cell in cells])


if __name__ == '__main__':
    try:
        _main(*sys.argv[1:])
    # SciPy, zlib and struct each have errors of their own for the same damage
    except Exception as error:  # noqa: BLE001
        sys.exit(' '.join(str(error).split()) or type(error).__name__)
