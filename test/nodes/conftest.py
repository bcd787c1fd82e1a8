# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""End the processes of node tests without the destructors of the middleware."""

import atexit
import os
import sys

#: exit status of the tests of this process
STATUS = [0]


def pytest_sessionfinish(exitstatus):
    """Keep the exit status."""
    STATUS[0] = int(exitstatus)


@atexit.register
def end_at_once():
    """End a process that keeps nodes: their destructors end it now and then by a signal."""
    graph = sys.modules.get('graph')
    if graph is not None and graph.Graph.kept:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(STATUS[0])
