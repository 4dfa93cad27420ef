# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``check_map``: judge a map, and advise what to improve."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import TYPE_CHECKING, get_type_hints

from cliploc_ros import command
from cliploc_ros.cli.options import add_topic_options, add_use_option, read_layer
from cliploc_ros.command import option
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.offline.mapping.options import CheckOptions, Thresholds

if TYPE_CHECKING:
    from cliploc_ros.core.keyframes.layer import KeyframeLayer
    from cliploc_ros.offline.datasets.images import Images
    from cliploc_ros.offline.datasets.map_recording import MapRecording
    from cliploc_ros.offline.mapping.posed_detections import PosedDetections

_ADVICE_SHOWN = 8
EPILOG = """\
examples:
  check_map office.yaml --observations office.npz --out office_check
  check_map office.yaml --observations office.npz --gravity --out office_check
  check_map hand_written.yaml --out check --max-look-alikes 2

exit code: 0 the map reaches all thresholds, 1 it misses one or the input is invalid
"""


def main(args: Sequence[str] | None = None) -> int:
    """Check a map; return the exit code."""
    return command.run_main(make_parser(), check, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='check_map', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Check a map: its landmarks, where a robot would be accepted, refused or '
        'misled in it, places that look alike, and systematic errors. Writes check.html and '
        'check.json. Without observations the report is shorter. Needs no sourced ROS.')
    option(parser, 'map MAP', 'a map file')
    option(parser, '--observations NPZ', 'boxes and poses of a recording of the place (default: '
           'those that the map was built from, as named by NAME.recording.json next to the map)')
    option(parser, '--images BAG|DIR', 'the images of this recording (default: those named by '
           'NAME.recording.json)')
    option(parser, '--out DIR', 'folder of check.html and check.json (NAME_check next to the map)')
    option(parser, '--every N', 'use only every N-th frame of the observations (%(default)s)',
           command.positive_int, 1)
    option(parser, '--seed', '(%(default)s)', command.within(*command.SEEDS), 0)
    add_use_option(parser, 'report what the keyframes next to the map reach')
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
    group = parser.add_argument_group('thresholds; if the map misses one, the exit code is 1')
    for name, hint in get_type_hints(Thresholds, include_extras=True).items():
        option(group, f'--{name.replace("_", "-")} N', f'{hint.__metadata__[0]} (%(default)s)',
               command.within(0.0, 1.0) if hint.__origin__ is float else command.within(0, 10**9),
               getattr(Thresholds, name))
    add_topic_options(parser.add_argument_group('images of a bag'))
    return parser


def check(options: argparse.Namespace) -> int:
    """Check the map that the command line names; return the exit code."""
    # Imported late, so that --help is fast.
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.files.storage import make_folder
    from cliploc_ros.offline.datasets.map_recording import load_recording
    from cliploc_ros.offline.evaluation.check_page import CHECK, figures_of, write_check
    from cliploc_ros.offline.mapping.check.checking import check_map
    from cliploc_ros.offline.mapping.tilt import tilt_note

    begin = time.monotonic()
    landmark_map = LandmarkMap.from_file(options.map)
    recording = load_recording(options.map) if options.observations is None else None
    check_options = CheckOptions(
        relocalizer=RelocalizerOptions(min_confidence=options.min_confidence),
        folds=options.folds, frames=options.frames, spacing_m=options.grid,
        max_positions=options.positions, headings=options.headings,
        camera_height_m=options.camera_height, use_vertical=options.gravity,
        is_size_given=recording is not None and recording.scale != 1.0,
        random_seed=options.seed)
    thresholds = Thresholds(**{field.name: getattr(options, field.name)
                               for field in fields(Thresholds)})
    detections, images = _read_recording(options, recording) or (None, None)
    image_of = None
    if detections is not None and images is not None:
        image_of = partial(images.of, detections)
    if detections is not None and (note := tilt_note(detections.map_from_camera)):
        print(f'note: {note}', flush=True)
    layer = read_layer(options.map, landmark_map, options.keyframes)
    if not len(landmark_map):
        return _check_keyframes(layer, detections)
    out = options.out or options.map.with_name(f'{options.map.stem}_check')
    make_folder(out)
    with command.StageBar() as bar:
        report = check_map(landmark_map, detections, check_options, thresholds, bar.show, layer,
                           None if options.observations else image_of)
        write_check(out, options.map.name, landmark_map, report, detections, image_of)
    print('\n'.join([f'verdict: {report.verdict}', *report.localized,
                     *(f'{name}: {value}' for name, value in figures_of(report))]))
    print('what to do:')
    print('\n'.join(f'  {command.printable(line)}' for line in report.advice[:_ADVICE_SHOWN]))
    for failure in report.failures:
        print(f'fails: {failure}')
    print(f'wrote {out / CHECK} in {time.monotonic() - begin:.1f} s: '
          f'{report.verdict}')
    return 0 if report.passed else 1


def _check_keyframes(layer: 'KeyframeLayer | None', detections: 'PosedDetections | None') -> int:
    """Report on a map without landmarks; return the exit code of a map that did not pass."""
    from cliploc_ros.offline.mapping.check.report import in_reach

    if layer is None:
        print('fails: the map has neither landmarks nor keyframes')
        return 1
    print(f'keyframes only: no landmark; {len(layer)} keyframes with {int(layer.offsets[-1])} '
          'points localize a robot near their views')
    if detections is not None:
        reached = in_reach(layer, detections.map_from_camera)
        print(f'recorded frames within reach of a keyframe: {reached.mean():.0%} of '
              f'{len(reached)}')
    print('what to do:\n  record objects from several sides: they also localize a robot away from '
          'the recorded views, and after the place has changed')
    return 1


def _read_recording(options: argparse.Namespace, recording: 'MapRecording | None'
                    ) -> 'tuple[PosedDetections, Images | None] | None':
    """Return the recording of the command line or of the map, and its images if they are found."""
    from cliploc_ros.cli.sources import images_at
    from cliploc_ros.offline.datasets.images import images_of_recording
    from cliploc_ros.offline.datasets.observations import load_observations

    if options.observations is not None:
        detections = load_observations(options.observations)
    elif recording is not None:
        print(f'observations: {os.path.relpath(recording.observations)}', flush=True)
        detections = recording.load()
    elif options.images is not None:
        raise OptionsError('--images needs --observations: no recording of this map is known')
    else:
        print('no recording of this map is known: the map is checked by simulation only; give '
              '--observations', flush=True)
        return None
    images = None
    try:
        if options.images is not None:
            images = images_at(options, options.images, detections.camera_names
                               if options.cameras == [''] else options.cameras)
        elif recording is not None:
            images = images_of_recording(recording, detections.camera_names)
    except CliplocError as error:
        if options.images is not None:
            raise
        print(f'without images: {error}', flush=True)
    if options.every > 1:
        detections = detections.select_frames(range(0, len(detections), options.every))
    return detections, images


if __name__ == '__main__':
    sys.exit(main())
