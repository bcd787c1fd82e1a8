# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Choose among candidates that err about alike."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TypeVar

T = TypeVar('T')


def simplest(
    candidates: Collection[T], error: Callable[[T], float], size: Callable[[T], int], factor: float
) -> T:
    """
    Choose the smallest of the candidates with an error of at most `factor` times the least error.

    The smaller error decides between equal sizes.

    Examples
    --------
    >>> errors = {2: 9.0, 4: 1.01, 8: 1.0}
    >>> simplest(errors, errors.__getitem__, size=int, factor=1.02)
    4
    """
    limit = factor * min(map(error, candidates))
    alike = [one for one in candidates if error(one) <= limit]
    return min(alike, key=lambda one: (size(one), error(one)))
