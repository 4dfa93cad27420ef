# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo: a walk through a synthetic room, ten requests, a page of pictures."""

# ros2 launch cliploc_ros demo.launch.py rviz:=true

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix


def generate_launch_description() -> LaunchDescription:
    """Return the demo, which starts its own nodes."""
    rviz = LaunchConfiguration('rviz')
    demo = PathJoinSubstitution([FindPackagePrefix('cliploc_ros'), 'lib', 'cliploc_ros', 'demo'])
    command = [demo, '--out', LaunchConfiguration('out')]
    return LaunchDescription([
        DeclareLaunchArgument('rviz', default_value='false', description='true: open RViz'),
        DeclareLaunchArgument('out', default_value='demo_out', description='folder of pictures'),
        ExecuteProcess(cmd=command, output='screen', on_exit=Shutdown(),
                       condition=UnlessCondition(rviz)),
        ExecuteProcess(cmd=[*command, '--rviz'], output='screen', on_exit=Shutdown(),
                       condition=IfCondition(rviz)),
    ])
