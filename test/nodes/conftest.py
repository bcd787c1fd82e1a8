# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""End the processes of node tests without the destructors of the middleware."""

import atexit
import os
import sys

from _pytest.runner import runtestprotocol
import processes

processes.set_middleware()
#: exit status of the tests of this process
STATUS = [0]


def pytest_runtest_protocol(item, nextitem):
    """End the graph of a file before a test that stands above the one that runs."""
    # a process that has done the end of a file may be given its beginning afterwards, whose tests
    # do not expect what those of the end have left
    is_back = nextitem is not None and nextitem.path == item.path
    if not is_back or nextitem.location[1] >= item.location[1]:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    runtestprotocol(item, nextitem=None)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


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
