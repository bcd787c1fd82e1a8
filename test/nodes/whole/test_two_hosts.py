# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A graph over two hosts, which are two network namespaces of this machine."""

from pathlib import Path
import xml.etree.ElementTree as ET

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

import netns

ROOT = Path(__file__).resolve().parents[3]
REASON = netns.why_not()
two_hosts = pytest.mark.skipif(bool(REASON), reason=REASON or 'there are two hosts')


def test_the_profile_that_is_shipped_is_well_formed():
    root = ET.parse(ROOT / 'config/fastdds_two_hosts.xml').getroot()
    name = '{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}'
    assert root.tag == f'{name}profiles'
    assert len(root.findall(f'{name}data_writer')) == 1


@two_hosts
def test_five_percent_of_the_packets_cost_nothing():
    outcome = netns.run(percent=5)
    print(f'{outcome.dropped} packets dropped, {outcome.seconds} s')
    assert outcome.dropped > 20
    assert outcome.is_honest, outcome
    # a busy machine may come too late with a repair; then it is said
    if not outcome.lost and not outcome.faults:
        assert (outcome.state, outcome.captured) == ('done', outcome.sent), outcome.message
        assert outcome.model


@two_hosts
def test_nobody_is_seen_from_another_host_unless_asked():
    # with no variable at all: what the starter does by itself
    assert netns.seen_from('') == {'a': ['/host0/stage'], 'b': ['/host1/stage']}
    assert not any(netns.leftover())


@two_hosts
def test_they_see_each_other_when_asked():
    both = ['/host0/stage', '/host1/stage']
    assert netns.seen_from('SUBNET') == {'a': both, 'b': both}
