# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``build_map``: build a map file from posed detections."""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cliploc_ros import command
from cliploc_ros.cli import check_map
from cliploc_ros.cli.options import add_layer_options, add_source_options, folder_of, layer_options
from cliploc_ros.command import option
from cliploc_ros.errors import CliplocError, MappingError, OptionsError, misspelt_classes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cliploc_ros.offline.datasets.map_recording import MapRecording
    from cliploc_ros.offline.mapping.make_map import MadeMap
    from cliploc_ros.offline.mapping.options import MappingOptions
    from cliploc_ros.offline.mapping.posed_detections import PosedDetections

# Options of the check after a build: with fewer views, it takes seconds instead of a minute.
_QUICK = ('--positions', '25', '--headings', '6', '--frames', '30')
# Number of pieces of advice after a build: the most urgent.
_ADVICE_SHOWN = 2
EPILOG = """\
examples:
  build_map --bag drive --out office.yaml
  build_map --bag drive --cameras front left back --map-frame map --out office.yaml
  build_map --observations office.npz --out office.yaml --pose-noise 0.05 1
  build_map --colmap office --known-distance a.jpg b.jpg 1.5 --level --out office.yaml
  build_map --bag drive --out office.yaml --tags tag36h11:0.16
  build_map --rgbd kitchen --level --out kitchen.yaml --no-keyframe-layer
  build_map --bag monday --bag tuesday --folder phone --out office.yaml
  build_map --bag today --map-frame map --update office.yaml --out office.yaml --report today.json
"""


def main(args: Sequence[str] | None = None) -> int:
    """Build a map; return the exit code."""
    return command.run_main(make_parser(), build, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='build_map', epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Build a map of ellipsoids from detections with poses. An existing map is '
        'replaced only when the new one is complete. Needs no sourced ROS.')
    add_source_options(parser)
    option(parser, '--out YAML', 'the map to write', required=True)
    option(parser, '--update YAML', 'bring this map up to date; --out may be the same file')
    option(parser, '--add YAML', 'build this map again, with further recordings')
    option(parser, '--same-frame', 'the recordings have one coordinate frame: a shift between '
           'them is named, but stays (default: recordings are placed by their keyframes)')
    option(parser, '--report JSON', 'also write what was found and left out, and why')
    option(parser, '--frame-id', 'coordinate frame of the map (%(default)s)', default='map')
    option(parser, '--every N', 'use only every N-th frame (%(default)s)', command.positive_int, 1)
    option(parser, '--seed', '(%(default)s)', command.within(*command.SEEDS), 0)
    option(parser, '--check', 'at the end, check the map as check_map does, with fewer views, '
           'into NAME_check; the exit code is that of the build (%(default)s)', default=True,
           action=argparse.BooleanOptionalAction)
    labels = parser.add_argument_group('labels')
    option(labels, '--vocabulary FILE', 'further phrases by class (YAML)')
    option(parser, '--object-size CLASS METRES', 'the longest extent of the objects of a class, '
           'which gives the scale of the poses')
    option(parser, '--tags FAMILY:METRES', 'also map tags; the number is the side of their black '
           'squares, which the poses give without it', str, nargs='+')
    add_layer_options(parser)
    poses = parser.add_argument_group('poses with errors')
    option(poses, '--joint', 'refine the poses together with the landmarks (default: if '
           '--pose-noise is given, or the boxes show that the poses have errors)',
           action=argparse.BooleanOptionalAction)
    option(poses, '--pose-noise METRES DEGREES', 'standard deviations of the poses on each axis '
           '(0.02 0.5 with --joint)', command.positive)
    option(poses, '--pose-correlation SECONDS', 'time constant of the errors of the poses '
           '(%(default)s)', command.not_negative, 3.0)
    option(poses, '--odometry-noise METRES DEGREES', 'standard deviations of odometry on each '
           'axis after one metre (0.03 1.5)', command.positive)
    option(poses, '--refine-mount', 'correct a mount of the camera that is off by centimetres or '
           'degrees')
    limits = parser.add_argument_group('which landmarks are kept in the map')
    option(limits, '--min-viewpoints N', 'least number of viewpoints, 10 cm or 5 degrees apart '
           '(%(default)s)', command.positive_int, 3)
    option(limits, '--moving CLASSES', "classes that move and never become landmarks, like "
           "'person, cat'; '' for none (persons, animals, balls and vehicles of COCO)")
    option(limits, '--min-baseline DEG', 'least angle between two directions to a landmark '
           '(%(default)s)', command.within(0.0, 180.0), 20.0)
    return parser


