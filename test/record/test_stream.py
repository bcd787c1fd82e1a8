# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What is lost of a stream is counted."""

from piezo_ident.record.stream import LossCount


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
