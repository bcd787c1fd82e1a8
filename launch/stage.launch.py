# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
