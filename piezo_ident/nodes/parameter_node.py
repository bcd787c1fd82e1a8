# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Check the arguments and parameters of a node, at its start and while it runs.

ROS silently ignores unknown parameters and arguments, and checks each parameter of a request
against the old values of the others.  `ParameterNode` logs the former, and checks a request as a
whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
import re
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from piezo_ident.common.errors import ConfigError, did_you_mean, PiezoIdentError
from piezo_ident.nodes.journal import Journal, parameters_text
from piezo_ident.nodes.parameters import Declaration
from piezo_ident.record.channels import role_of
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args


def begin() -> None:
    """
    Initialise ROS, without its signal handlers.

    ConfigError when ROS cannot take the arguments, or a file that they name.
    """
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    # the base class of the errors of rcl
    except RuntimeError as error:
        # without the places in the sources of rcl
        text = re.sub(r', at /\S+:\d+|failed to initialize rcl: ', '', str(error))
        text = ' '.join(text.split())
        raise ConfigError(f'ROS does not take the arguments: {text}') from None


def home_problem(path: str) -> str | None:
    """Return the problem if a path begins with an unknown home folder, else None."""
    try:
        Path(path).expanduser()
    except RuntimeError:
        return f'{path}: there is no such home folder; write the path out'
    return None


def no_parameter(node: Node, name: str) -> str:
    """Say that a node has no such parameter, and guess the intended name."""
    guess = did_you_mean(name, node.list_parameters([], 0).names)
    return f'{name} is no parameter of this node{guess and "; "}{guess}'


def unknown_to(node: Node) -> Iterator[str]:
    """Yield a line for each parameter or argument of the command line that the node lacks."""
    names = sorted(getattr(node, '_parameter_overrides', ()))
    yield from (no_parameter(node, name) for name in names if not node.has_parameter(name))
    rest = remove_ros_args(args=sys.argv)[1:]
    if rest:
        yield f'{" ".join(rest)} is passed over; set parameters by --ros-args -p NAME:=VALUE'


class _Together(ParameterService):
    """Service that lets a node check all parameters of a request at once (``ros2 param load``)."""

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        parameters = [Parameter.from_parameter_msg(p) for p in request.parameters]
        response.results = self._get_node().set_parameters(parameters)
        return response


#: the choice of a parameter that switches off
OFF = 'off'


