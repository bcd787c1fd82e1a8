# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How a numerical loop becomes a compiled kernel: cached on disk, without the interpreter lock.

Where neither the installation nor the home of the user can be written, nothing is cached, and each
process compiles its kernels anew.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast, TypeVar

from numba import njit

__all__ = ['STILL', 'alive', 'kernel', 'ordered_kernel']

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


def _compiled(function: F, **options: Any) -> F:
    try:
        return cast(F, njit(cache=True, nogil=True, **options)(function))
    except RuntimeError:  # no folder for the cache
        return cast(F, njit(nogil=True, **options)(function))


@ordered_kernel
def alive(x: float) -> float:
    """
    Return x, or zero when it has died away.

    For the state of a filter: where its input rests, it falls until the digits of a number run
    out, and from there on each operation takes a processor a hundred times as long.

    It is compiled into each loop that calls it, and loops are kept on disk until their own file
    changes: whoever changes it has to empty their caches.
    """
    return 0.0 if abs(x) < STILL else x
