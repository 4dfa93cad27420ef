# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``evaluate``: the paper's table and figures for your own data."""

import argparse
import logging
import math
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cliploc_ros import command
from cliploc_ros.cli import options as shared
from cliploc_ros.command import limit, not_negative, option, positive_int, within
from cliploc_ros.core.options import COMPARED, CROPS, RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.methods import ALL, AUTO, PAPER_METHODS

if TYPE_CHECKING:
    from cliploc_ros.core.keyframes.layer import KeyframeLayer
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.offline.evaluation.methods import Method
    from cliploc_ros.offline.posed_query import PosedQuery

_CORES = len(os.sched_getaffinity(0))  # that this process may use
EPILOG = f"""\
methods: {', '.join(PAPER_METHODS)}: the paper's ten;
  '{AUTO}': the relocalizer's defaults; '{ALL}': these eleven;
  FILE.yaml: named sets of options, such as
    wide: {{base: hybrid_b-prosac, k: 5, iterations: 2000}}

examples:
  evaluate --queries office.npz --map office.yaml --methods all --trials 5
  evaluate --folder second_walk --map office.yaml --methods auto --every 5
  evaluate --bag office --map office.yaml --image /camera/image_raw --save-queries office.npz
  evaluate --queries office.npz --map office.yaml --methods auto --gravity --height-range 0.8 2.2
  evaluate --queries office.npz --map office.yaml --methods auto --fuse --odometry-noise 0.01 0.5
  evaluate --queries office.npz --map office.yaml --methods auto --poses hloc=hloc.txt
  evaluate --bag case_20260101T120000.000_refused.npz --map office.yaml
      answers a request again that ~/record stored; exit code 1: another verdict
"""


def main(args: Sequence[str] | None = None) -> int:
    """Run ``evaluate``; return the exit code."""
    return command.run_main(make_parser(), evaluate, args)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = command.program('evaluate', EPILOG, 'Compare methods on the same input. Writes the '
                             "paper's table as a page, text, LaTeX and CSV, results.json, "
                             'run.json with input and options, figures and trajectories. Runs '
                             'without ROS.')
    sources = parser.add_mutually_exclusive_group(required=True)
    option(sources, '--queries NPZ', 'recorded boxes and similarities; options of networks and '
           'recordings have no effect on it and are refused')
    option(sources, '--bag', 'a rosbag2 recording with ground truth; or a request that was '
           'stored by ~/record (npz), to answer it again', Path)
    shared.add_folders(sources)
    option(parser, '--map YAML', 'several maps are searched as one; the true poses are in the '
           'first', nargs='+', required=True)
    option(parser, '--methods M', f'methods to compare ({ALL}); see below', default=[ALL],
           nargs='+')
    option(parser, '--poses NAME=FILE', 'a further row of the table: poses of another program, of '
           'the camera (z forward) in the map, in TUM format; each query gets the pose that is '
           'nearest in time, within 10 ms', default=[], nargs='+', action='extend')
    option(parser, '--trials', "number of trials (%(default)s, the paper's)", positive_int, 5)
    option(parser, '--seed', 'seed of the first trial (%(default)s)', within(*command.SEEDS), 0)
    option(parser, '--frames', "frames of a query file; 'all': neighbours of queries, too",
           default='main', choices=('main', 'all'))
    option(parser, '--crops', f"crops that '{AUTO}' compares with labels (%(default)s)",
           lambda text: text.replace('-', '_'), RelocalizerOptions.crops, choices=CROPS)
    option(parser, '--out DIR', default=Path('evaluation'))
    option(parser, '--workers N',
           f'number of local processes ({_CORES} for searches, 1 for networks)', positive_int)
    option(parser, '--no-figures', dest='figures', action='store_false')
    shared.add_use_option(parser, f"'{AUTO}' uses the keyframes of the map, as the relocalizer "
                          'does, on the images of --bag or a folder')
    group = parser.add_argument_group("options of the paper's methods")
    option(group, '--iterations', '(%(default)s)', positive_int, 500)
    option(group, '--k', '(%(default)s)', positive_int, 3)
    option(group, '--iou-threshold', '(%(default)s)', within(0.0, 1.0), 0.2)
    option(group, '--sweep N', 'numbers of iterations to compare in a figure (50 100 200 1000; '
           'without numbers: no such figure)', positive_int, [50, 100, 200, 1000], nargs='*')
    group = parser.add_argument_group('simulated sensors in addition to the camera')
    option(group, '--gravity', f"'{AUTO}' knows the vertical, which is simulated from the true "
           "poses; the paper's methods do not use it")
    option(group, '--gravity-noise-deg DEG', 'standard deviation of the error of the vertical (0)',
           within(0.0, 45.0), 0.0)
    option(group, '--height-range LOW HIGH', 'range of the height of the camera in the map [m]',
           limit, (-math.inf, math.inf))
    option(group, '--tilt-deviation DEG',
           f"standard deviation of the camera's tilt, for '{AUTO}' without a "
           "vertical; 0 if the map's z axis is not up (%(default)s)", not_negative, 40.0)
    option(group, '--fuse', 'localize each query with the other frames of its group, linked by '
           'odometry from the true poses')
    option(group, '--odometry-noise METRES DEGREES', 'standard deviations of the error of '
           'odometry from frame to frame, on each axis (0 0)', not_negative, (0.0, 0.0))
    _add_recording_options(parser)
    return parser


