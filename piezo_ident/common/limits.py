# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
What a file may ask for: every limit that a reader sets to a file from a stranger, in one place.

A size that a file declares is compared with these before memory is taken for it.
"""

from __future__ import annotations

from pathlib import Path

from piezo_ident.common.errors import DataError

__all__ = [
    'COLUMNS',
    'EFFECTS',
    'ORDER',
    'PIECES',
    'YAML_DEPTH',
    'YAML_LENGTH',
    'YAML_NODES',
    'regular_file',
    'unpacked',
]

#: characters of a YAML text (20 us each); entries, aliases written out, and nesting of its tree
YAML_LENGTH, YAML_NODES, YAML_DEPTH = 500_000, 50_000, 20
#: columns of a table
COLUMNS = 1000
#: uniformly sampled pieces of a record
PIECES = 10_000
#: effects of a model
EFFECTS = 50
#: coefficients of G, whose roots cost their third power
ORDER = 200

#: samples shrink to a tenth at best, since their times do not repeat; ten times that, and small
#: files of constant numbers, pass
_EXPANSION, _SMALL = 100, 64 * 1024 * 1024


def unpacked(size: int) -> int:
    """
    Return how many bytes a packed file of a size [bytes] may unpack to, all in all.

    >>> unpacked(1000), unpacked(1_000_000_000)
    (67108864, 100000000000)
    """
    return max(_SMALL, _EXPANSION * size)


def regular_file(path: Path) -> None:
    """
    Refuse devices and pipes, which have no end.

    Raises
    ------
    DataError
    """
    if not path.is_file():
        what = 'is a folder' if path.is_dir() else 'is a device or a pipe'
        raise DataError(f'{path}: {what}, no file; copy the data into a file')
