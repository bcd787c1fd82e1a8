# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How a numerical loop becomes a compiled kernel: cached on disk, without the interpreter lock.

Compiled kernels are kept in the folder ``NUMBA_CACHE_DIR`` where that is set, else in
``__pycache__`` beside their files, else, where the installation cannot be written, in the cache of
the user (``~/.cache/numba``).  Where none of them can be written, each process compiles its
kernels again.  A process that compiles says so on the log ``piezo_ident``, once.
"""

from __future__ import annotations

from collections.abc import Callable
import logging
from typing import Any, cast, TypeVar

from numba import njit
from numba.core import event

F = TypeVar('F', bound=Callable[..., Any])

#: what is smaller has died away
STILL = 1e-280


def kernel(function: F) -> F:
    """
    Compile a function of arrays and numbers.

    Sums may be reassociated, so that they run in vector lanes; nothing else of IEEE arithmetic is
    given up.  The order of a sum is fixed when the kernel is compiled, so a stream gives the same
    bits wherever it is cut.
    """
    return _compiled(function, fastmath={'reassoc'})


def ordered_kernel(function: F) -> F:
    """
    Compile a function that adds in the very order in which it is written.

    For sums that run in vector lanes side by side, or that several loops must form alike.
    """
    return _compiled(function)


def part_of_kernels(function: F) -> F:
    """Put a function into each kernel that calls it, as if it were written there."""
    return cast(F, njit(inline='always')(function))


def _compiled(function: F, **options: Any) -> F:
    try:
        made = njit(cache=True, nogil=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        made = njit(nogil=True, **options)(function)
    _NOTICE.kernels.append(made)
    return cast(F, made)


class _Notice(event.Listener):
    """Says that a process compiles kernels, when the first of them is not in the cache."""

    def __init__(self) -> None:
        self.kernels: list[Any] = []
        self._said = False

    def on_start(self, event: Any) -> None:
        first = event.data['dispatcher']
        if self._said or not any(first is kernel for kernel in self.kernels):
            return
        self._said = True
        folder = first.stats.cache_path
        logging.getLogger('piezo_ident').warning(
            'compiling the numerical loops that this work needs, %s first: 3 to 10 s on an idle '
            'machine, a minute on a busy one; %s',
            f'{first.__module__.removeprefix("piezo_ident.")}.{first.__name__}',
            f'once, they are kept in {folder}'
            if folder
            else 'again in each process: no folder for them can be written, set NUMBA_CACHE_DIR',
        )

    def on_end(self, event: Any) -> None:
        """Say nothing: the next line of the program tells."""


_NOTICE = _Notice()
event.register('numba:compile', _NOTICE)  # type: ignore[no-untyped-call]


@ordered_kernel
def alive(x: float) -> float:
    """
    Return x, or zero when it has died away.

    The state of a filter whose input rests falls to subnormal numbers, which take a processor a
    hundred times as long.

    This function is compiled into each loop that calls it.  Loops are cached until their own file
    changes, so the caches have to be emptied when this function changes.
    """
    return 0.0 if abs(x) < STILL else x