def build(options: argparse.Namespace) -> int:
    """Build or update the map that the command line names; return the exit code."""
    # Imported late, so that --help is fast.
    from cliploc_ros.cli import sources
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.offline.mapping import make_map
    from cliploc_ros.offline.mapping.tags import parse_sizes

    begin = time.monotonic()
    recordings = sources.each_recording(options)
    update, name = options.update, ', '.join(sources.source_of(own).name for own in recordings)
    sizes = parse_sizes(options.tags or ())
    command.check_output(options.out)
    layer, note = layer_options(recordings[0])
    is_several = len(recordings) > 1 or options.add is not None
    _refuse_conflicts(options, is_several)
    if options.add is not None:
        options.frame_id = LandmarkMap.from_file(options.add).frame_id
    mapping = _mapping_options(options, f'build_map {name}')
    detections, recording, frames, joined = sources.read_recordings(
        options, recordings, partial(_placed, mapping=mapping), layer)
    together = detections if is_several else None
    _tell_misspelt(mapping.moving_classes, detections.class_names)
    if options.every > 1:
        detections = detections.select_frames(range(0, len(detections), options.every))
    labeller = make_map.find_labeller(
        detections, partial(sources.clip_options, options) if options.clip else None,
        options.vocabulary)
    try:
        if update is not None:
            made = make_map.update_map(update, detections, labeller, mapping, frames, layer)
            note = made.note or note
            if options.keyframe_layer is False:
                made = replace(made, layer=None, keyframes=None)
        else:
            with command.StageBar() as bar:
                made = make_map.make_map(detections, labeller, mapping, frames, joined or layer,
                                         bar.show)
            note = note or made.note
            if options.tags is not None and frames is not None:
                mapped = make_map.map_tags_of(frames, sizes)
                made = replace(made, landmark_map=replace(made.landmark_map, tags=mapped.tags))
                print(mapped.line(), flush=True)
            elif options.add is not None:
                made = replace(made, landmark_map=replace(
                    made.landmark_map, tags=LandmarkMap.from_file(options.add).tags))
            if options.keyframe_layer and note:
                raise MappingError(note)
    except CliplocError as error:
        left_out = getattr(error, 'left_out', ())
        _write_report(options.report, {'failure': str(error),
                                       'left_out': [asdict(landmark) for landmark in left_out]})
        raise
    _write_report(options.report, asdict(made.report) | ({} if made.keyframes is None else {
        'keyframes': [fate._asdict() for fate in made.keyframes.fates]}))
    path, is_poor = _write(options, made, name, (recording, together), [labeller.note, note],
                           begin)
    try:
        if options.check:
            check_map.check(check_map.make_parser().parse_args([str(path), *_QUICK]),
                            _ADVICE_SHOWN)
    except CliplocError as error:  # the map is kept
        print(f'note: not checked: {error}')
    print(f'refused: the map explains too few of the boxes of its classes: {options.out} is not '
          f'written; look at {path.name}; check the camera first, then stamps, then poses, then '
          'the objects' if is_poor else f'to correct it: studio {path}')
    return int(is_poor)


def _write(options: argparse.Namespace, made: 'MadeMap', name: str,
           recorded: 'tuple[MapRecording, PosedDetections | None]', notes: Sequence[str],
           begin: float) -> tuple[Path, bool]:
    """Write a map, and print its report, and how long the run took since its begin.

    Return its path, which is another one if the map is poor, and whether it is.
    """
    from cliploc_ros.core.geometry.transforms import quaternion_from_transform
    from cliploc_ros.offline.datasets.poses import mount_from_numbers
    from cliploc_ros.offline.mapping.building import LEAST_EXPLAINED, MappingReport
    from cliploc_ros.offline.mapping.make_map import write_made_map

    lines = made.report.lines()
    if made.keyframes is not None:
        lines.insert(1, made.keyframes.line())
    head = [f'built by build_map from {name}', *lines[:2]] if options.update is None else [
        f'{options.update.name}, updated by build_map from {name}', lines[0]]
    if made.mount is not None:
        mount = made.mount.given_from_corrected
        if options.mount is not None:
            mount = mount_from_numbers(options.mount) @ mount
        numbers = [*mount[:3, 3], *quaternion_from_transform(mount)]
        lines.append('corrected mount: --mount ' + ' '.join(f'{number:.5f}' for number in numbers))
    is_poor = isinstance(made.report, MappingReport) and made.report.landmarks > 0 and (
        made.report.explained_of_classes < LEAST_EXPLAINED)
    path = options.out.with_stem(f'{options.out.stem}.refused') if is_poor else options.out
    written = write_made_map(path, made, head, recorded[0], options.update, recorded[1])
    print('\n'.join([*lines, *(f'note: {text}' for text in notes if text),
                     '; '.join([f'wrote {path} in {time.monotonic() - begin:.0f} s', *written])]),
          flush=True)
    return path, is_poor


