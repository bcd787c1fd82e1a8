# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The executables of the package: one function a node.

A node imports and compiles for seconds, so its module is imported when signals are heard already.
"""

from __future__ import annotations

from functools import partial
import importlib

from piezo_ident.nodes.ending import ENDING

__all__ = ['excitation', 'feedforward', 'identifier', 'model', 'player', 'recorder', 'stage']


def _run(node: str) -> None:
    ENDING.listen()
    code = importlib.import_module(f'piezo_ident.nodes.{node}').main()
    ENDING.leave(code)


excitation = partial(_run, 'excitation')
feedforward = partial(_run, 'feedforward')
identifier = partial(_run, 'identifier')
model = partial(_run, 'model')
player = partial(_run, 'player')
recorder = partial(_run, 'recorder')
stage = partial(_run, 'stage')
