# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What a node is given when it starts, on its command line or by a launch file.

ROS passes over a parameter or an argument that nobody knows without a word.
"""

from __future__ import annotations

from collections.abc import Iterator
import difflib
from pathlib import Path
import re
import sys

from piezo_ident.common.errors import ConfigError
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args


def begin() -> None:
    """
    Initialise ROS, without its signal handlers.

    Raises
    ------
    ConfigError
        When ROS cannot take the arguments, or a file that they name.
    """
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    # of which the classes of rcl's errors are
    except RuntimeError as error:
        # without the places in the sources of rcl
        text = re.sub(r', at /\S+:\d+|failed to initialize rcl: ', '', str(error))
        text = ' '.join(text.split())
        raise ConfigError(f'ROS does not take the arguments: {text}') from None


def home_problem(path: str) -> str | None:
    """Return what is wrong with the home folder with which a path begins, None when nothing is."""
    try:
        Path(path).expanduser()
    except RuntimeError:
        return f'{path}: there is no such home folder; write the path out'
    return None


def no_parameter(node: Node, name: str) -> str:
    """Return that a node has no such parameter, and the name that may be meant."""
    known = node.list_parameters([], 0).names
    close = difflib.get_close_matches(name, known, n=1)
    guess = f'; did you mean {close[0]}?' if close else ''
    return f'{name} is no parameter of this node{guess}'


def unknown_to(node: Node) -> Iterator[str]:
    """Return a line on each parameter and argument that was given and that the node has not."""
    given = getattr(node, '_parameter_overrides', ())
    yield from (no_parameter(node, name) for name in sorted(given) if not node.has_parameter(name))
    rest = remove_ros_args(args=sys.argv)[1:]
    if rest:
        yield f'{" ".join(rest)} is passed over; set parameters by --ros-args -p NAME:=VALUE'
