# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``wake_up``: request the pose until it is accepted, turning between requests."""

import argparse
import signal
import sys
from collections.abc import Sequence

from cliploc_ros import command
from cliploc_ros.command import option

_NOT_READY = 2

EPILOG = """\
exit codes: 0 accepted, 1 refused, 2 not ready (or a wrong command line), 130 interrupted

examples:
  wake_up && ros2 launch my_robot mission.launch.py
  wake_up --timeout 120 --turn-deg 30 --ros-args -r __ns:=/robot1 -r spin:=/robot1/nav/spin
"""


def main(args: Sequence[str] | None = None) -> int:
    """Wake the robot up; return the exit code."""
    plain_args, ros_args = command.split_ros_args(sys.argv[1:] if args is None else args)
    options = make_parser().parse_args(plain_args)
    interrupted = command.Interruption()
    interrupted.catch(signal.SIGINT, signal.SIGTERM)
    return command.run_command(lambda: wake_up(options, ros_args, interrupted), failure=_NOT_READY)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command.program('wake_up', EPILOG, 'Wait for an active relocalizer, its camera and a '
                             'localizer; then request the pose until one is accepted, turning '
                             "with Nav2's action spin between requests.",
                             usage='wake_up [options] [--ros-args ...]')
    option(parser, '--relocalizer NAME', 'its name, in the namespace of this node or absolute '
           '(%(default)s)', default='relocalizer')
    option(parser, '--timeout S', 'start no more turns after S seconds, not counting those in '
           'which the relocalizer loads (%(default)g)', command.positive, 60.0)
    option(parser, '--turn-deg DEG', 'turn counterclockwise by this angle between requests; 0: '
           'never (%(default)g)', command.within(-180.0, 180.0), 45.0)
    option(parser, '--watch', 'keep running: wake up again whenever the relocalizer, whose '
           'parameter watch has to be set, finds the robot lost and at rest', default='false',
           nargs='?', choices=('true', 'false'), const='true')
    return parser


def wake_up(options: argparse.Namespace, ros_args: list[str], interrupted: command.Interruption
            ) -> int:
    """Wake the robot up with the options of the command line; return the exit code.

    OptionsError: ROS is missing, or does not start with these arguments.
    """
    with command.needs_ros('wake_up'):
        from cliploc_ros.ros.clients import WakeUp, check_name
    check_name(options.relocalizer)
    with command.running_ros(ros_args):
        node = WakeUp(interrupted, options.relocalizer, options.timeout, options.turn_deg,
                      options.watch == 'true')
        try:
            return node.run()
        finally:
            node.destroy_node()


if __name__ == '__main__':
    sys.exit(main())
