# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``piezo_ident node``: what it lists, and what it says without ROS."""

import subprocess
import sys

from command_line import refuse, succeed
from piezo_ident.nodes.parameters import NODES
import pytest

#: what `rclpy` and the messages are to a Python without ROS
WITHOUT_ROS = """
import os
import sys
from piezo_ident.cli import main
# what the nodes import is imported once
import piezo_ident.live.tracker, piezo_ident.verbs.learn
sys.meta_path.insert(0, type('NoRos', (), {'find_spec': staticmethod(
    lambda name, *_: exec('raise ModuleNotFoundError(name=name)')
    if name.partition('.')[0].endswith(('rclpy', '_msgs', '_srvs')) else None)}))
for name in sys.argv[1:]:
    # a node that cannot start ends its process
    if not os.fork():
        sys.exit(main(['node', name]))
    assert os.waitstatus_to_exitcode(os.wait()[1]) == 2, name
"""


def test_nodes_are_listed(capsys):
    said = succeed(capsys, 'node')
    assert [line.split()[0] for line in said.splitlines()[: len(NODES)]] == [
        *('excitation', 'stage', 'identifier', 'model', 'recorder', 'player', 'feedforward')
    ]


@pytest.mark.parametrize('name', NODES)
def test_help_lists_every_parameter(capsys, name):
    said = succeed(capsys, 'node', name, '--help')
    assert {d.name for d in NODES[name]} <= {line.partition(' ')[0] for line in said.splitlines()}


def test_a_misspelt_node_gets_a_guess(capsys, tmp_path):
    refuse(capsys, tmp_path, ['node', 'modle'], 'modle', 'did you mean model?')


def test_without_ros_one_line_says_what_to_install():
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS, *NODES], capture_output=True, text=True, check=True
    )
    for name, line in zip(NODES, done.stderr.splitlines(), strict=True):
        assert f'the node {name} needs' in line and 'setup.bash' in line and '[ros]' in line
