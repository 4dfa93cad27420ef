# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``demo``: a robot wakes up in a synthetic room; offline, with shipped models."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.command import interrupt_on_sigterm, run_command, split_ros_args
from cliploc_ros.demo import ASSETS
from cliploc_ros.errors import OptionsError

EPILOG = """\
The demo plays a recording to the real detector and relocalizer, each in its own process. At each
wake-up the robot stops, calls ~/relocalize, and goes on after the answer. At the end the demo
writes a page of pictures to the folder of --out. With --map it first builds a map from a mapping
walk and compares it with the room; the robot then wakes up in that map.
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit code."""
    plain_args, _ = split_ros_args(sys.argv[1:] if args is None else args)
    options = make_parser().parse_args(plain_args)
    interrupt_on_sigterm()
    return run_command(lambda: demonstrate(options))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='demo', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Let a robot wake up in a synthetic room, and draw the results.')
    parser.add_argument(
        '--out', type=Path, default=Path('demo_out'), metavar='DIR',
        help='folder for the pictures (default: ./%(default)s)')
    parser.add_argument(
        '--wake-ups', type=_at_least_one, default=10, metavar='N',
        help='number of wake-ups along the recording (default: %(default)s)')
    parser.add_argument(
        '--rate', type=_positive, default=4.0, metavar='X',
        help='speed between wake-ups; 2 is twice as fast as recorded (default: %(default)g)')
    parser.add_argument(
        '--method', default='hybrid_auto', metavar='MATCHING_ALGORITHM',
        help='a method of the paper, such as class_bf or clip_prosac (default: %(default)s)')
    parser.add_argument(
        '--assets', type=Path, default=ASSETS, metavar='DIR',
        help='another world than the shipped one: sequence/ (a TUM folder), map.yaml, yolo.pt, '
        'for --map mapping/, and except for class_* clip.json and clip.safetensors')
    parser.add_argument(
        '--map', action='store_true',
        help="build the map from the assets' mapping walk (mapping/), and wake up in it")
    parser.add_argument(
        '--rviz', action='store_true', help='show the topics in RViz, where it is installed')
    return parser


def demonstrate(options: argparse.Namespace) -> int:
    """Run the demo as the command line says; return the exit code."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise OptionsError(
            f'the demo needs ROS 2 ({error}): source it, or run script/setup'
        ) from error
    from cliploc_ros.demo.run import DemoOptions, run_demo

    chosen = DemoOptions(assets=options.assets, out=options.out, wake_ups=options.wake_ups,
                         rate=options.rate, method=options.method, rviz=options.rviz)
    if options.map:
        from cliploc_ros.demo.map_demo import run_map_demo

        run_map_demo(chosen)
    else:
        run_demo(chosen)
    return 0


def _at_least_one(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not a number of 1 or more')
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a number above 0')
    return value


if __name__ == '__main__':
    sys.exit(main())
