# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The policy for SROS2 is valid, says what the tables say, and allows nothing beside."""

from pathlib import Path
import re
import xml.etree.ElementTree as ET

from piezo_ident.nodes.interfaces import SERVICES, TOPICS
from piezo_ident.nodes.parameters import NODES
from piezo_ident.nodes.policy import OPERATOR, PARAMETERS, policy, rights
import pytest

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / 'config/security/policy.xml'
#: what may stand in what, and the attributes that must be there, as in sros2's policy.xsd
INSIDE = {
    'policy': (('enclaves',), ('version',)),
    'enclaves': (('enclave',), ()),
    'enclave': (('profiles',), ('path',)),
    'profiles': (('profile',), ()),
    'profile': (('topics', 'services'), ('ns', 'node')),
    'topics': (('topic',), ()),
    'services': (('service',), ()),
    'topic': ((), ()),
    'service': ((), ()),
}
QUALIFIERS = {'topics': {'publish', 'subscribe'}, 'services': {'reply', 'request'}}


def test_the_file_is_that_of_the_tables():
    cure = 'run: python -m piezo_ident.nodes.policy config/security/policy.xml'
    assert FILE.read_text(encoding='utf-8') == policy(), cure


def test_the_file_is_valid():
    root = ET.parse(FILE).getroot()
    assert root.tag == 'policy'
    for element in root.iter():
        children, attributes = INSIDE[element.tag]
        assert all(child.tag in children for child in element), element.tag
        assert len(element) or not children
        if element.tag in QUALIFIERS:
            assert set(element.attrib) <= QUALIFIERS[element.tag]
            assert set(element.attrib.values()) == {'ALLOW'}
        else:
            assert set(element.attrib) == set(attributes)
        if not children:
            assert re.fullmatch(r'(~/|/)?[a-z_]+(/[a-z_]+)*', element.text or ''), element.text
    paths = [e.attrib['path'] for e in root.iter('enclave')]
    assert paths == [f'/piezo_ident/{node}' for node in (*NODES, OPERATOR)]


def test_voltage_and_the_drive_are_few_ones():
    may = {node: rights(node) for node in (*NODES, OPERATOR)}
    assert [n for n in may if 'voltage' in may[n]['publish']] == ['excitation', 'player']
    assert [n for n in may if 'model' in may[n]['publish']] == ['identifier']
    asks = [n for n in may if 'excitation/start' in may[n]['request']]
    assert asks == ['identifier', OPERATOR]
    assert [n for n in may if 'stage/set_parameters' in may[n]['request']] == [OPERATOR]


@pytest.mark.parametrize('node', NODES)
def test_every_row_of_the_tables_is_allowed(node):
    may = rights(node)
    for topic in TOPICS:
        every = 'every node' in topic.publishers
        assert (topic.name in may['publish']) == (every or node in topic.publishers)
        if node in topic.subscribers:
            assert topic.name in may['subscribe']
    for service in SERVICES:
        assert (f'~/{service.name}' in may['reply']) == (service.node == node) or (
            service.name in {s.name for s in SERVICES if s.node == node}
        )
    assert {f'~/{p}' for p in PARAMETERS} <= set(may['reply'])
