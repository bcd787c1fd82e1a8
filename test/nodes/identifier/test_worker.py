# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One job at a time, beside the executor."""

import threading

import numpy as np
from piezo_ident.common.errors import Cancelled, DataError, PiezoIdentError
from piezo_ident.live.capture import Capture
from piezo_ident.nodes.identifier.jobs import warm_up
from piezo_ident.nodes.identifier.worker import Worker
from piezo_ident.record.blocks import Samples
from process_jobs import fail, MakeRecord, numbers, priority, tick_for_ever
import pytest


class Listener:
    """Keeps what a worker reports."""

    def __init__(self):
        self.worker = Worker()
        self.steps, self.results, self.started = [], [], threading.Event()

    def progress(self, step, share):
        self.steps.append((step, share))
        if step == 'turning':
            self.started.set()

    def start(self, job):
        self.worker.start(job, progress=self.progress, ended=lambda *r: self.results.append(r))


@pytest.fixture
def listener():
    made = Listener()
    yield made
    made.worker.close()


def test_result_and_progress_are_reported(listener):
    listener.start(numbers)
    assert listener.worker.join(60.0)
    ((result, error),) = listener.results
    assert error is None and result[2] == {'a': 1}
    assert {('half', 0.5), ('most', 0.9)} & set(listener.steps)


def test_a_second_job_is_refused_and_the_first_cancelled(listener):
    listener.start(tick_for_ever)
    assert listener.started.wait(60.0)
    with pytest.raises(PiezoIdentError, match='~/cancel'):
        listener.start(priority)
    listener.worker.cancel()
    assert listener.worker.join(60.0) and not listener.worker.is_busy
    ((result, error),) = listener.results
    assert result is None and isinstance(error, Cancelled)
    # the next job is not cancelled by the same call
    listener.start(priority)
    assert listener.worker.join(60.0)
    assert listener.results[-1][1] is None


def test_an_error_is_reported(listener):
    listener.start(fail)
    assert listener.worker.join(60.0)
    assert isinstance(listener.results[0][1], DataError)


def test_a_snapshot_arrives_whole(listener):
    capture, rng = Capture(), np.random.default_rng(1)
    for k in range(1500):
        t = np.arange(100 * k, 100 * (k + 1)) / 20_000.0
        for i, quantity in enumerate(('voltage', 'displacement')):
            samples = Samples(t, rng.normal(size=100) * 1e-6**i, 'noise', quantity)
            capture.add(quantity, samples, 2 * k + i)
    listener.start(MakeRecord(capture.snapshot()))
    assert listener.worker.join(60.0)
    for there, here in zip(listener.results[0][0], capture.record(), strict=True):
        np.testing.assert_array_equal(there.v, here.v)
        np.testing.assert_array_equal(there.y, here.y)
        assert there.segments == here.segments


def test_the_warm_up_runs():
    # the worker process suppresses its errors
    warm_up()
