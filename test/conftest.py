# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What all tests share: one thread for the linear algebra, set before NumPy is imported."""

import os
from pathlib import Path
import signal
import time

import pytest

# the matrices are narrow: two threads that share their cores with other work wait for each other
# (identification of 100,000 samples: 0.8 s with one thread, 7 to 45 s with two on a busy machine)
for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')

# a shell that starts the tests in the background has them ignore Ctrl-C, which is tested here
signal.signal(signal.SIGINT, signal.default_int_handler)

#: files that take longest, the slowest first: they start first, and short ones fill up the end
SLOWEST = (
    'diagnosis/test_diagnose.py',
    'identification/test_identify.py',
    'examples/test_tutorial.py',
    'diagnosis/whole/test_conclusion.py',
    'benchmarks/test_diagnosis_study.py',
    'many/test_run.py',
    'benchmarks/test_any_record.py',
    'verbs/test_learn_modes.py',
    'diagnosis/test_shared_modes.py',
    'examples/test_demo.py',
    'identification/test_free_run_fit.py',
    'nodes/whole/test_diagnose_node.py',
    'nodes/whole/test_run_faults.py',
    'nodes/whole/test_whole_graph.py',
    'nodes/identifier/test_node.py',
    'nodes/whole/test_driver_example.py',
    'nodes/whole/test_faults.py',
)
#: a PNG of one white pixel
BLANK = bytes.fromhex(
    '89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55'
    '0000000a4944415478da63f80f00010101001cb08c990000000049454e44ae426082'
)
#: share of the processors that others may take beside tests that judge seconds
BUSY = 0.3


def pytest_collection_modifyitems(items):
    for item in items:
        if 'nodes' not in item.path.parts and {'timed', 'loads'} & {
            m.name for m in item.iter_markers()
        }:
            raise pytest.UsageError(
                f'{item.nodeid}: make test runs such tests of test/nodes alone'
            )
    order = {Path(__file__).parent / name: i for i, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.fixture(scope='session', autouse=True)
def busy(request):
    """Return the share of the processors that other programs keep busy, before any node starts."""
    is_timed = any(item.get_closest_marker('timed') for item in request.session.items)
    if not is_timed or not Path('/proc/stat').exists():
        return 0.0

    def times():
        fields = [int(x) for x in Path('/proc/stat').read_text().split('\n', 1)[0].split()[1:8]]
        return sum(fields), fields[3] + fields[4]

    before = times()
    time.sleep(1.0)
    total, idle = (b - a for a, b in zip(before, times(), strict=True))
    return 1.0 - idle / max(total, 1)


@pytest.fixture
def blank_pictures(monkeypatch):
    """Have pictures laid out for a report and not rendered, where nobody looks at them."""
    monkeypatch.setattr('piezo_ident.report.figures.style.png', lambda *_: BLANK)


@pytest.fixture(autouse=True)
def _timed_alone(request, busy):
    if busy > BUSY and request.node.get_closest_marker('timed'):
        pytest.skip(f'other programs keep {100 * busy:.0f} % of the processors busy')
