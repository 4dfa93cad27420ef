# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``wake_up``: request the pose until it is accepted, turning between looks."""

import argparse
import math
import signal
import sys
from collections.abc import Sequence

from cliploc_ros.command import Interruption, run_command, split_ros_args
from cliploc_ros.errors import OptionsError

_NOT_READY = 2

EPILOG = """\
exit codes: 0 accepted, 1 refused, 2 not ready (or a wrong command line), 130 interrupted

examples:
  wake_up && ros2 launch my_robot mission.launch.py
  wake_up --timeout 120 --turn-deg 30 --ros-args -r __ns:=/robot1 -r spin:=/robot1/nav/spin
"""


def main(args: Sequence[str] | None = None) -> int:
    """Wake the robot up; return the exit code."""
    plain_args, ros_args = split_ros_args(sys.argv[1:] if args is None else args)
    options = make_parser().parse_args(plain_args)
    interrupted = Interruption()
    interrupted.catch(signal.SIGINT, signal.SIGTERM)
    return run_command(lambda: wake_up(options, ros_args, interrupted), failure=_NOT_READY)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='wake_up', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        usage='wake_up [options] [--ros-args ...]',
        description='Wait for an active relocalizer, its camera and a localizer; then request '
        "the pose, and turn with Nav2's action spin between looks, until a pose is accepted.")
    parser.add_argument('--relocalizer', default='relocalizer', metavar='NAME',
                        help='its name, in the namespace of this node or absolute (%(default)s)')
    parser.add_argument('--timeout', type=_positive, default=60.0, metavar='S',
                        help='begin no turn after S seconds (%(default)g)')
    parser.add_argument('--turn-deg', type=_angle, default=45.0, metavar='DEG',
                        help='turn counterclockwise by this much between looks; 0: never '
                        '(%(default)g)')
    return parser


def wake_up(options: argparse.Namespace, ros_args: list[str], interrupted: Interruption
            ) -> int:
    """Wake the robot up with the options of the command line; return the exit code.

    Raises
    ------
    OptionsError
        There is no ROS, or it does not start with these arguments.
    """
    try:
        import rclpy
        from rclpy.exceptions import InvalidServiceNameException
        from rclpy.signals import SignalHandlerOptions
        from rclpy.validate_topic_name import validate_topic_name

        from cliploc_ros.ros.wake_up.waking import WakeUp, WakeUpOptions
    except ImportError as error:
        raise OptionsError(f'wake_up needs ROS 2 ({error}): source it, or run script/setup'
                           ) from error
    try:
        validate_topic_name(f'{options.relocalizer}/relocalize', is_service=True)
    except InvalidServiceNameException as error:
        raise OptionsError(f'--relocalizer: {error}') from error
    try:
        rclpy.init(args=ros_args, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl has its own types, for arguments and for missing folders
        raise OptionsError(f'ROS 2 does not start with these arguments: {error}') from error
    try:
        node = WakeUp(WakeUpOptions(options.relocalizer, options.timeout, options.turn_deg),
                      interrupted)
        try:
            return node.run()
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text} is not a number above 0')
    return value


def _angle(text: str) -> float:
    value = float(text)
    if not -180.0 <= value <= 180.0:
        raise argparse.ArgumentTypeError(f'{text} is outside -180 to 180')
    return value


if __name__ == '__main__':
    sys.exit(main())
