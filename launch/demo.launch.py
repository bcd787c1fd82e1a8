# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The whole graph with the simulated stage and a recorder; then call the identifier.

    ros2 launch piezo_ident demo.launch.py
    ros2 service call /identifier/run std_srvs/srv/Trigger
"""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    share = get_package_share_directory('piezo_ident')
    namespace = LaunchConfiguration('namespace')
    config = LaunchConfiguration('config')
    output = LaunchConfiguration('output')
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='where it all lives'),
            DeclareLaunchArgument(
                'config', default_value=f'{share}/config', description='one YAML file a node'
            ),
            DeclareLaunchArgument(
                'output', default_value='identified', description='folder of ~/save'
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(f'{share}/launch/stage.launch.py'),
                launch_arguments={
                    'namespace': namespace,
                    'config': config,
                    'output': output,
                    'use_simulated_stage': 'true',
                }.items(),
            ),
            Node(
                package='piezo_ident',
                executable='recorder',
                name='recorder',
                namespace=namespace,
                parameters=[
                    PathJoinSubstitution([config, 'recorder.yaml']),
                    {'autostart': True},
                ],
                output='screen',
            ),
        ]
    )
