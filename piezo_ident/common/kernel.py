# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compiled numerical loops (kernels): cached on disk, without the interpreter lock.

Kernels are kept in the folder ``NUMBA_CACHE_DIR`` if that is set, else in ``__pycache__`` beside
their files, else in the cache of the user (``~/.cache/numba``).  If none of these can be written,
each process compiles its kernels again, and logs that once to ``piezo_ident``.
"""

from __future__ import annotations

from collections.abc import Callable
import logging
from typing import Any, cast, TypeVar

from numba import njit
from numba.core import event

F = TypeVar('F', bound=Callable[..., Any])

#: a smaller signal has died away
STILL = 1e-280


def kernel(function: F) -> F:
    """
    Compile a function of arrays and numbers.

    Sums may be reassociated to run in vector lanes; all other IEEE arithmetic stays.  The compiler
    fixes the order of a sum, so a stream gives the same bits wherever it is cut.
    """
    return _compiled(function, fastmath={'reassoc'})


def ordered_kernel(function: F) -> F:
    """Compile a function whose sums keep their order, so that equal loops give the same bits."""
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
    """Logs that a process compiles kernels, at the first kernel that is not in the cache."""

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
        """Log nothing: the next line of the program tells."""


_NOTICE = _Notice()
event.register('numba:compile', _NOTICE)  # type: ignore[no-untyped-call]


@ordered_kernel
def alive(x: float) -> float:
    """
    Keep x, or put zero for an x that has died away.

    The state of a filter whose input rests falls to subnormal numbers, which take a processor a
    hundred times as long.  This function is compiled into each loop that calls it.  Loops are
    cached until their own file changes: empty the caches when this function changes.
    """
    return 0.0 if abs(x) < STILL else x
