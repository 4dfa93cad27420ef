# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Let a robot wake up in a synthetic room: ``python -m demo``.

The demo runs offline with the shipped models.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.command import needs_ros, option, positive, positive_int, run_main
from demo import ASSETS

EPILOG = """\
The demo plays a recording to the real detector and relocalizer, each in its own process. At each
wake-up the robot stops, calls ~/relocalize, and continues after the answer. At the end the demo
writes a page of pictures to the folder of --out. With --map it first builds a map from a mapping
walk and compares it with the room; the robot then wakes up in that map.
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit code."""
    return run_main(make_parser(), demonstrate, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='demo', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Let a robot wake up in a synthetic room, and draw the results.')
    option(parser, '--out DIR', 'folder for the pictures (default: ./%(default)s)',
           default=Path('demo_out'))
    option(parser, '--wake-ups N', 'number of wake-ups along the recording (default: %(default)s)',
           positive_int, 10)
    option(parser, '--rate X', 'speed between wake-ups; 2 is twice as fast as recorded (default: '
           '%(default)g)', positive, 8.0)
    option(parser, '--method MATCHING_ALGORITHM', 'a method of the paper, such as class_bf or '
           'clip_prosac (default: %(default)s)', default='hybrid_auto')
    option(parser, '--assets DIR', 'world to use instead of the shipped one: sequence/ (a TUM '
           'folder), map.yaml, yolo.onnx, mapping/ for --map, and clip/ for all methods but '
           "class_*; with --real only the networks, instead of the default profile's")
    ways = parser.add_mutually_exclusive_group()
    option(ways, '--map', "build the map from the assets' mapping walk (mapping/), and wake up "
           'in it')
    option(ways, '--real', 'download a recording of a real room (344 MB; it asks first, and the '
           'same command continues later), build its map, and wake up in it')
    option(parser, '--cameras', '4: a robot with cameras in four directions, which does not turn '
           '(default: 1)', int, 1, choices=(1, 4))
    option(ways, '--kidnapped', 'move a driving robot elsewhere: the watch detects it, and the '
           'robot relocalizes')
    option(parser, '--rviz', 'show the topics in RViz, where it is installed')
    option(parser, '--yes', 'do not ask before the download of --real')
    option(parser, '--sources YAML', 'file with the address and digest of the recording of --real '
           '(default: studies/reproduce.yaml)', Path)
    return parser


def demonstrate(options: argparse.Namespace) -> int:
    """Run the demo with the given options; return the exit code."""
    with needs_ros('the demo'):
        import rclpy  # noqa: F401
    from demo.run import DemoOptions, run_demo

    assets = options.assets or ASSETS
    own = not options.real or options.assets is not None
    chosen = DemoOptions(assets=assets, out=options.out, wake_ups=options.wake_ups,
                         detector={'model': assets / 'yolo.onnx'} if own else {},
                         encoder={'clip_pretrained': assets / 'clip'}
                         if own and not options.method.startswith('class') else {},
                         rate=options.rate, method=options.method, rviz=options.rviz,
                         has_rig=options.cameras > 1, is_watched=options.kidnapped)
    if options.real:
        from demo.real import run_real_demo

        return run_real_demo(chosen, options.sources, is_asked=not options.yes)
    if options.kidnapped:
        from demo.kidnapped import run_kidnapped

        run_kidnapped(chosen)
    elif options.map:
        from demo.map_demo import run_map_demo

        run_map_demo(chosen)
    else:
        run_demo(chosen)
    return 0


if __name__ == '__main__':
    sys.exit(main())
