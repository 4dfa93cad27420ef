# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``doctor``: check everything that a request needs, or make a robot ready."""

import argparse
import os
import sys
from collections.abc import Sequence

from cliploc_ros import command
from cliploc_ros.command import option
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import OptionsError

EPILOG = """\
It reads the parameters and topics of the running relocalizer, listens to the same topics, and
answers one request. It changes nothing, and sends no pose to a localizer. If the nodes are not
running, give their parameter files and the same remappings.

With --prepare, it needs no robot: it loads everything that detector and relocalizer load with
these parameters. It downloads and compiles networks, embeds the map's labels and compiles kernels.
It answers requests for one picture, and prints their cost on this machine. With --cache-dir,
everything that was downloaded and computed is in one folder. Copy it to a robot, and set its
parameter cache_dir to the copy.

exit codes: 0 no check failed, 1 a check failed

examples:
  doctor
  doctor --relocalizer /robot1/relocalizer
  doctor --params-file robot.yaml --ros-args -r image:=/camera/image_raw
  doctor --prepare --params-file robot.yaml --image kitchen.jpg --cache-dir for_robot
"""


def main(args: Sequence[str] | None = None) -> int:
    """Check a robot; return the exit code."""
    return command.run_main(make_parser(), run, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command.program('doctor', EPILOG, 'Check parameters, map, cameras, clocks, tf, '
                             'odometry, localizer, the input of a request and its answer. Each '
                             'failure comes with its remedy.',
                             usage='doctor [options] [--ros-args ...]')
    option(parser, '--relocalizer NAME', 'its name, absolute or in the namespace of this node '
           '(%(default)s)', default='relocalizer')
    option(parser, '--params-file FILE', 'check with these parameters; repeat it as on the '
           'command line of the node (default: ask the running relocalizer)', default=[],
           action='append')
    option(parser, '--timeout S', 'wait S seconds for an input (%(default)g)',
           command.positive, 10.0)
    option(parser, '--prepare', 'make a robot ready, so that its nodes need no network to start')
    option(parser, '--image FILE', "--prepare: picture of the robot's camera for the requests "
           '(default: a drawn one)')
    option(parser, '--cache-dir DIR', '--prepare: keep everything in this folder, to copy it to a '
           'robot (default: as the parameters say)')
    option(parser, '--without-detector', '--prepare: the robot has another detector; draw boxes')
    return parser


def run(options: argparse.Namespace) -> int:
    """Check and print; return the exit code. CliplocError: a file cannot be read."""
    arguments = options.ros_args
    if options.prepare:
        arguments = prepared_arguments(options)
    with command.needs_ros('doctor'):
        from cliploc_ros.nodes.doctor import Report, State, doctor, make_ready

    report = Report(lambda what, state, text: print(
        f'{what:<12} {state:<12} {command.printable(text)}', flush=True))
    with command.running_ros(arguments):
        if options.prepare:
            for line in make_ready(options.image, options.cache_dir, not options.without_detector,
                                   report):
                print(line)
        else:
            doctor(options.params_file, options.relocalizer, options.timeout, report)
    failed = [what for what, state in report.findings if state is State.FAIL]
    print(f'{len(failed)} of {len(report.findings)} failed: {", ".join(failed)}' if failed else
          f'nothing failed in {len(report.findings)} checks' + (
              ', but no pose was accepted here' if any(
                  state is State.REFUSED for _, state in report.findings) else ''))
    return int(bool(failed))


def prepared_arguments(options: argparse.Namespace) -> list[str]:
    """Set the environment of nodes that only load; return the arguments of rclpy."""
    if not options.params_file:
        raise OptionsError('--prepare needs --params-file')
    arguments = [*options.ros_args, '--ros-args', '-p', 'autostart:=false']
    for file in options.params_file:
        read_parameter_file(file)  # its messages name the line
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
    return arguments


if __name__ == '__main__':
    sys.exit(main())
