# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start a stage that follows a reference: stage.launch.py with its arguments, and `reference`.

    ros2 launch piezo_ident track.launch.py model:=refined.yaml
    ros2 service call /feedforward/start std_srvs/srv/Trigger
    ros2 service call /excitation/start std_srvs/srv/Trigger
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
                'reference',
                default_value='scan',
                description='program in micrometres that the stage follows',
            ),
            # sees the arguments of this file, and those of the command line
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(f'{share}/launch/stage.launch.py')
            ),
        ]
    )
