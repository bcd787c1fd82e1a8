# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``node``: start a node without the tools of ROS, or describe the node and its parameters."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace
from typing import Any

from piezo_ident.cli.console import Console
from piezo_ident.common.errors import ConfigError, did_you_mean
from piezo_ident.report.table import plain_text, Table


def node_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident node``."""
    # the room of the nodes is above the command line, so they are imported by name
    main = importlib.import_module('piezo_ident.nodes.main')
    if args.name is None:
        lines = [f'{name:12} {purpose}' for name, (*_, purpose) in main.NODES.items()]
        console.say('\n'.join([*lines, '\npiezo_ident node NAME --help lists its parameters']))
        return
    if args.name not in main.NODES:
        cure = did_you_mean(args.name, main.NODES) or f'give {", ".join(main.NODES)}'
        raise ConfigError(f'no such node: {args.name}; {cure}')
    if {'-h', '--help'} & set(args.arguments):
        console.say(_help(args.name, main.NODES[args.name][-1]))
    else:
        sys.argv = [f'piezo_ident node {args.name}', *args.arguments]
        main.start(args.name)


def _help(name: str, purpose: str) -> str:
    declared = importlib.import_module('piezo_ident.nodes.parameters').NODES[name]
    table = Table('', ('parameter', 'default', 'unit', 'from', 'to', ''), [*map(_row, declared)])
    return plain_text(
        [f'Usage: piezo_ident node {name} [--ros-args ...]', f'{name}: {purpose}', table]
    )


def _row(d: Any) -> tuple[str, ...]:
    value = ', '.join(d.default) if isinstance(d.default, tuple) else str(d.default)
    low, high = ('' if x is None else f'{x:g}' for x in (d.low, d.high))
    about = f'{d.description}: {" or ".join(d.choices)}' if d.choices else d.description
    return (d.name, value, d.unit, low, high, about)
