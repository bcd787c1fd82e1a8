# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Several nodes in one process: fewer interpreters, one executor.

    ros2 run piezo_ident composed stage model --ros-args -r __ns:=/stage_1

They talk through their topics as before.  What it saves and what it costs is measured in
docs/live_stages.md: they share one interpreter, so a node that is busy makes the others wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import importlib
import sys

from piezo_ident.nodes.base import LabNode, run_together

__all__ = ['main']

#: module and class of every node that may share a process
NODES = {
    'stage': 'StageNode',
    'model': 'ModelNode',
    'identifier': 'IdentifierNode',
    'recorder': 'RecorderNode',
    'excitation': 'ExcitationNode',
    'player': 'PlayerNode',
}


def _maker(name: str) -> Callable[[], LabNode]:
    def make() -> LabNode:
        module = importlib.import_module(f'piezo_ident.nodes.{name}')
        node: LabNode = getattr(module, NODES[name])()
        return node

    return make


def main(argv: Sequence[str] | None = None) -> int:
    """Run the nodes that are named before ``--ros-args``."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    end = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    names, rest = arguments[:end], arguments[end:]
    unknown = [name for name in names if name not in NODES]
    if not names or unknown or len(set(names)) < len(names):
        said = f'there is no node {unknown[0]!r}' if unknown else 'name each node once'
        sys.stderr.write(
            f'piezo_ident: error: composed: {said}; choose from {", ".join(NODES)}, as in '
            'composed stage model\n'
        )
        return 2
    return run_together([_maker(name) for name in names], rest)


if __name__ == '__main__':
    raise SystemExit(main())
