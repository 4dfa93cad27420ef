# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``check_map``: judge a map, and advise what to improve."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import get_type_hints

from cliploc_ros import command
from cliploc_ros.cli.options import add_topic_options, add_use_option, read_layer
from cliploc_ros.command import option
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.mapping.options import CheckOptions, Thresholds

_ADVICE_SHOWN = 8
EPILOG = """\
examples:
  check_map office.yaml --observations office.npz --out office_check
  check_map office.yaml --observations office.npz --gravity --out office_check
  check_map hand_written.yaml --out check --min-localized 0.2

exit code: 0 the verdict is "passed"; 1 it is another one, such as "keyframes only" or "failed",
or the input is invalid
"""


def main(args: Sequence[str] | None = None) -> int:
    """Check a map; return the exit code."""
    return command.run_main(make_parser(), check, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command.program('check_map', EPILOG, 'Check a map: its landmarks, where a robot '
                             'would be accepted, refused or misled in it, places that look alike, '
                             'and systematic errors. Writes check.html and check.json. Without '
                             'observations the report is shorter. Needs no sourced ROS.')
    option(parser, 'map MAP', 'a map file')
    option(parser, '--observations NPZ', 'boxes and poses of a recording of the place (default: '
           'those that the map was built from, as named by NAME.recording.json next to the map)')
    option(parser, '--images BAG|DIR', 'the images of this recording (default: those named by '
           'NAME.recording.json)')
    option(parser, '--out DIR', 'folder of check.html and check.json (NAME_check next to the map)')
    option(parser, '--every N', 'use only every N-th frame of the observations (%(default)s)',
           command.positive_int, 1)
    option(parser, '--seed', '(%(default)s)', command.within(*command.SEEDS), 0)
    add_use_option(parser, 'use the keyframes next to the map')
    group = parser.add_argument_group('expected relocalization')
    option(group, '--frames N', 'greatest number of recorded frames to relocalize (%(default)s)',
           command.within(1, 10**6), CheckOptions.frames)
    option(group, '--folds N', 'folds of the cross-validation, 2 or more (%(default)s)',
           command.within(2, 100), CheckOptions.folds)
    option(group, '--grid METRES', 'spacing of the camera positions, larger in large maps '
           '(%(default)s)', command.within(0.01, 1e4), CheckOptions.spacing_m)
    option(group, '--positions N', 'greatest number of camera positions (%(default)s)',
           command.within(1, 10**5), CheckOptions.max_positions)
    option(group, '--headings N', 'directions at each position (%(default)s)',
           command.within(1, 360), CheckOptions.headings)
    option(group, '--camera-height METRES', 'height of the grid (as recorded, otherwise .3 m '
           'above the median landmark)', command.finite)
    option(group, '--gravity', 'the robot knows the vertical')
    option(group, '--min-confidence', 'min_confidence of the relocalizer (%(default)s)',
           command.within(0.0, 1.0), RelocalizerOptions().min_confidence)
    group = parser.add_argument_group('thresholds: shares that determine the verdict')
    for name, hint in get_type_hints(Thresholds, include_extras=True).items():
        option(group, f'--{name.replace("_", "-")} N', f'{hint.__metadata__[0]} (%(default)s)',
               command.within(0.0, 1.0), getattr(Thresholds, name))
    add_topic_options(parser.add_argument_group('images of a bag'))
    return parser


def check(options: argparse.Namespace, most: int = _ADVICE_SHOWN) -> int:
    """Check the map that the command line names; return the exit code.

    The output has the verdict, at most this number of pieces of advice, and the page.
    """
    # Imported late, so that --help is fast.
    from cliploc_ros.cli.sources import recorded
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.files.storage import make_folder
    from cliploc_ros.offline.datasets.map_recording import load_recording
    from cliploc_ros.offline.evaluation.check_page import CHECK, write_check
    from cliploc_ros.offline.mapping.check.checking import check_map

    landmark_map = LandmarkMap.from_file(options.map)
    recording = load_recording(options.map) if options.observations is None else None
    if recording is None and options.observations is None:
        if options.images is not None:
            raise OptionsError('--images needs --observations: no recording of this map is known')
        print('no recording of this map is known: the map is checked by simulation only; give '
              '--observations', flush=True)
    detections, images = recorded(options, recording)
    if detections is not None and options.every > 1:
        detections = detections.select_frames(range(0, len(detections), options.every))
    check_options = CheckOptions(
        relocalizer=RelocalizerOptions(min_confidence=options.min_confidence),
        folds=options.folds, frames=options.frames, spacing_m=options.grid,
        max_positions=options.positions, headings=options.headings,
        camera_height_m=options.camera_height, use_vertical=options.gravity,
        of_folder=images is not None and images.of_folder,
        is_size_given=recording is not None and recording.scale != 1.0,
        random_seed=options.seed)
    thresholds = Thresholds(**{field.name: getattr(options, field.name)
                               for field in fields(Thresholds)})
    image_of = None
    if detections is not None and images is not None:
        image_of = partial(images.of, detections)
    layer = read_layer([options.map], landmark_map, options.keyframes)
    out = options.out or options.map.with_name(f'{options.map.stem}_check')
    make_folder(out)
    with command.StageBar() as bar:
        report = check_map(landmark_map, detections, check_options, thresholds, bar.show, layer,
                           image_of)
        write_check(out, options.map.name, landmark_map, report, detections, image_of)
    print('\n'.join([f'verdict: {report.summary[0]}', *report.localized, *(
        f'{number}. {command.printable(line)}'
        for number, line in enumerate(report.advice[:most], start=1))]))
    print(f'wrote {out / CHECK}: open it for pictures, all advice and the faults of landmarks')
    return 0 if report.passed else 1


if __name__ == '__main__':
    sys.exit(main())