class ParameterNode(Node):
    """
    Node that declares its parameters by `Declaration`, and checks them together.

    A subclass refuses values in `refuse` and acts on them in `apply`.  `values` holds the values
    of all parameters, and `wanted` these values if the present request is accepted.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, start_parameter_services=False, **kwargs)
        self._parameter_service = _Together(self)
        self.journal = Journal(self.get_logger())
        self._declared: dict[str, Declaration] = {}
        self.values: dict[str, Any] = {}
        self.wanted: dict[str, Any] = {}

    def _declare_all(self, declarations: Iterable[Declaration]) -> None:
        for declaration in declarations:
            self._declare(declaration)
        self.add_on_set_parameters_callback(self._validate)
        self.add_post_set_parameters_callback(self._take_over)

    def _declare(self, declaration: Declaration) -> None:
        default = declaration.default
        unit = f' [{declaration.unit}]' if declaration.unit else ''
        choices = f' ({" or ".join(declaration.choices)})' if declaration.choices else ''
        descriptor = ParameterDescriptor(
            description=f'{declaration.description}{unit}{choices}',
            read_only=declaration.read_only,
            # a file or command line may say a bare off, which YAML reads as false
            dynamic_typing=OFF in declaration.choices,
        )
        if declaration.low is not None and declaration.high is not None:
            low, high = declaration.low, declaration.high
            if isinstance(default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=low, to_value=high)
                ]
            else:
                descriptor.integer_range = [
                    IntegerRange(from_value=int(low), to_value=int(high), step=1)
                ]
        value = list(default) if isinstance(default, tuple) else default
        self._declared[declaration.name] = declaration
        parameter = self.declare_parameter(declaration.name, value, descriptor)
        if (spelt := self._spelt(parameter)) is not parameter:
            super().set_parameters_atomically([spelt])
            parameter = spelt
        self.wanted = {**self.values, declaration.name: parameter.value}
        problem = self._problem(declaration.name, parameter.value)
        if problem:
            raise PiezoIdentError(f'{self.get_name()}: {problem}')
        self.values[declaration.name] = parameter.value

    def _problem(self, name: str, value: Any) -> str | None:
        """Return the problem of a value, or None."""
        declaration = self._declared.get(name)
        if declaration is None:
            return None
        if declaration.choices and value not in declaration.choices:
            return f'{name} must be {" or ".join(declaration.choices)}, got {value!r}'
        if isinstance(value, float) and value != value:
            return f'{name} must be a number, got NaN'
        for x in filter(None, value if name == 'axes' else ()):
            if role_of(f'v_{x}') != 'v' or value.count(x) > 1:
                return f'axes: {x!r} cannot be the name of an axis, or is named twice'
        try:
            return self.refuse(name, value)
        except PiezoIdentError as error:
            return str(error)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all parameters or none; a read-only parameter may be set to its present value."""
        result = self._set(parameter_list)
        if not result.successful:
            self.journal.tell(f'parameter refused: {result.reason}', DiagnosticStatus.WARN)
        return result

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """
        Set all parameters at once, or else each parameter that is accepted, in any order.

        A loaded file may move limits that depend on each other.
        """
        together = self._set(parameter_list)
        if together.successful:
            return [together] * len(parameter_list)
        results: dict[int, SetParametersResult] = {}
        left = list(range(len(parameter_list)))
        while left:
            results.update((k, self._set([parameter_list[k]])) for k in left)
            refused = [k for k in left if not results[k].successful]
            if len(refused) == len(left):
                break
            # a parameter that was just set may have prevented the others
            left = refused
        for k in left:
            self.journal.tell(f'parameter refused: {results[k].reason}', DiagnosticStatus.WARN)
        return [results[k] for k in range(len(parameter_list))]

    def _spelt(self, parameter: Parameter) -> Parameter:
        """Convert false to the choice off, since YAML reads a bare off as false."""
        declaration = self._declared.get(parameter.name)
        if declaration and OFF in declaration.choices and parameter.value is False:
            return Parameter(parameter.name, Parameter.Type.STRING, OFF)
        return parameter

    def _set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        parameters = [self._spelt(p) for p in parameters]
        # a loaded file names read-only parameters, too
        wanted = [
            p
            for p in parameters
            if p.name not in self._declared
            or not self._declared[p.name].read_only
            or (p.type_, p.value) != (self.get_parameter(p.name).type_, self.values[p.name])
        ]
        if unknown := [p.name for p in wanted if not self.has_parameter(p.name)]:
            return SetParametersResult(reason=no_parameter(self, unknown[0]))
        if not wanted:
            return SetParametersResult(successful=True)
        try:
            return super().set_parameters_atomically(wanted)
        # the client gets an answer after any failure
        except Exception as error:  # noqa: BLE001
            return SetParametersResult(reason=f'failed: {error!r}')

    def _validate(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        # two new values may each fit the present values, but not each other
        self.wanted = {**self.values, **{p.name: p.value for p in parameters}}
        for parameter in parameters:
            problem = self._problem(parameter.name, parameter.value)
            if problem:
                return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def _take_over(self, parameters: Sequence[Parameter]) -> None:
        changed = {p.name: p.value for p in parameters if p.name in self._declared}
        self.values.update(changed)
        if changed:
            self.journal.tell(f'set: {parameters_text(changed)}')
            self.apply(changed)

    def refuse(self, name: str, value: Any) -> str | None:
        """Return or raise the reason for refusing a value; None accepts it.  See `wanted`."""
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Act on parameters that were set."""
