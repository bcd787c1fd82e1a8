# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Arrays that cannot be changed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ['frozen_array']


def frozen_array(values: ArrayLike) -> NDArray[np.float64]:
    """Return `values` as a read-only float64 vector, copied only when it must be."""
    array = np.asarray(values, dtype=np.float64)
    if array.flags.writeable:
        # a view would leave the data open to its owner, so only already frozen arrays are shared
        array = array.copy()
        array.setflags(write=False)
    return array
