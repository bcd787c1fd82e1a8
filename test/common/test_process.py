# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A process for long work: what goes there, what comes back, and how it ends."""

from array import array
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
from piezo_ident.common.errors import Cancelled, DataError, PiezoIdentError
from piezo_ident.common.process import WorkerProcess
from process_jobs import (
    die,
    divide_by_zero,
    fail,
    numbers,
    priority,
    sleep,
    tick_for_ever,
    unpicklable,
)
from processes import alive
import pytest


@pytest.fixture
def worker():
    process = WorkerProcess()
    yield process
    process.close()


def stop_after(seconds):
    begin = time.monotonic()

    def tick(step, share):
        if time.monotonic() - begin > seconds:
            raise Cancelled('enough')

    return tick


def test_result_and_progress_come_back(worker):
    steps = []
    values, x, mapping = worker.run(numbers, lambda *step: steps.append(step))
    assert values == array('d', [2.0] * 200_000) and mapping == {'a': 1}
    np.testing.assert_array_equal(x, np.arange(300_000.0))
    assert list(dict.fromkeys(steps))[-2:] == [('half', 0.5), ('most', 0.9)]


def test_errors_come_back_and_the_process_stays(worker):
    pid = worker.pid
    with pytest.raises(DataError, match='there are no data'):
        worker.run(fail)
    with pytest.raises(ZeroDivisionError):
        worker.run(divide_by_zero)
    with pytest.raises(PiezoIdentError, match=r'function .*unpicklable'):
        worker.run(unpicklable)
    assert worker.run(priority) == os.getpriority(os.PRIO_PROCESS, 0)
    assert worker.pid == pid


@pytest.mark.parametrize(('job', 'stays'), [(tick_for_ever, True), (sleep, False)])
def test_a_job_is_cancelled_whatever_it_does(worker, job, stays):
    worker.run(priority)
    pid = worker.pid
    with pytest.raises(Cancelled, match='enough'):
        worker.run(job, stop_after(0.3))
    assert (worker.pid == pid) == stays
    worker.run(priority)


def test_a_process_that_dies_is_reported_and_replaced(worker):
    pid = worker.pid
    with pytest.raises(PiezoIdentError, match='signal 9'):
        worker.run(sleep, lambda step, share: os.kill(pid, signal.SIGKILL))
    with pytest.raises(PiezoIdentError, match='exit code 3'):
        worker.run(die)
    worker.run(priority)
    os.kill(worker.pid, signal.SIGKILL)
    time.sleep(0.2)
    worker.run(priority)


def test_it_gives_way():
    worker = WorkerProcess(nice=3)
    try:
        assert worker.run(priority) == min(os.getpriority(os.PRIO_PROCESS, 0) + 3, 19)
    finally:
        worker.close()


@pytest.mark.skipif(not Path('/proc/self/stat').exists(), reason='no /proc')
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM, None])
def test_it_ends_with_its_parent(number):
    code = (
        'from piezo_ident.common.process import WorkerProcess; import sys; w = WorkerProcess()\n'
        'print(w.pid, flush=True); sys.stdin.readline()'
    )
    parent = subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        pid = int(parent.stdout.readline())
        assert alive(pid)
        if number is not None:
            parent.send_signal(number)
        parent.stdin.close()
        parent.wait(30.0)
        deadline = time.monotonic() + 30.0
        while alive(pid):
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        parent.kill()
        parent.stdout.close()
