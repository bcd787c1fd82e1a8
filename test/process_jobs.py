# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Jobs for worker processes, in a module that such a process can import."""

from array import array
from dataclasses import dataclass
import os
import time
from types import MappingProxyType, SimpleNamespace

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.options import ReadOptions


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


@dataclass(frozen=True)
class Deadly:
    """Ends the process that works on one record."""

    verb = 'identify'
    reading = ReadOptions()

    def __call__(self, record, name):
        if name == 'stage_2':
            os._exit(3)
        # the other jobs need no numerics
        from programs import slow_model

        return SimpleNamespace(model=slow_model()), {}
