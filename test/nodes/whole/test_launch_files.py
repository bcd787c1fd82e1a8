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

ROOT = Path(__file__).resolve().parents[3]


class Substitution:
    """What is known only when it is launched."""


class LaunchConfiguration(Substitution):
    def __init__(self, variable_name):
        self.name = variable_name

    def perform(self, context):
        return context[self.name]


class ParameterValue(Substitution):
    def __init__(self, value, *, value_type=None, description=None):
        self.value, self.type = value, value_type

    def perform(self, context):
        return self.type(perform(self.value, context))


def perform(what, context):
    if isinstance(what, list):
        # an array of texts
        return what
    if isinstance(what, tuple):
        return ''.join(perform(part, context) for part in what)
    return what.perform(context) if isinstance(what, Substitution) else what


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description=None, choices=None):
        assert description and not description.endswith('.')
        assert choices is None or default_value in choices
        self.name, self.default, self.choices = name, default_value, choices

    def visit(self, context, started):
        context.setdefault(self.name, perform(self.default, context))
        if self.choices is not None and context[self.name] not in self.choices:
            raise RuntimeError(f'{self.name}: {context[self.name]} is none of {self.choices}')


class OpaqueFunction:
    def __init__(self, *, function):
        self.function = function

    def visit(self, context, started):
        for entity in self.function(context):
            entity.visit(context, started)


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
    ):
        assert package == 'piezo_ident' and output == 'screen' and name == executable
        self.executable, self.namespace = executable, namespace
        self.parameters, self.arguments = parameters, ros_arguments

    def visit(self, context, started):
        values = {}
        for parameters in self.parameters:
            if isinstance(parameters, dict):
                assert parameters, 'launch_ros wants at least one parameter of a mapping'
                values.update({k: perform(v, context) for k, v in parameters.items()})
                continue
            read = yaml.safe_load(Path(perform(parameters, context)).read_text(encoding='utf-8'))
            (block,) = read.values()
            values.update(block['ros__parameters'])
        assert set(values) <= {d.name for d in NODES[self.executable]}
        started[perform(self.namespace, context), self.executable] = values
        assert self.arguments == ['--log-level', context['log_level']]


class PythonLaunchDescriptionSource:
    def __init__(self, location):
        self.location = location


class IncludeLaunchDescription:
    def __init__(self, source, *, launch_arguments=None):
        self.path, self.arguments = source.location, list(launch_arguments or ())

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
        'OpaqueFunction': OpaqueFunction,
    },
    'launch.launch_description_sources': {
        'PythonLaunchDescriptionSource': PythonLaunchDescriptionSource
    },
    'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
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


def file_of(name):
    return ROOT / f'launch/{name}.launch.py'


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
    started = carry_out(file_of('demo'), {'output': '42'}, {})
    names = {'excitation', 'stage', 'identifier', 'model', 'recorder'}
    assert set(started) == {('', name) for name in names} and names < set(NODES)
    assert started['', 'recorder']['autostart'] is True
    assert started['', 'identifier']['output'] == '42'


@pytest.mark.parametrize('file', ['demo', 'stage'])
def test_a_driver_takes_the_place_of_the_stage(file):
    context = {'use_simulated_stage': 'false', 'record': 'false'}
    started = carry_out(file_of(file), context, {})
    assert set(started) == {('', n) for n in ('excitation', 'identifier', 'model')}


@pytest.mark.parametrize('file', ['demo', 'stage'])
def test_arguments_reach_their_nodes(file):
    context = {
        'stage': 'dense',
        'program': '7',
        'rate_factor': '0.25',
        'sample_rate': '10e3',
        'record': 'true',
        'bag': 'monday',
        'log_level': 'warn',
    }
    started = {n: v for (_, n), v in carry_out(file_of(file), context, {}).items()}
    assert started['stage']['stage'] == 'dense'
    assert started['excitation']['program'] == started['identifier']['program'] == '7'
    assert started['excitation']['rate_factor'] == 0.25
    assert started['excitation']['sample_rate'] == started['recorder']['sample_rate'] == 10e3
    assert started['recorder']['output'] == 'monday'


def test_a_stage_follows_a_reference_with_a_model():
    context = {'model': 'm.yaml', 'stage': 'effects', 'record': 'true', 'sample_rate': '10e3'}
    started = {n: v for (_, n), v in carry_out(file_of('track'), context, {}).items()}
    assert set(started) == {'excitation', 'stage', 'model', 'feedforward', 'recorder'}
    assert started['model']['model'] == started['feedforward']['model'] == 'm.yaml'
    assert started['excitation']['program'] == 'scan'
    assert started['excitation']['quantity'] == 'reference'
    assert started['excitation']['sample_rate'] == started['feedforward']['sample_rate'] == 10e3


def test_two_axes_reach_every_node():
    started = {
        n: v for (_, n), v in carry_out(file_of('two_axes'), {'record': 'true'}, {}).items()
    }
    assert set(started) == {'excitation', 'stage', 'identifier', 'model', 'recorder'}
    assert started['stage']['stage'] == 'two_axes'
    for name in ('excitation', 'identifier', 'model', 'recorder'):
        assert started[name]['axes'] == ['b']
    assert started['excitation']['in_turn'] is True
    assert started['excitation']['sample_rate'] == started['recorder']['sample_rate'] == 2000.0
    # without axes the files say what to do
    alone = {n: v for (_, n), v in carry_out(file_of('stage'), {}, {}).items()}
    assert alone['excitation']['axes'] == [''] and alone['excitation']['in_turn'] is False
    context = {'axes': 'b, c', 'reference': 'scan', 'model': 'm.yaml'}
    track = {n: v for (_, n), v in carry_out(file_of('stage'), context, {}).items()}
    assert track['feedforward']['axes'] == track['excitation']['axes'] == ['b', 'c']


def test_a_value_that_is_no_choice_is_refused():
    with pytest.raises(RuntimeError, match='use_simulated_stage: no'):
        carry_out(file_of('demo'), {'use_simulated_stage': 'no'}, {})


def test_a_stage_in_a_namespace_with_a_driver_and_a_configuration_of_its_own(tmp_path):
    for name in NODES:
        text = (ROOT / f'config/{name}.yaml').read_text(encoding='utf-8')
        text = text.replace('program: identification', 'program: holds')
        (tmp_path / f'{name}.yaml').write_text(text.replace('max_order: 15', 'max_order: 7'))
    context = {'namespace': 'left', 'config': str(tmp_path), 'use_simulated_stage': 'false'}
    started = carry_out(file_of('stage'), context, {})
    assert set(started) == {('left', n) for n in ('excitation', 'identifier', 'model')}
    assert started['left', 'identifier']['max_order'] == 7
    # what is not given stays as the files have it
    assert started['left', 'identifier']['output'] == 'identified'
    assert {started['left', n]['program'] for n in ('excitation', 'identifier')} == {'holds'}


def test_nothing_else_is_imported():
    for path in (ROOT / 'launch').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            assert not isinstance(node, ast.Import)
            if isinstance(node, ast.ImportFrom) and node.module != 'pathlib':
                assert {alias.name for alias in node.names} <= set(MODULES[node.module])


def test_the_page_lists_the_arguments():
    page = (ROOT / 'docs/graph.md').read_text(encoding='utf-8')
    table = page.partition('| argument |')[2].partition('\n\n')[0]
    rows = [line.split('`')[1] for line in table.splitlines() if line.startswith('| `')]
    context = {}
    carry_out(file_of('stage'), context, {})
    assert rows == list(context)