def _add_recording_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('options of --bag and folders')
    option(group, '--save-queries NPZ', 'write boxes and similarities to a file for --queries')
    shared.add_network_options(group)
    option(group, '--landmark-embeddings', "compare crops with the map's labels (text), with the "
           'images of its landmarks, or with both (%(default)s)', default='image',
           choices=COMPARED)
    option(group, '--every N', 'use every N-th image of a folder', positive_int, 1)
    option(group, '--sync-tolerance SECONDS', 'greatest distance in time of images of several '
           '--cameras that are localized together, from the first camera (%(default)s)',
           not_negative, 0.05)
    shared.add_reading_options(parser)


def evaluate(options: argparse.Namespace) -> int:
    """Evaluate with the options of the command line; return the exit code."""
    # late imports keep --help fast
    from cliploc_ros.core.map.joined_map import join_maps
    from cliploc_ros.core.map.landmark_map import LandmarkMap
    from cliploc_ros.files.storage import make_folder
    from cliploc_ros.offline.evaluation import trials
    from cliploc_ros.offline.evaluation.methods import parse_methods
    from cliploc_ros.offline.evaluation.run import compare_methods

    logging.basicConfig(level=logging.WARNING, format='%(message)s')
    parser = make_parser()
    given = shared.given_options(options, {name: parser.get_default(name) for name in vars(options)
                                           if name != 'ros_args'})
    _check_options(options)
    of_case = options.bag is not None and options.bag.suffix == '.npz'
    if options.queries is None and not of_case:
        from cliploc_ros.cli.sources import find_topics

        find_topics(options, options.bag)
    landmark_map = join_maps([LandmarkMap.from_file(file) for file in options.map],
                             [str(file) for file in options.map])
    if of_case:
        return _replay_case(options, landmark_map)
    paper = RelocalizerOptions(
        matching=RelocalizerOptions.matching if options.clip else 'class',
        iterations=options.iterations, k=options.k, iou_threshold=options.iou_threshold,
        random_seed=options.seed,
        height_range_m=tuple(options.height_range),
        tilt_deviation_deg=options.tilt_deviation,
        vertical_deviation_deg=max(1.0, options.gravity_noise_deg), crops=options.crops)
    methods = parse_methods(options.methods, paper, len(landmark_map), options.clip)
    others = trials.read_given_poses(options.poses, methods)
    comparing = [f"method '{method.name}'" for method in methods
                 if method.options.needs_similarities]
    comparing += ['--save-queries'] if options.save_queries else []
    if len(landmark_map) and comparing and not options.clip:
        raise OptionsError(f'--no-clip: {comparing[0]} compares crops with labels: omit one of '
                           f'both, or give --methods {ALL} (then class_bf, class_ransac and '
                           f"{AUTO}), or 'matching: class' in a file of methods")
    options.clip = options.clip and len(landmark_map) > 0 and bool(comparing)
    layer = _read_layer(options, landmark_map, methods)
    if not len(landmark_map) and layer is None:
        raise OptionsError(f'{options.map[0]} has no landmarks, and no keyframes are used')
    make_folder(options.out)
    queries = _read_queries(options, landmark_map, layer)
    draws = _with_sensors(options, queries)
    compare_methods(landmark_map, draws[0], methods, options.out, trials=options.trials,
                    workers=options.workers or _CORES, scheduler=options.scheduler,
                    layer=layer, noisy=draws if len(draws) > 1 else (),
                    sweep=options.sweep if options.figures else None,
                    given=others, about=_describe(options, given, layer is not None),
                    remarks=_notes(options, queries, landmark_map, methods))
    return 0


