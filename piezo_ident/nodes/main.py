# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start a node by its name.

A node imports and compiles for seconds.  Its module is therefore imported after `ENDING` listens
for signals.
"""

from __future__ import annotations

import importlib
import sys

from piezo_ident.nodes.ending import ENDING

#: module, class and purpose of each node
NODES = {
    'excitation': ('excitation', 'ExcitationNode', 'plays programs of voltage or of reference'),
    'stage': ('stage', 'StageNode', 'simulates a stage'),
    'identifier': ('identifier.node', 'IdentifierNode', 'captures, identifies and diagnoses'),
    'model': ('model', 'ModelNode', 'predicts the displacement, and estimates it with the sensor'),
    'recorder': ('recorder', 'RecorderNode', 'writes topics into a bag'),
    'player': ('player', 'PlayerNode', 'plays a bag back'),
    'feedforward': ('feedforward', 'FeedforwardNode', 'makes the voltage for a reference'),
}


def start(name: str) -> None:
    """
    Run a node until a signal ends the process.

    Without ROS, or another module, the process ends with exit code 2 and one line.
    """
    module, node, _ = NODES[name]
    ENDING.listen()
    try:
        kind = getattr(importlib.import_module(f'piezo_ident.nodes.{module}'), node)
        from piezo_ident.nodes.lab_node import run
    except ModuleNotFoundError as error:
        missing = (error.name or 'piezo_ident').partition('.')[0]
        if missing == 'piezo_ident':
            raise
        cure = f'{sys.executable} -m pip install {missing}'
        if missing == 'rclpy' or missing.endswith(('_msgs', '_srvs')):
            cure = 'source /opt/ros/jazzy/setup.bash, or without a ROS installation: pip install '
            cure += "'piezo_ident[ros]'"
        sys.stderr.write(
            f'piezo_ident: error: the node {name} needs {missing}, which {sys.executable} does '
            f'not have: {cure}\n'
        )
        ENDING.leave(2)
    ENDING.leave(run(kind))
