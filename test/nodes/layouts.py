# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the layouts of PlotJuggler and Foxglove show, and what these find for it in a bag."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import json
from pathlib import Path
import re
from typing import Any
import xml.etree.ElementTree as ET

from piezo_ident.record.bags.read import opened_bag, typestore

CONFIG = Path(__file__).resolve().parents[2] / 'config'


#: topic and message
Message = tuple[str, Any]


def messages_of(bag: Path) -> list[Message]:
    """Return all messages of a bag."""
    store = typestore()
    with opened_bag(bag) as opened:
        return [
            (connection.topic, store.deserialize_cdr(raw, connection.msgtype))
            for connection, _, raw in opened.messages(opened.connections)
        ]


def shown_by_plotjuggler() -> Iterator[str]:
    """Return the names of all series that the layout draws."""
    for curve in ET.parse(CONFIG / 'plotjuggler.xml').iter('curve'):
        yield from (
            [curve.get('curve_x'), curve.get('curve_y')]
            if curve.get('curve_x')
            else [curve.get('name')]
        )


def series_of_plotjuggler(messages: Iterable[Message]) -> Iterator[str]:
    """Return the names that PlotJuggler 3 gives to joint states and diagnostics."""
    for topic, message in messages:
        kind = type(message).__name__.rpartition('__')[2]
        if kind == 'JointState':
            yield from (f'{topic}/{name}/position' for name in message.name)
        elif kind == 'DiagnosticArray':
            for status in message.status:
                place = '/'.join(filter(None, [topic, status.hardware_id, status.name]))
                yield from (f'{place}/{pair.key}' for pair in status.values)


def shown_by_foxglove() -> Iterator[str]:
    """Return all message paths of the layout."""
    layout = json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))
    panels = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout'])))
    assert panels == set(layout['configById'])
    for panel in layout['configById'].values():
        yield from (path['value'] for path in panel.get('paths', ()))
        yield from (panel[key] for key in ('topicPath', 'topicToRender') if key in panel)
        if 'xAxisPath' in panel:
            yield panel['xAxisPath']['value']


def found_by_foxglove(messages: Iterable[Message], path: str) -> bool:
    """Return whether a message path of the kinds above leads to a value."""
    topic, _, rest = path.partition('.')
    for name, message in messages:
        if name != topic:
            continue
        if index := re.fullmatch(r'position\[(\d+)\]', rest):
            return len(message.position) > int(index[1])
        if key := re.fullmatch(r'values\[:\]\{key=="(\w+)"\}\.value', rest):
            return any(pair.key == key[1] for pair in message.values)
        return not rest or hasattr(message, rest)
    return False
