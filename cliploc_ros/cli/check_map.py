# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``check_map``: how good a map is, and what improves it."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cliploc_ros.command import interrupt_on_sigterm, run_command, split_ros_args
from cliploc_ros.errors import DatasetError, OptionsError

if TYPE_CHECKING:
    from cliploc_ros.mapping.checking import CheckedMap

EPILOG = """\
exit code: 0: good; 1: below a threshold, or the input cannot be read

examples:
  check_map office.yaml
  check_map office.yaml --observations office.npz --html office.html
  check_map office.yaml --observations office.npz --cross-validate 4 --min-explained 0.8
"""


def main(args: Sequence[str] | None = None) -> int:
    """Check a map; return the exit code."""
    plain_args, _ = split_ros_args(sys.argv[1:] if args is None else args)
    options = make_parser().parse_args(plain_args)
    interrupt_on_sigterm()
    return run_command(lambda: check(options))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='check_map', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Tell how good a map is and what to do about it: of the map alone, or '
        'against a recording with poses. Needs no sourced ROS.')
    parser.add_argument('map', type=Path, metavar='YAML')
    parser.add_argument('--observations', type=Path, metavar='NPZ',
                        help='boxes and poses of a recording in the coordinate frame of the map')
    parser.add_argument('--cross-validate', type=int, default=0, metavar='PARTS',
                        help='also build maps without each part of the recording, and test them '
                        'on it (0: no)')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the result')
    parser.add_argument('--html', type=Path, metavar='FILE', help='write a page with a top view')
    limits = parser.add_argument_group('below these the exit code is 1')
    limits.add_argument('--max-problems', type=float, default=0.25, metavar='SHARE',
                        help='share of landmarks with problems (%(default)s)')
    limits.add_argument('--min-explained', type=float, default=0.6, metavar='SHARE',
                        help='share of explained boxes (%(default)s)')
    limits.add_argument('--min-localizable', type=float, default=0.6, metavar='SHARE',
                        help='share of frames with at least three landmarks (%(default)s)')
    return parser


def check(options: argparse.Namespace) -> int:
    """Check as the command line asks; return the exit code."""
    # Late, so that --help is fast.
    from dataclasses import replace

    from cliploc_ros.core.landmark_map import LandmarkMap
    from cliploc_ros.datasets.observations import load_observations
    from cliploc_ros.mapping.check_page import check_page
    from cliploc_ros.mapping.checking import check_map, cross_validate
    from cliploc_ros.mapping.options import MappingOptions

    if options.observations is None and options.cross_validate:
        raise OptionsError('--cross-validate needs --observations')
    landmark_map = LandmarkMap.from_file(options.map)
    detections = None
    if options.observations is not None:
        detections = load_observations(options.observations)
    checked = check_map(landmark_map, detections)
    if detections is not None and options.cross_validate:
        explained, iou = cross_validate(detections, MappingOptions(), options.cross_validate)
        checked = replace(checked, held_out_explained=explained, held_out_iou=iou)
    if options.json is not None:
        _write(options.json, json.dumps(checked.as_dict(), indent=1))
    if options.html is not None:
        way = None if detections is None else detections.map_from_camera[:, :3, 3]
        _write(options.html, check_page(landmark_map, checked, way))
    print('\n'.join(checked.lines()))
    shortfalls = _shortfalls(checked, options)
    for shortfall in shortfalls:
        print(f'below threshold: {shortfall}')
    return 1 if shortfalls else 0


def _shortfalls(checked: 'CheckedMap', options: argparse.Namespace) -> list[str]:
    """Return the thresholds that a map misses."""
    found = []
    problems = sum(bool(one.problems) for one in checked.landmarks) / len(checked.landmarks)
    if problems > options.max_problems:
        found.append(f'{problems:.0%} of the landmarks have problems, at most '
                     f'{options.max_problems:.0%} may')
    for name, value, least in (
            ('explained boxes', checked.explained, options.min_explained),
            ('frames with at least three landmarks', checked.localizable,
             options.min_localizable)):
        if value is not None and value < least:
            found.append(f'{name}: {value:.0%}, expected {least:.0%} or more')
    return found


def _write(path: Path, text: str) -> None:
    from cliploc_ros.replace_file import replace_file

    try:
        with replace_file(path) as partial:
            partial.write_text(text, encoding='utf-8')
    except OSError as error:
        raise DatasetError(f'{path}: cannot be written: {error.strerror}') from error


if __name__ == '__main__':
    sys.exit(main())
