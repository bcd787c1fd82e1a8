# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One stage in a namespace: excitation, stage (or a DAQ driver of your own), identifier, model.

    ros2 launch piezo_ident stage.launch.py namespace:=left use_simulated_stage:=false
"""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description():
    namespace = LaunchConfiguration('namespace')
    config = LaunchConfiguration('config')
    output = LaunchConfiguration('output')

    def node(executable, *more, **kwargs):
        return Node(
            package='piezo_ident',
            executable=executable,
            name=executable,
            namespace=namespace,
            parameters=[PathJoinSubstitution([config, f'{executable}.yaml']), *more],
            output='screen',
            **kwargs,
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='where it all lives'),
            DeclareLaunchArgument(
                'config',
                default_value=[get_package_share_directory('piezo_ident'), '/config'],
                description='folder with one YAML file a node',
            ),
            DeclareLaunchArgument(
                'use_simulated_stage',
                default_value='true',
                description='false: a DAQ driver publishes displacement and applied_voltage',
            ),
            DeclareLaunchArgument(
                'output', default_value='identified', description='folder of ~/save'
            ),
            node('excitation'),
            node('stage', condition=IfCondition(LaunchConfiguration('use_simulated_stage'))),
            # a folder may look like a number
            node('identifier', {'output': ParameterValue(output, value_type=str)}),
            node('model'),
        ]
    )