def _refuse_conflicts(options: argparse.Namespace, is_several: bool) -> None:
    """Refuse conflicting options, before any work is done."""
    is_update, is_new = options.update is not None, options.add is options.update is None
    for is_wrong, text in (
            (is_update and is_several, '--update is for one recording: run it for each in turn'),
            (options.tags and (is_several or is_update or options.observations is not None),
             '--tags needs the images of one recording: build the map of it first, then --add'),
            (is_several and options.keyframe_images, '--keyframe-images is for one recording'),
            (options.level and not is_new, '--level is for new maps, not for --update or --add'),
            (options.object_size and (options.scale or options.known_distance or not is_new),
             '--object-size is not for --scale, --known-distance, --update or --add'),
            (options.refine_mount and (is_update or is_several),
             '--refine-mount is for new maps of one recording, not for --update'),
            (options.refine_mount and len(options.cameras) > 1, '--refine-mount is for one '
             'camera: correct each with a map of --cameras NAME alone'),
            (options.joint is False and options.pose_noise,
             '--pose-noise is for --joint, not for --no-joint')):
        if is_wrong:
            raise OptionsError(text)


def _mapping_options(options: argparse.Namespace, source: str) -> 'MappingOptions':
    """Return the options of mapping; source is the origin that the map names."""
    from cliploc_ros.offline.mapping import options as mapping

    sigma_m, sigma_deg = options.pose_noise or (0.02, 0.5)
    errors = mapping.PoseErrors(sigma_m, sigma_deg, options.pose_correlation)
    return mapping.MappingOptions(
        pose_errors=errors if options.joint or options.pose_noise else None,
        estimate_pose_errors=options.joint is None,
        odometry_errors=mapping.OdometryErrors(*options.odometry_noise or ()),
        refine_mount=options.refine_mount, min_viewpoints=options.min_viewpoints,
        min_baseline_deg=options.min_baseline, frame_id=options.frame_id, source=source,
        random_seed=options.seed,
        moving_classes=mapping.MOVING_CLASSES if options.moving is None else tuple(
            filter(None, map(str.strip, options.moving.split(',')))))


def _tell_misspelt(moving: Sequence[str], seen: Sequence[str]) -> None:
    """Report names of --moving that look misspelt: their objects would become landmarks."""
    from cliploc_ros.offline.vocabulary.vocabulary import shipped_classes

    known = {name.lower() for name in (*seen, *shipped_classes())}
    for name, hint in misspelt_classes(map(str.lower, moving), known, all_known=True).items():
        print(f"note: --moving: no box is of class '{name}'{hint}", flush=True)


def _write_report(path: Path | None, report: dict[str, Any]) -> None:
    """Write a report, if a path is given."""
    from cliploc_ros.files.storage import write_text

    if path is not None:
        write_text(path, json.dumps(report, indent=1))
        print(f'report: {path}', flush=True)


def _placed(detections: 'PosedDetections', options: argparse.Namespace, of_tf: bool,
            mapping: 'MappingOptions') -> 'tuple[PosedDetections, float, NDArray[np.float64]]':
    """Level and scale detections; return them with the scale and the rotation (3, 3)."""
    import numpy as np

    from cliploc_ros.cli.sources import metres_of
    from cliploc_ros.offline.mapping.make_map import scale_of_objects
    from cliploc_ros.offline.mapping.tilt import find_levelling

    scale, rotation = 1.0, np.eye(3)
    if folder_of(options) is None:  # folders are levelled when they are read
        rotation, note = find_levelling(detections.map_from_camera, options.level, of_tf)
        print(note + '\n' if note else '', end='', flush=True)
        detections = detections.moved(scale, rotation)
    if options.object_size is not None:
        class_name = options.object_size[0]
        metres = metres_of(options.object_size[1], '--object-size')
        scale, objects = scale_of_objects(detections, mapping, class_name, metres)
        print(f'a unit is {scale:.5g} m, by {objects} objects of class {class_name}', flush=True)
        detections = detections.moved(scale, np.eye(3))
    return detections, scale, rotation


if __name__ == '__main__':
    sys.exit(main())
