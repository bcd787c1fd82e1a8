# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Services and parameters answer at once, however long the work behind them takes."""

import threading
import time

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from piezo_ident.common.errors import DataError
from piezo_ident.nodes import model, model_loader, player, recorder
from processes import take_domain
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

pytestmark = pytest.mark.timed

#: how long the work takes, and how soon the answer must come [s]
WORK, AT_ONCE = 3.0, 1.0


RELEASE = threading.Event()


def slow(*_: object) -> None:
    RELEASE.wait(WORK)
    raise DataError('it took long')


@pytest.fixture
def made(tmp_path):
    """Return a function that makes a node in this process."""
    RELEASE.clear()
    domain, lock = take_domain()
    context, nodes = Context(), []
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)

    def make(kind, **values):
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        nodes.append(kind(context=context, parameter_overrides=overrides))
        return nodes[-1]

    yield make
    RELEASE.set()
    for thread in threading.enumerate():
        if thread.name in ('replay', 'recording'):
            thread.join()
    for node in nodes:
        node.close()
        node.destroy_node()
    rclpy.shutdown(context=context)
    lock.close()


def seconds(call) -> float:
    begin = time.monotonic()
    call()
    return time.monotonic() - begin


def test_a_bag_that_is_slow_to_open_is_replayed_later(made, monkeypatch, tmp_path):
    monkeypatch.setattr(player, 'ordered_bag', slow)
    node = made(player.PlayerNode, bag=str(tmp_path))
    assert seconds(node.start) < AT_ONCE
    assert seconds(node.stop) < AT_ONCE


def test_a_bag_that_is_slow_to_make_and_to_close(made, monkeypatch, tmp_path):
    monkeypatch.setattr(recorder, 'BagWriter', slow)
    node = made(recorder.RecorderNode, output=str(tmp_path / 'bag'))
    assert seconds(node.start) < AT_ONCE
    assert seconds(node.stop) < AT_ONCE


def test_a_model_file_that_is_slow_to_read(made, monkeypatch, tmp_path):
    (tmp_path / 'model.yaml').write_text('')
    node = made(model.ModelNode)
    monkeypatch.setattr(model_loader, 'load', slow)
    wish = Parameter('model', value=str(tmp_path / 'model.yaml'))
    assert seconds(lambda: node.set_parameters([wish])) < AT_ONCE
