# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Executables of the package: one function for each node.

A node imports and compiles for seconds.  Its module is therefore imported after `ENDING` listens
for signals.
"""

from __future__ import annotations

from functools import partial
import importlib

from piezo_ident.nodes.ending import ENDING


def _run(module: str, name: str) -> None:
    ENDING.listen()
    node = getattr(importlib.import_module(f'piezo_ident.nodes.{module}'), name)
    from piezo_ident.nodes.lab_node import run

    ENDING.leave(run(node))


excitation = partial(_run, 'excitation', 'ExcitationNode')
feedforward = partial(_run, 'feedforward', 'FeedforwardNode')
identifier = partial(_run, 'identifier.node', 'IdentifierNode')
model = partial(_run, 'model', 'ModelNode')
player = partial(_run, 'player', 'PlayerNode')
recorder = partial(_run, 'recorder', 'RecorderNode')
stage = partial(_run, 'stage', 'StageNode')
