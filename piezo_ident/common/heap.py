# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Memory that is freed stays with the process, for the next array of the same work.

The C library of Linux gives every large array back to the system and takes the next one page by
page, each of which the system clears.  An identification of minutes of samples spends a third of
its time so, and holds up all other processes where a page has to come from a host.
"""

from __future__ import annotations

import ctypes

__all__ = ['keep_freed']

#: numbers of mallopt(3), and what the heap grows by [bytes]
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4
_GROWTH = 1 << 26


def keep_freed() -> bool:
    """
    Keep freed memory in this process from now on; it is given back when the process ends.

    Returns
    -------
    bool
        False where the C library has no such option; then nothing is changed.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, -1), (_TOP_PAD, _GROWTH))
    return all(mallopt(option, value) for option, value in settings)
