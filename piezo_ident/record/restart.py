# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The one rule by which a sample clock has restarted, for live streams and records alike."""

from __future__ import annotations

__all__ = ['JUMP_BACK', 'has_restarted']

#: a clock that goes back by more samples than this (ten blocks) has restarted
JUMP_BACK = 1000


def has_restarted(first: float, last: float, begin: float, period: float) -> bool:
    """
    Return whether time that jumps back is a restart of the sample clock.

    It is when the new stretch starts at or before the start of the old one, or more than
    `JUMP_BACK` samples before its end.  Otherwise the samples came again or out of turn.

    Parameters
    ----------
    first : float
        Time of the first sample of the new stretch [s].
    last : float
        Time of the newest sample so far [s].
    begin : float
        Time of the first sample since the last restart [s].
    period : float
        Sampling period [s].

    Examples
    --------
    >>> has_restarted(0.0, last=0.02, begin=0.0, period=5e-5)
    True
    >>> has_restarted(0.01, last=0.02, begin=0.0, period=5e-5)
    False
    >>> has_restarted(1.01, last=2.02, begin=0.0, period=5e-5)
    True
    """
    if first > last:
        return False
    return first <= begin or last - first > JUMP_BACK * period
