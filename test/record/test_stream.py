# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Streams: a long one is spooled to memory maps, and losses are counted."""

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.model.free_run import free_run
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record import stream
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.record import Piece, Record, Segment
from piezo_ident.record.stream import LossCount
import pytest

RATE, N = 20_000.0, 15_000


@pytest.fixture
def bag(tmp_path, monkeypatch):
    """Return a bag that is long beside the samples that stay in memory."""
    monkeypatch.setattr(stream, 'CHUNK', 500)
    monkeypatch.setattr(stream, 'SPOOLED', 2000)
    stage = SimulatedStage.load('paper').model
    pieces = []
    # a short gap, a long one, and a clock that starts over
    for i, start in enumerate((0.0, 0.8, 5.0, 0.0)):
        v = 5.0 + 4.5 * np.sin(2 * np.pi * (3 * np.arange(N) / N + 0.1 * i))
        y = stage.predict_piece(Piece(v, np.zeros(N), RATE))
        labels = (Segment('noise', 100, N - i),)
        pieces.append(Piece(v, y, RATE, start, labels, {'heat': v**2}))
    write_bag(Record(tuple(pieces), 'r'), tmp_path / 'bag')
    return tmp_path / 'bag'


def spooled_and_not(path, monkeypatch):
    long = read_bag(path)
    with monkeypatch.context() as other:
        other.setattr(stream, 'SPOOLED', 1 << 20)
        return long, read_bag(path)


def is_mapped(x):
    while x is not None and not isinstance(x, np.memmap):
        x = x.base
    return x is not None


def test_a_long_bag_lies_in_memory_maps_and_is_read_and_predicted_as_a_short_one(bag, monkeypatch):
    long, short = spooled_and_not(bag, monkeypatch)
    assert all(is_mapped(p.v) and is_mapped(p.y) for p in long)
    assert not any(is_mapped(p.v) or is_mapped(p.y) for p in short)
    assert long.faults == short.faults
    for one, other in zip(long, short, strict=True):
        assert (one.start_time, one.segments) == (other.start_time, other.segments)
        for x, x2 in ((one.v, other.v), (one.y, other.y)):
            np.testing.assert_array_equal(x, x2)
        np.testing.assert_array_equal(one.channels['heat'], other.channels['heat'])
    model = SimulatedStage.load('paper').model
    one, other = (free_run(model, r) for r in (long, short))
    assert one.errors == other.errors
    assert one.errors_after_start == other.errors_after_start


def test_no_room_for_a_long_record_is_a_line(bag, monkeypatch, tmp_path):
    monkeypatch.setattr(stream.tempfile, 'tempdir', str(tmp_path / 'nowhere'))
    with pytest.raises(DataError, match='nowhere'):
        read_bag(bag)


def test_lost_messages_are_counted():
    losses = LossCount()
    for number in (1, 2, 3, 7, 8):
        losses.note(number)
    assert losses.lost == 3
    # a publisher that starts over, and one far ahead that was there before
    for number in (1, 2, 90000, 90001):
        losses.note(number)
    assert losses.lost == 3
    # of one that is known to be the same a long silence is a loss
    losses.note(95001, alone=True)
    assert losses.lost == 3 + 4999