def _check_options(options: argparse.Namespace) -> None:
    """Refuse options that exclude each other or have no effect; OptionsError names them."""
    if options.queries is not None:
        of_images = argparse.ArgumentParser()
        _add_recording_options(of_images)
        defaults = vars(of_images.parse_args([]))
        del defaults['scheduler']  # searches use it, too
        if idle := shared.given_options(options, defaults):
            raise OptionsError(
                f'{", ".join(idle)}: no effect on --queries, whose boxes and similarities are '
                'recorded; remove them, or give --bag or a folder')
    if options.cameras != [''] and (options.bag is None or options.fuse or options.save_queries):
        raise OptionsError('--cameras is for --bag, without --fuse and --save-queries')
    shared.check_folder_options(options)
    if options.level and shared.folder_of(options) is None:
        raise OptionsError('--level is for folders of images only')
    if options.poses and options.bag is not None and options.bag.suffix == '.npz':
        raise OptionsError('--poses: no effect on a stored request, which is answered again')


def _with_sensors(options: argparse.Namespace, queries: 'Sequence[PosedQuery]'
                  ) -> 'list[tuple[PosedQuery, ...]]':
    """Return the queries with simulated sensors: for each trial if they have noise, else once."""
    from cliploc_ros.offline.evaluation import trials

    noise_m, noise_deg = options.odometry_noise
    is_noisy = (options.gravity and options.gravity_noise_deg) or (
        options.fuse and (noise_m or noise_deg))
    draws = []
    for seed in range(options.seed, options.seed + (options.trials if is_noisy else 1)):
        found = tuple(queries)
        if options.gravity:
            found = trials.with_vertical(found, options.gravity_noise_deg, seed)
        if options.fuse:
            found = trials.with_neighbours(found, [query.group for query in found], noise_m,
                                           noise_deg, seed)
        draws.append(tuple(query for query in found if options.frames == 'all' or query.is_main))
    return draws


def _describe(options: argparse.Namespace, given: Mapping[str, Any], has_layer: bool
              ) -> dict[str, Any]:
    """Return files, networks and options of a run; options with their default are left out."""
    from cliploc_ros.cli.sources import clip_options, detector_options, source_of
    from cliploc_ros.core.keyframes.layer import layer_path
    from cliploc_ros.core.map.landmark_embeddings import embeddings_path
    from cliploc_ros.models.files import digest_file
    from cliploc_ros.models.onnx_clip import names_onnx

    files = [options.queries or source_of(options), *options.map,
             *(word for word in options.methods if word.endswith(('.yaml', '.yml'))),
             *(word.partition('=')[2] for word in options.poses)]
    if has_layer:
        files += map(layer_path, options.map)
    if options.queries is not None:
        detector = 'unknown: query files do not name it'
        similarities = 'unknown: query files do not say whether CLIP or a simulation made them'
    else:
        detector, clip = detector_options(options).model, clip_options(options)
        architecture = '' if names_onnx(clip) else f'{clip.model} '
        similarities = f'CLIP {architecture}{clip.pretrained}' if options.clip else 'by class'
        files += [options.trajectory, options.model, options.clip_pretrained]
        if options.clip and options.landmark_embeddings != 'text':
            files += map(embeddings_path, options.map)
    words = []
    for name, value in given.items():
        values = value if isinstance(value, list) else [value]
        words += [name, *(str(each) for each in values if not isinstance(each, bool))]
    hashes = {str(file): digest_file(Path(file))[:12] for file in files
              if file and Path(file).is_file()}
    return {'map': ' '.join(file.name for file in options.map), 'sha256': hashes,
            'detector': detector, 'similarities': similarities, 'options': shlex.join(words)}


def _notes(options: argparse.Namespace, queries: 'Sequence[PosedQuery]',
           landmark_map: 'LandmarkMap', methods: 'Sequence[Method]') -> list[str]:
    """Return notes on unused keyframes, on a wrong detector, and on maps of these images."""
    from cliploc_ros.cli.sources import source_of
    from cliploc_ros.core.detector_check import DetectorCheck
    from cliploc_ros.offline.datasets.map_recording import load_recording

    check = DetectorCheck(landmark_map, True, frames=None)
    for query in queries:
        check.add(query.observation.detections, query.observation.detections)
    notes = [f'note: the detector: {fault.text}' for fault in check.faults]
    if (options.keyframes is None and any(method.keyframes for method in methods)
            and (problem := _why_no_keyframes(options, methods))):
        notes.append(f'note: {AUTO} is tried without keyframes: {problem}')
    if options.queries is None:
        images = source_of(options).resolve()
        notes += [f'note: {file} was built from these images ({images}): results are optimistic'
                  for file in options.map
                  if (found := load_recording(file)) is not None and images in [
                      part.source.resolve() for part in (found, *found.others) if part.source]]
    return notes


