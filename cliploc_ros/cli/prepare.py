# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``prepare``: make a robot ready, so that its nodes need no network to start."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.command import interrupt_on_sigterm, run_command, split_ros_args
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import OptionsError

EPILOG = """\
It loads what detector and relocalizer load with these parameters: weights are downloaded, networks
converted, the map's labels embedded, and kernels compiled. Then it answers a request for one
picture, and prints what that costs on this machine.

With --cache-dir, what was downloaded and computed lies in a folder. Copy it to a robot, and set
its parameter cache_dir to the copy.

examples:
  prepare --params-file robot.yaml
  prepare --params-file robot.yaml --params-file map.yaml --image kitchen.jpg
  prepare --params-file robot.yaml --cache-dir for_robot
"""


def main(args: Sequence[str] | None = None) -> int:
    """Prepare a robot; return the exit code."""
    plain_args, ros_args = split_ros_args(sys.argv[1:] if args is None else args)
    options = make_parser().parse_args(plain_args)
    interrupt_on_sigterm()
    return run_command(lambda: prepare(options, ros_args))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='prepare', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        usage='prepare --params-file FILE [options] [--ros-args ...]',
        description='Download, convert and compile what the nodes need, and measure a request.')
    parser.add_argument(
        '--params-file', type=Path, action='append', required=True, metavar='FILE',
        help='parameter file of the nodes; repeat it as on their command line')
    parser.add_argument(
        '--image', type=Path, metavar='FILE',
        help="picture of the robot's camera for the request (default: one of the demo)")
    parser.add_argument(
        '--cache-dir', type=Path, metavar='DIR',
        help='keep everything in this folder, to copy it to a robot (default: where the '
        'parameters say)')
    parser.add_argument(
        '--without-detector', action='store_true',
        help='the robot has a detector of its own: load no YOLO, and draw boxes instead')
    return parser


def prepare(options: argparse.Namespace, ros_args: Sequence[str]) -> int:
    """Load both nodes as they start on the robot, and answer a request; return the exit code.

    Raises
    ------
    CliplocError
        Names the file, parameter or download to mend.
    """
    for file in options.params_file:
        read_parameter_file(file)  # its messages name the line
    arguments = [*ros_args, '--ros-args', '-p', 'autostart:=false']
    for file in options.params_file:
        arguments += ['--params-file', str(file)]
    if options.cache_dir is not None:
        options.cache_dir = options.cache_dir.expanduser().absolute()
        arguments += ['-p', f'cache_dir:={options.cache_dir}']
        # Weights in the hub's own cache would be found here, and missing on the robot.
        os.environ['HF_HUB_CACHE'] = str(options.cache_dir / 'weights')
    # As the nodes run, see run_node; PyTorch reads it when it is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    # The nodes here must not meet those of a running robot.
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise OptionsError(
            f'prepare needs ROS 2 ({error}): source it, or run script/setup') from error
    from cliploc_ros.cli.preparation import prepare_nodes

    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # rclpy cannot read the arguments
        raise OptionsError(f'ROS 2 does not start with these arguments: {error}') from error
    try:
        prepare_nodes(options.image, options.cache_dir, not options.without_detector)
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
