# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""One job at a time, off the main thread."""

import os
import threading

from piezo_ident.common.errors import Cancelled, PiezoIdentError
from piezo_ident.nodes.worker import Worker
import pytest


class Ears:
    """Hears what a worker tells."""

    def __init__(self):
        self.steps, self.results, self.done = [], [], threading.Event()

    def start(self, worker, job):
        worker.start(
            job, progress=lambda step, share: self.steps.append((step, share)), ended=self.ended
        )

    def ended(self, result, error):
        self.results.append((result, error))
        self.done.set()


def endless(started):
    def job(tick):
        while True:
            tick('turning', 0.5)
            started.set()

    return job


def test_result_and_progress_come_home():
    ears, worker = Ears(), Worker()

    def job(tick):
        tick('half', 0.5)
        return 42

    ears.start(worker, job)
    assert ears.done.wait(5.0) and worker.join(5.0)
    assert ears.results == [(42, None)]
    assert ears.steps == [('half', 0.5)]


def test_second_job_is_refused_while_one_is_at_work():
    ears, worker, started = Ears(), Worker(), threading.Event()
    ears.start(worker, endless(started))
    assert started.wait(5.0)
    with pytest.raises(PiezoIdentError, match='another job is at work'):
        ears.start(worker, endless(started))
    worker.cancel()
    assert worker.join(5.0) and not worker.busy
    ((result, error),) = ears.results
    assert result is None and isinstance(error, Cancelled)
    # and the next one is not cancelled by what was asked of the last
    ears.start(worker, lambda tick: tick('free', 1.0))
    assert worker.join(5.0)
    assert ears.results[-1] == (None, None)


def test_a_job_that_misses_its_cancelling_has_no_result():
    ears, worker, started, go = Ears(), Worker(), threading.Event(), threading.Event()

    def job(tick):
        started.set()
        go.wait(5.0)
        return 'too late'

    ears.start(worker, job)
    started.wait(5.0)
    worker.cancel()
    go.set()
    assert worker.join(5.0)
    assert isinstance(ears.results[0][1], Cancelled)


def test_error_comes_home():
    ears, worker = Ears(), Worker()
    ears.start(worker, lambda tick: 1 / 0)
    assert worker.join(5.0)
    assert isinstance(ears.results[0][1], ZeroDivisionError)


@pytest.mark.skipif(not os.path.isdir('/proc/self/task'), reason='threads share a priority')
def test_the_thread_gives_way_and_no_other():
    ears, worker = Ears(), Worker(nice=3)
    before = os.getpriority(os.PRIO_PROCESS, 0)
    ears.start(worker, lambda tick: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
    assert worker.join(5.0)
    assert ears.results == [(min(before + 3, 19), None)]
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