def _read_layer(options: argparse.Namespace, landmark_map: 'LandmarkMap',
                methods: 'Sequence[Method]') -> 'KeyframeLayer | None':
    """Return the keyframes of the map; None: methods, map or queries cannot use them.

    CliplocError: keyframes are requested, but cannot be used.
    """
    problem = _why_no_keyframes(options, methods)
    if not problem:
        return shared.read_layer(options.map, landmark_map, options.keyframes)
    if options.keyframes:
        raise OptionsError(f'--keyframes: {problem}')
    return None


def _why_no_keyframes(options: argparse.Namespace, methods: 'Sequence[Method]') -> str:
    """Return why the methods cannot use keyframes; '' if they can."""
    return (f"no method uses them: add '{AUTO}'" if not any(method.keyframes for method in methods)
            else '--queries has no images: give --bag or a folder' if options.queries else '')


def _replay_case(options: argparse.Namespace, landmark_map: 'LandmarkMap') -> int:
    """Answer a recorded request again; return 0 if the verdict is the same, 1 otherwise."""
    from cliploc_ros.cli.sources import clip_options
    from cliploc_ros.core.answer_line import answer_line, detail_of
    from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
    from cliploc_ros.core.localizer import Localizer, repeat
    from cliploc_ros.core.query import read_case
    from cliploc_ros.core.relocalizer import Relocalizer
    from cliploc_ros.models.clip_encoder import load_encoder_for_map
    from cliploc_ros.models.observer import Observer

    case, observer = read_case(options.bag), None
    if case.options.needs_similarities and len(landmark_map):
        observer = Observer(*load_encoder_for_map(
            clip_options(options), landmark_map, [str(file) for file in options.map],
            options.landmark_embeddings))
    wanted = options.keyframes
    if wanted is None and not case.report.get('parameters', {}).get('keyframes_file', True):
        wanted = False
    layer = shared.read_layer(options.map, landmark_map, wanted)
    again = repeat(case, Localizer(Relocalizer(landmark_map, case.options),
                                   None if layer is None else KeyframeLocalizer(layer)), observer)
    is_same = again.accepted == (case.report.get('found') == 'accepted')
    print(f'{options.bag}: {len(case.queries)} frames, map {case.report.get("map_hash")}\n'
          f'recorded: {case.report.get("message")}\n'
          'again (pose of the camera): ' + answer_line(
              'accepted' if again.accepted else 'refused', detail_of(again, landmark_map.frame_id),
              again.refusal_kind, again.search_ms / 1e3) + '\n'
          f'{"the same verdict" if is_same else "another verdict"}', flush=True)
    return 0 if is_same else 1


def _read_queries(options: argparse.Namespace, landmark_map: 'LandmarkMap',
                  layer: 'KeyframeLayer | None') -> 'tuple[PosedQuery, ...]':
    """Return the queries of a file, or of the images of all cameras; networks run once."""
    from cliploc_ros.offline.datasets.observations import load_queries, save_queries
    from cliploc_ros.offline.evaluation.trials import join_cameras, make_queries

    if options.queries is not None:
        return make_queries(load_queries(options.queries), landmark_map, every_frame=True)
    from cliploc_ros.cli.sources import read_cameras_of_map, recording_options
    from cliploc_ros.offline.evaluation.recorded_queries import recorded_queries, with_images
    from cliploc_ros.offline.recording.recorder import EVERY_FRAME

    asked, images = {}, read_cameras_of_map(options, Path(options.map[0]))
    for camera, frames in images.items():
        if options.bag is None:
            frames = images[camera] = frames.select(range(0, frames.count, options.every))
        print(''.join(f'{note}\n' for note in frames.notes), end='', flush=True)
        recording = recording_options(options, EVERY_FRAME, options.every, camera)
        found = recorded_queries(frames, landmark_map, recording, list(map(str, options.map)),
                                 options.landmark_embeddings)
        if without := frames.count - len(found.frames):
            print(f'skipped without ground truth within 20 ms: {without} of {frames.count} images',
                  flush=True)
        if options.save_queries is not None:
            save_queries(options.save_queries, found)
            print(f'wrote {options.save_queries}', flush=True)
        asked[camera] = make_queries(found, landmark_map, every_frame=True)
    queries = next(iter(asked.values()))
    if len(asked) > 1:
        queries = join_cameras(asked, options.sync_tolerance)
    if layer is not None:
        queries = with_images(queries, next(iter(images.values())))
        notes = {layer.camera_note(query.observation.camera)
                 for query in queries if query.image is not None}
        print(''.join(f'note: {note}\n' for note in sorted(notes) if note), end='', flush=True)
    return queries


if __name__ == '__main__':
    sys.exit(main())
