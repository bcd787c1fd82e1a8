# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the nodes of stage.launch.py, with its arguments, and a recorder; then call the identifier.

    ros2 launch piezo_ident demo.launch.py
    ros2 service call /identifier/run std_srvs/srv/Trigger
"""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from launch import LaunchDescription


def generate_launch_description():
    share = get_package_share_directory('piezo_ident')
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'record',
                default_value='true',
                choices=['true', 'false'],
                description='false: record nothing',
            ),
            # sees the arguments of this file, and those of the command line
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(f'{share}/launch/stage.launch.py')
            ),
        ]
    )
