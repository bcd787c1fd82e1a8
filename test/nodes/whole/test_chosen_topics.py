# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Which topics of a bag are replayed, and under which names."""

from pathlib import Path

from bag_data import blocks, write
from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import opened_bag
from piezo_ident.record.bags.recover import Bag
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from piezo_ident.nodes.player import chosen_topics

A, B = '/a', '/b'


def here(namespace: str = ''):
    return lambda name: name if name.startswith('/') else f'{namespace}/{name}'


def bag(path: Path, *topics: str) -> Bag:
    messages = []
    for v, y in blocks():
        messages += [(t, v if t.endswith(('voltage', 'drive')) else y) for t in topics]
    with opened_bag(write(path / 'bag', messages)) as opened:
        # the connections of a closed reader are gone
        return Bag(path / 'bag', list(opened.connections), opened.messages, 0, 0)


@pytest.mark.parametrize(
    ('there', 'wanted', 'namespace', 'want'),
    [
        (['/voltage'], ['voltage'], '', {'/voltage': '/voltage'}),
        (['/a/voltage'], ['voltage'], B, {'/a/voltage': '/b/voltage'}),
        (['/a/voltage', '/b/voltage'], ['voltage'], B, {'/b/voltage': '/b/voltage'}),
        (['/a/x/voltage'], ['x/voltage'], B, {'/a/x/voltage': '/b/x/voltage'}),
        (['/a/voltage'], ['/a/voltage'], B, {'/a/voltage': '/a/voltage'}),
    ],
)
def test_choice(tmp_path, there, wanted, namespace, want):
    assert chosen_topics(bag(tmp_path, *there), wanted, here(namespace)) == want


def test_remapped_topics_are_found_by_what_they_carry(tmp_path):
    messages = [m for v, y in blocks() for m in (('/lab/drive', v), ('/lab/gauge', y))]
    with opened_bag(write(tmp_path / 'bag', messages)) as opened:
        chosen = chosen_topics(opened, ['voltage', 'displacement'], here(A))
        assert chosen == {'/lab/drive': '/a/voltage', '/lab/gauge': '/a/displacement'}
        # by a remap of the player, under its own name
        remap = {'voltage': '/lab/drive'}
        assert chosen_topics(opened, ['voltage'], remap.__getitem__) == {
            '/lab/drive': '/lab/drive'
        }


def test_a_prediction_is_not_replayed_as_displacement(tmp_path):
    messages = [m for v, y in blocks() for m in (('/voltage', v), ('/prediction', y))]
    with opened_bag(write(tmp_path / 'bag', messages)) as opened:
        assert chosen_topics(opened, ['prediction'], here(A)) == {'/prediction': '/a/prediction'}
        with pytest.raises(DataError, match=r'bag: .* displacement .*/prediction'):
            chosen_topics(opened, ['displacement'], here(A))


def test_refusals(tmp_path):
    there = bag(tmp_path, '/a/voltage', '/c/voltage')
    closed = Bag(there.path, there.connections, lambda _: iter(()), 0, 0)
    for wanted, reason in (
        (['displacement_'], r'no topic displacement_ in it; set topics to some of: /a/voltage'),
        (['/b/voltage'], 'no topic /b/voltage'),
        (['voltage'], 'several topics could be voltage: /a/voltage, /c/voltage'),
    ):
        with pytest.raises(DataError, match=reason):
            chosen_topics(closed, wanted, here(B))
