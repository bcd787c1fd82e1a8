# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Jobs for worker processes, in a module that such a process can import."""

from array import array
import os
import time
from types import MappingProxyType

import numpy as np
from piezo_ident.common.errors import DataError


def numbers(tick):
    tick('half', 0.5)
    time.sleep(0.2)
    tick('most', 0.9)
    time.sleep(0.2)
    return array('d', [2.0] * 200_000), np.arange(300_000.0), MappingProxyType({'a': 1})


def fail(tick):
    raise DataError('there are no data')


def divide_by_zero(tick):
    return 1 / 0


def tick_for_ever(tick):
    while True:
        tick('turning', 0.5)


def sleep(tick):
    time.sleep(60.0)


def unpicklable(tick):
    return lambda: None


def priority(tick):
    return os.getpriority(os.PRIO_PROCESS, 0)


def die(tick):
    os._exit(3)


class MakeRecord:
    """Makes a record of a snapshot of a capture."""

    def __init__(self, snapshot):
        self.snapshot = snapshot

    def __call__(self, tick):
        return self.snapshot.record()
