# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``replay``: publish a recording without ``ros2 bag``."""

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from cliploc_ros import command
from cliploc_ros.command import option
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.datasets.bag_messages import ODOMETRY
from cliploc_ros.offline.datasets.bags import BagReader
from cliploc_ros.units import NS_PER_S

NODE_NAME = 'replay'

EPILOG = """\
examples:
  replay office --clock --wait-for-subscribers /image
  replay office --loop --stand
  replay office --rate 0.5 --topics /image /camera_info --remap /image:=/camera/image
"""


def main(args: Sequence[str] | None = None) -> int:
    """Publish a recording; return the exit code."""
    arguments = list(sys.argv[1:] if args is None else args)
    stop = command.Interruption()
    stop.catch(signal.SIGINT, signal.SIGTERM)
    return command.run_command(lambda: replay(arguments, stop))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command.program('replay', EPILOG, 'Publish the messages of a rosbag2 recording '
                             '(sqlite3 or mcap, also those of `ros2 bag record`) with their '
                             'recorded bytes, types and QoS.',
                             usage='replay BAG [options] [--ros-args ...]')
    option(parser, 'bag BAG', 'folder, or a .mcap or .db3 file', Path)
    option(parser, '-r --rate X', 'speed: 2 is twice as fast as recorded (default: 1)',
           command.positive, 1.0)
    option(parser, '-l --loop', 'begin again at the end')
    option(parser, '--stand S', 'let the robot stand for S seconds (default: 20) after every 3 s '
           'of its drive: a robot that drives is not relocalized', command.positive, 0.0,
           nargs='?', const=20.0)
    option(parser, '--start-offset S', 'begin S seconds after the start of the recording',
           command.not_negative, 0.0)
    option(parser, '--topics TOPIC', 'publish only these (default: all)', _absolute, nargs='+')
    option(parser, '--exclude TOPIC', 'leave these out', _absolute, [], nargs='+')
    option(parser, '-m --remap OLD:=NEW', 'publish the recorded topic OLD as NEW', _remap_rule, [],
           nargs='+')
    option(parser, '--clock HZ', "publish the recording's time on /clock, HZ times a second "
           '(default: 40), for nodes with use_sim_time; with --loop it jumps back at each start',
           command.positive, nargs='?', const=40.0)
    option(parser, '--wait-for-subscribers TOPIC', 'begin when each of these topics (all if none '
           'is named) has a subscriber', _absolute, nargs='*')
    option(parser, '--wait-timeout S', 'give up waiting for subscribers after S seconds (default: '
           '30)', command.not_negative, 30.0)
    option(parser, '--wait-for-all-acked S', 'at the end, wait up to S seconds until reliable '
           'subscribers have acknowledged all messages, which takes about 3 s (default: 10)',
           command.not_negative, 10.0)
    return parser


def replay(args: list[str], stop: command.Interruption) -> int:
    """Publish a recording until its end or until stopped; return the exit code.

    CliplocError: a recording or an option cannot be used, or ROS is missing.

    Parameters
    ----------
    args : list of str
        The command line, including the arguments for ROS.
    stop : Interruption
        Ends the replay.
    """
    plain_args, ros_args = command.split_ros_args(args)
    options = make_parser().parse_args(plain_args)
    with command.needs_ros('replay'):
        from rclpy.exceptions import InvalidTopicNameException
        from rclpy.node import Node
    with command.running_ros(ros_args), BagReader(options.bag) as reader:
        from cliploc_ros.offline.replay import DRIVE_NS, Player, PlayOptions

        # Nothing spins this node, so it could not serve its parameters.
        node = Node(NODE_NAME, start_parameter_services=False)
        try:
            player = Player(node, reader, PlayOptions(
                rate=options.rate, start_offset_s=options.start_offset, topics=options.topics,
                exclude=options.exclude, remap=dict(options.remap), clock_hz=options.clock,
                loop=options.loop, stand_s=options.stand), stop)
        except InvalidTopicNameException as error:
            raise OptionsError(f'--remap: {error}') from error
        if options.wait_for_subscribers is not None:
            player.wait_for_subscribers(options.wait_for_subscribers, options.wait_timeout)
        for topic in player.without_type:
            print(f'not replayed: {topic.name}: {topic.msgtype} is not installed; apt install '
                  f'ros-jazzy-{topic.msgtype.partition("/")[0].replace("_", "-")}, or source ROS')
        for topic in player.topics:
            if topic.msgtype == ODOMETRY and not options.stand:
                print(f'note: the robot of {topic.name} drives, so its poses are withheld until '
                      'it stops: --stand lets it stop')
        length_s = (player.end_ns - player.start_ns) / NS_PER_S
        print(f'replaying {options.bag}: {len(player.topics)} topics, {length_s:.1f} s '
              f'at rate {options.rate:g}', flush=True)
        begin = time.monotonic()
        total_s = length_s * (1.0 + options.stand * NS_PER_S / DRIVE_NS)
        with tqdm(total=total_s, unit='s', bar_format='{l_bar}{bar}| {n:.1f}/{total:.1f} s',
                  disable=None) as bar:  # draws on a terminal only
            counts = player.play(lambda message: bar.update(
                (message.stamp_ns - player.start_ns) / NS_PER_S - bar.n))
        print(f'{"stopped: " if stop.is_set() else ""}published {counts.total()} messages on '
              f'{len(counts)} topics in {time.monotonic() - begin:.1f} s', flush=True)
        if lacking := player.wait_for_acknowledgement(options.wait_for_all_acked):
            print(f'warning: a subscriber of {", ".join(lacking)} did not acknowledge all '
                  f'messages within {options.wait_for_all_acked:g} s', file=sys.stderr)
        return 0


def _remap_rule(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form OLD:=NEW')
    return _absolute(old), new


def _absolute(name: str) -> str:
    return name if name.startswith('/') else f'/{name}'


if __name__ == '__main__':
    sys.exit(main())
