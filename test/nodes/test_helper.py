# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""Long work in a process of its own: what goes there, what comes back, and how it ends."""

from array import array
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import MappingProxyType

import numpy as np
from piezo_ident.common.errors import Cancelled, DataError, PiezoIdentError
from piezo_ident.nodes.helper import Helper
from piezo_ident.record.blocks import Samples
from piezo_ident.record.capture import Capture
import pytest

# jobs: the process imports them from here


def double(tick):
    tick('half', 0.5)
    time.sleep(0.1)
    tick('most', 0.9)
    time.sleep(0.1)
    return array('d', [2.0] * 200_000), np.arange(300_000.0), MappingProxyType({'a': 1})


def fail(tick):
    raise DataError('there are no data')


def stumble(tick):
    return 1 / 0


def turn(tick):
    while True:
        tick('turning', 0.5)


def sleep(tick):
    time.sleep(60.0)


def secret(tick):
    return lambda: None


def priority(tick):
    return os.getpriority(os.PRIO_PROCESS, 0)


class Record:
    """Makes a record of a snapshot there."""

    def __init__(self, snapshot):
        self.snapshot = snapshot

    def __call__(self, tick):
        return self.snapshot.record()


@pytest.fixture
def helper(monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(Path(__file__).parent))
    made = Helper()
    yield made
    made.close()


def nothing(step, share):
    pass


def stop_after(seconds):
    begin = time.monotonic()

    def tick(step, share):
        if time.monotonic() - begin > seconds:
            raise Cancelled('enough')

    return tick


def test_result_and_progress_come_home(helper):
    steps = []
    numbers, x, mapping = helper.run(double, lambda *news: steps.append(news))
    assert numbers == array('d', [2.0] * 200_000) and mapping == {'a': 1}
    np.testing.assert_array_equal(x, np.arange(300_000.0))
    assert not x.flags.writeable
    assert list(dict.fromkeys(steps))[-2:] == [('half', 0.5), ('most', 0.9)]


def test_errors_come_home_and_the_process_stays(helper):
    pid = helper.pid
    with pytest.raises(DataError, match='there are no data'):
        helper.run(fail, nothing)
    with pytest.raises(ZeroDivisionError):
        helper.job(stumble)(nothing)
    with pytest.raises(PiezoIdentError, match='a function cannot be handed over'):
        helper.run(secret, nothing)
    assert helper.run(priority, nothing) == os.getpriority(os.PRIO_PROCESS, 0)
    assert helper.pid == pid


@pytest.mark.parametrize(('job', 'stays'), [(turn, True), (sleep, False)])
def test_a_job_is_cancelled_whatever_it_does(helper, job, stays):
    helper.run(priority, nothing)
    pid = helper.pid
    begin = time.monotonic()
    with pytest.raises(Cancelled, match='enough'):
        helper.run(job, stop_after(0.3))
    assert time.monotonic() - begin < 2.0
    assert (helper.pid == pid) == stays
    helper.run(priority, nothing)


def test_a_process_that_dies_is_said_and_replaced(helper):
    pid = helper.pid

    def kill(step, share):
        os.kill(pid, signal.SIGKILL)

    with pytest.raises(PiezoIdentError, match=r'ended by itself \(signal 9\)'):
        helper.run(sleep, kill)
    helper.run(priority, nothing)
    assert helper.pid != pid


def test_it_gives_way(monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(Path(__file__).parent))
    helper = Helper(nice=3)
    try:
        before = os.getpriority(os.PRIO_PROCESS, 0)
        assert helper.run(priority, nothing) == min(before + 3, 19)
    finally:
        helper.close()


def is_there(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


@pytest.mark.skipif(not Path('/proc/self/stat').exists(), reason='no /proc to look into')
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_its_parent(number):
    code = (
        'from piezo_ident.nodes.helper import Helper; import time; h = Helper()\n'
        'print(h.pid, flush=True); time.sleep(60)'
    )
    parent = subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True)
    try:
        pid = int(parent.stdout.readline())
        assert is_there(pid)
        parent.send_signal(number)
        parent.wait(10.0)
        deadline = time.monotonic() + 10.0
        while is_there(pid):
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        parent.kill()
        parent.stdout.close()


def test_a_snapshot_arrives_whole(helper):
    capture, rng = Capture(), np.random.default_rng(1)
    for k in range(1500):
        t = np.arange(100 * k, 100 * (k + 1)) / 20_000.0
        for i, quantity in enumerate(('voltage', 'displacement')):
            samples = Samples(t, rng.normal(size=100) * 1e-6**i, 'noise', quantity)
            capture.add(quantity, samples, 2 * k + i)
    there, here = helper.run(Record(capture.snapshot()), nothing), capture.record()
    for one, other in zip(there, here, strict=True):
        np.testing.assert_array_equal(one.v, other.v)
        np.testing.assert_array_equal(one.y, other.y)
        assert one.segments == other.segments


def test_the_warm_up_takes_all_three_steps():
    # an error would be passed over where it is used
    from piezo_ident.nodes.jobs import warm_up

    warm_up()


def faults_of_a_second_array(tick):
    """Return how often the system gives memory for an array as large as one that was freed."""
    import resource  # not on every system

    taken = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        # reason: taken and given back is all that it is for
        np.ones(4_000_000)
        taken.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    return taken


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='counts as Linux counts')
def test_memory_is_kept_for_the_next_array(helper):
    first, *later = helper.run(faults_of_a_second_array, lambda *_: None)
    assert first > 100 and max(later) < 10, (first, later)
