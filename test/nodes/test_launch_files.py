# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The launch files, carried out as far as that goes without launch.

What they import is replaced by classes that take the same arguments; substitutions are performed
as launch performs them.  So a misspelt argument, a node that is not installed, and a YAML file
that is not there are found on machines without ROS.
"""

import ast
import importlib.util
from pathlib import Path
import sys
from types import ModuleType

from piezo_ident.nodes.parameters import NODES
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


class Substitution:
    """What is known only when it is launched."""


class LaunchConfiguration(Substitution):
    def __init__(self, variable_name):
        self.name = variable_name

    def perform(self, context):
        return context[self.name]


class PathJoinSubstitution(Substitution):
    def __init__(self, substitutions):
        self.parts = substitutions

    def perform(self, context):
        return str(Path(*(perform(part, context) for part in self.parts)))


class ParameterValue(Substitution):
    def __init__(self, value, *, value_type=None, description=None):
        self.value, self.type = value, value_type

    def perform(self, context):
        return self.type(perform(self.value, context))


def perform(what, context):
    if isinstance(what, (list, tuple)):
        return ''.join(perform(part, context) for part in what)
    return what.perform(context) if isinstance(what, Substitution) else what


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description=None, choices=None):
        assert description
        self.name, self.default = name, default_value

    def visit(self, context, started):
        context.setdefault(self.name, perform(self.default, context))


class IfCondition:
    def __init__(self, predicate_expression):
        self.expression = predicate_expression

    def holds(self, context):
        return {'true': True, 'false': False}[perform(self.expression, context)]


class Node:
    def __init__(
        self,
        *,
        executable,
        package=None,
        name=None,
        namespace=None,
        exec_name=None,
        parameters=None,
        remappings=None,
        ros_arguments=None,
        arguments=None,
        output=None,
        condition=None,
    ):
        assert package == 'piezo_ident' and output == 'screen' and name == executable
        self.executable, self.namespace = executable, namespace
        self.parameters, self.condition = parameters, condition

    def visit(self, context, started):
        if self.condition is not None and not self.condition.holds(context):
            return
        values = {}
        for parameters in self.parameters:
            if isinstance(parameters, dict):
                values.update({k: perform(v, context) for k, v in parameters.items()})
                continue
            read = yaml.safe_load(Path(perform(parameters, context)).read_text(encoding='utf-8'))
            (block,) = read.values()
            values.update(block['ros__parameters'])
        started[perform(self.namespace, context), self.executable] = values


class PythonLaunchDescriptionSource:
    def __init__(self, location):
        self.location = location


class IncludeLaunchDescription:
    def __init__(self, source, *, launch_arguments=None):
        self.path, self.arguments = source.location, list(launch_arguments)

    def visit(self, context, started):
        inner = dict(context)
        inner.update({name: perform(value, context) for name, value in self.arguments})
        carry_out(self.path, inner, started)


class LaunchDescription:
    def __init__(self, entities):
        self.entities = entities


MODULES = {
    'ament_index_python.packages': {'get_package_share_directory': lambda package: str(ROOT)},
    'launch': {'LaunchDescription': LaunchDescription},
    'launch.actions': {
        'DeclareLaunchArgument': DeclareLaunchArgument,
        'IncludeLaunchDescription': IncludeLaunchDescription,
    },
    'launch.conditions': {'IfCondition': IfCondition},
    'launch.launch_description_sources': {
        'PythonLaunchDescriptionSource': PythonLaunchDescriptionSource
    },
    'launch.substitutions': {
        'LaunchConfiguration': LaunchConfiguration,
        'PathJoinSubstitution': PathJoinSubstitution,
    },
    'launch_ros.actions': {'Node': Node},
    'launch_ros.parameter_descriptions': {'ParameterValue': ParameterValue},
}


def carry_out(path, context, started):
    spec = importlib.util.spec_from_file_location('launch_file', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for entity in module.generate_launch_description().entities:
        entity.visit(context, started)
    return started


@pytest.fixture(autouse=True)
def launch(monkeypatch):
    for name, contents in MODULES.items():
        for part in (name.partition('.')[0], name):
            module = sys.modules.get(part)
            if module is None or not hasattr(module, '_ours'):
                module = ModuleType(part)
                module._ours = True
                monkeypatch.setitem(sys.modules, part, module)
        vars(sys.modules[name]).update(contents)


def test_the_whole_graph_with_a_recorder():
    started = carry_out(ROOT / 'launch/demo.launch.py', {'output': '42'}, {})
    names = {'excitation', 'stage', 'identifier', 'model', 'recorder'}
    assert set(started) == {('', name) for name in names} and names < set(NODES)
    assert started['', 'recorder']['autostart'] is True
    assert started['', 'identifier']['output'] == '42'
    for (_, name), values in started.items():
        assert set(values) <= {d.name for d in NODES[name]}


def test_a_stage_in_a_namespace_with_a_driver_and_a_configuration_of_its_own(tmp_path):
    for name in NODES:
        text = (ROOT / f'config/{name}.yaml').read_text(encoding='utf-8')
        (tmp_path / f'{name}.yaml').write_text(text.replace('max_order: 15', 'max_order: 7'))
    context = {'namespace': 'left', 'config': str(tmp_path), 'use_simulated_stage': 'false'}
    started = carry_out(ROOT / 'launch/stage.launch.py', context, {})
    assert set(started) == {('left', n) for n in ('excitation', 'identifier', 'model')}
    assert started['left', 'identifier']['max_order'] == 7
    assert started['left', 'identifier']['output'] == 'identified'


def test_nothing_else_is_imported():
    for path in (ROOT / 'launch').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            assert not isinstance(node, ast.Import)
            if isinstance(node, ast.ImportFrom):
                assert {alias.name for alias in node.names} <= set(MODULES[node.module])
