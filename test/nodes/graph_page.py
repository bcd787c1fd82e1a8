# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The tables of docs/graph.md and the rights of config/security/policy.xml, read for tests."""

from dataclasses import dataclass
from pathlib import Path
import re
import xml.etree.ElementTree as ET

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / 'docs/graph.md').read_text(encoding='utf-8')
POLICY = ROOT / 'config/security/policy.xml'
#: the enclave of the person who starts runs, sets parameters and looks
OPERATOR = 'operator'


@dataclass(frozen=True)
class Topic:
    """A row of the table of topics."""

    name: str
    type: str
    publishers: frozenset[str]
    subscribers: frozenset[str]
    qos: str


def table(name: str) -> list[list[str]]:
    """Return the rows of a marked table of the page."""
    body = re.search(rf'<!-- table: {name} -->\n(.*?)\n<!-- end -->', PAGE, re.S)
    assert body, f'docs/graph.md has no table {name}'
    lines = body[1].splitlines()[2:]
    return [[c.strip().replace('`', '') for c in line.strip('|').split('|')] for line in lines]


def _pairs(name: str) -> list[tuple[str, str, str]]:
    """Return each node, each of its names, and the last cell, of a table that groups them."""
    return [
        (node, value, last)
        for nodes, values, *_, last in table(name)
        for node in nodes.split(', ')
        for value in values.split(', ')
    ]


def _names(cell: str) -> frozenset[str]:
    return frozenset(cell.split(', ')) - {'-'}


TOPICS = [
    Topic(name, kind.replace('/', '/msg/'), _names(sent_by), _names(read_by), qos)
    for name, kind, sent_by, read_by, qos, _ in table('topics')
]
#: service, state and value of /diagnostics of each node; a value with when it is there
SERVICES = [(node, name.removeprefix('~/')) for node, name, _ in _pairs('services')]
STATES = [(node, name) for node, name, _ in _pairs('states')]
DIAGNOSTICS = _pairs('diagnostics')


def rights(node: str) -> dict[str, set[str]]:
    """Return what the policy allows a node: publish, subscribe, reply and request."""
    allowed: dict[str, set[str]] = {'publish': set(), 'subscribe': set()}
    allowed |= {'reply': set(), 'request': set()}
    (profile,) = ET.parse(POLICY).getroot().findall(f".//profile[@node='{node}']")
    for group in profile:
        (right,) = group.attrib
        allowed[right] |= {entry.text or '' for entry in group}
    return allowed
