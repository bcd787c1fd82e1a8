# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start one stage: excitation, simulated stage or your own driver, identifier and model.

With `reference` a feedforward node takes the place of the identifier.

    ros2 launch piezo_ident stage.launch.py -s
    ros2 launch piezo_ident stage.launch.py namespace:=left use_simulated_stage:=false
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

#: name, default, choices, what it means; an empty text leaves a parameter as its YAML file has it
ARGUMENTS = (
    ('namespace', '', None, 'where all nodes live'),
    (
        'config',
        str(Path(get_package_share_directory('piezo_ident'), 'config')),
        None,
        'folder with one YAML file of parameters for each node',
    ),
    (
        'use_simulated_stage',
        'true',
        ['true', 'false'],
        'false: a driver of your own publishes displacement and applied_voltage',
    ),
    ('stage', '', None, 'the stage to simulate: paper, dense, effects, two_axes, or a file'),
    (
        'program',
        '',
        None,
        'what /identifier/run and /excitation/start play: a shipped program, or a file',
    ),
    (
        'reference',
        '',
        None,
        'program in micrometres that the stage follows, instead of an identification',
    ),
    ('axes', '', None, 'names of further axes, with commas: b; they play the program in turn'),
    ('model', '', None, 'model file for the live model, and for the feedforward node'),
    ('rate_factor', '', None, 'speed over real time: 0.1 .. 4'),
    ('sample_rate', '', None, 'rate of excitation and recording [Hz]: the rate of your driver'),
    ('output', 'identified', None, 'folder into which /identifier/save writes'),
    ('record', 'false', ['true', 'false'], 'true: record all topics from the start on'),
    ('bag', '', None, 'bag to record; a number is added when it is there'),
    (
        'log_level',
        'info',
        ['debug', 'info', 'warn', 'error', 'fatal'],
        'least level of the log on this console and /rosout',
    ),
)


def nodes(context):
    args = {name: LaunchConfiguration(name).perform(context) for name, *_ in ARGUMENTS}

    def node(executable, **parameters):
        # a folder or a program may look like a number
        values = {
            name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
            for name, value in parameters.items()
            if value not in ('', None)
        }
        file = str(Path(args['config'], f'{executable}.yaml'))
        return Node(
            package='piezo_ident',
            executable=executable,
            name=executable,
            namespace=args['namespace'],
            parameters=[file, values] if values else [file],
            ros_arguments=['--log-level', args['log_level']],
            output='screen',
        )

    rates = {
        name: float(args[name]) if args[name] else None for name in ('rate_factor', 'sample_rate')
    }
    axes = [name.strip() for name in args['axes'].split(',') if name.strip()] or None
    started = [node('model', model=args['model'], axes=axes)]
    if args['reference']:
        # the limits of the program hold, in micrometres too
        reference = {'quantity': 'reference', 'voltage_high': 1000.0, 'ramp_slew': 500.0}
        started += [
            node('excitation', program=args['reference'], axes=axes, **reference, **rates),
            node('feedforward', model=args['model'], axes=axes, sample_rate=rates['sample_rate']),
        ]
    else:
        started += [
            node('excitation', program=args['program'], axes=axes, in_turn=axes and True, **rates),
            node('identifier', program=args['program'], axes=axes, output=args['output']),
        ]
    if args['use_simulated_stage'] == 'true':
        started.append(node('stage', stage=args['stage']))
    if args['record'] == 'true':
        values = {'output': args['bag'], 'sample_rate': rates['sample_rate'], 'axes': axes}
        started.append(node('recorder', autostart=True, **values))
    return started


def generate_launch_description():
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name, default_value=default, choices=choices, description=description
                )
                for name, default, choices, description in ARGUMENTS
            ),
            OpaqueFunction(function=nodes),
        ]
    )
