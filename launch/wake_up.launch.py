# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wake up the robot as soon as detector and relocalizer are running; see doc/nav2.md."""

# ros2 launch cliploc_ros wake_up.launch.py wake_up_timeout:=120

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

# The arguments differ from those of Nav2's bringup, see relocalization.launch.py.
ARGUMENTS = {
    'namespace': ('', 'namespace of the relocalizer'),
    'relocalizer': ('relocalizer', 'name of the relocalizer in the namespace'),
    'spin': ('spin', "action of Nav2's behavior_server"),
    'wake_up_timeout': ('60.0', 'after this time, no further turn starts [s]'),
    'wake_up_turn_deg': ('45.0', 'angle of the turn between requests [deg]; 0: do not turn'),
    'wake_up_watch': ('false', 'true: wake up again whenever the relocalizer finds the robot '
                               'lost'),
    'log_level': ('info', 'debug, info, warn or error'),
}
MEANINGS = {0: 'accepted', 1: 'refused', 2: 'not ready'}


def generate_launch_description() -> LaunchDescription:
    """Return the description of the wake-up, which logs its result at the end."""
    declared = [DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()]
    wake_up = Node(
        package='cliploc_ros', executable='wake_up', name='wake_up', output='screen',
        namespace=LaunchConfiguration('namespace'),
        arguments=['--relocalizer', LaunchConfiguration('relocalizer'),
                   '--timeout', LaunchConfiguration('wake_up_timeout'),
                   '--turn-deg', LaunchConfiguration('wake_up_turn_deg'),
                   '--watch', LaunchConfiguration('wake_up_watch')],
        remappings=[('spin', LaunchConfiguration('spin'))],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')])
    return LaunchDescription([*declared, RegisterEventHandler(
        OnProcessExit(target_action=wake_up, on_exit=_tell)), wake_up])


def _tell(event: ProcessExited, context: LaunchContext) -> LogInfo:
    return LogInfo(msg=f'wake_up: {MEANINGS.get(event.returncode, event.returncode)}')
