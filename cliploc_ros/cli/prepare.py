# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``prepare``: make a robot ready, so that its nodes need no network to start."""

import argparse
import os
import sys
from collections.abc import Sequence

from cliploc_ros.command import needs_ros, option, run_main, running_ros
from cliploc_ros.core.map.parameter_file import read_parameter_file

EPILOG = """\
It loads everything that detector and relocalizer load with these parameters: it downloads and
compiles networks, embeds the map's labels, and compiles kernels.
It answers a request for one picture, and prints its cost on this machine.

With --cache-dir, everything that was downloaded and computed is in one folder. Copy it to a robot,
and set its parameter cache_dir to the copy.

examples:
  prepare --params-file robot.yaml
  prepare --params-file robot.yaml --params-file map.yaml --image kitchen.jpg
  prepare --params-file robot.yaml --cache-dir for_robot
"""


def main(args: Sequence[str] | None = None) -> int:
    """Prepare a robot; return the exit code."""
    return run_main(make_parser(), prepare, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='prepare', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        usage='prepare --params-file FILE [options] [--ros-args ...]',
        description='Download, convert and compile what the nodes need, and measure a request.')
    option(parser, '--params-file FILE', 'parameter file of the nodes; repeat it as on their '
           'command line', action='append', required=True)
    option(parser, '--image FILE', "picture of the robot's camera for the request (default: a "
           'drawn one)')
    option(parser, '--cache-dir DIR', 'keep everything in this folder, to copy it to a robot '
           '(default: as the parameters say)')
    option(parser, '--without-detector', 'the robot has another detector: load no YOLO, and draw '
           'boxes instead')
    return parser


def prepare(options: argparse.Namespace) -> int:
    """Load both nodes as they start on the robot, and answer a request; return the exit code.

    CliplocError: the message names the file, parameter or download to correct.
    """
    for file in options.params_file:
        read_parameter_file(file)  # its messages name the line
    arguments = [*options.ros_args, '--ros-args', '-p', 'autostart:=false']
    for file in options.params_file:
        arguments += ['--params-file', str(file)]
    if options.cache_dir is not None:
        options.cache_dir = options.cache_dir.expanduser().absolute()
        arguments += ['-p', f'cache_dir:={options.cache_dir}']
        # Weights in the hub's default cache would be found here, but be missing on the robot.
        os.environ['HF_HUB_CACHE'] = str(options.cache_dir / 'weights')
    # As in run_node, which runs the nodes; PyTorch reads the variable when it is loaded.
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    # The nodes here must not communicate with those of a running robot.
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    with needs_ros('prepare'):
        import rclpy  # noqa: F401
    from cliploc_ros.cli.preparation import prepare_nodes

    with running_ros(arguments):
        prepare_nodes(options.image, options.cache_dir, not options.without_detector)
    return 0


if __name__ == '__main__':
    sys.exit(main())
