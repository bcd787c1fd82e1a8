# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the nodes of stage.launch.py, with its arguments, for two axes; then call the identifier.

    ros2 launch piezo_ident two_axes.launch.py
    ros2 service call /identifier/run std_srvs/srv/Trigger
"""

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from launch import LaunchDescription

#: name, default, what it means
ARGUMENTS = (
    ('stage', 'two_axes', 'the stage to simulate: two_axes, or a file'),
    ('axes', 'b', 'names of further axes, with commas; they play the program in turn'),
    ('sample_rate', '2000.0', 'rate of excitation and recording [Hz]: the rate of the stage'),
    ('program', 'scanner', 'what /identifier/run and /excitation/start play'),
)


def generate_launch_description():
    share = get_package_share_directory('piezo_ident')
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, default, description in ARGUMENTS
            ),
            # sees the arguments of this file, and those of the command line
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(f'{share}/launch/stage.launch.py')
            ),
        ]
    )
