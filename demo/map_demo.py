# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the demo with a map that it builds from the mapping walk and compares with the room."""

import json
from dataclasses import replace
from pathlib import Path

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.models.clip_encoder import embed_map
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.evaluation.methods import Method
from cliploc_ros.offline.evaluation.recorded_queries import make_queries_of
from cliploc_ros.offline.evaluation.run import run_methods
from cliploc_ros.offline.evaluation.summary import Summary, summarize
from cliploc_ros.offline.evaluation.trials import make_queries
from cliploc_ros.offline.recording.networks import load_networks
from cliploc_ros.offline.recording.recorder import record_every_frame
from demo.map_review import (
    PICTURE,
    console_lines,
    count_sightings,
    draw_map_review,
    review_map,
    section,
    success_lines,
)
from demo.processes import DemoError, build_map
from demo.run import DemoOptions, WakeUpMap, prepare, run_demo
from demo.truth import read_frames, read_objects


def run_map_demo(options: DemoOptions) -> None:
    """Build a map from the mapping walk, compare it with the room, and wake up in it.

    CliplocError: assets are missing or invalid, the map cannot be built, or the nodes do not run.
    """
    if options.method.startswith('class'):
        raise DemoError(f'--map compares labels, but --method {options.method} uses none: choose '
                        'a hybrid_ or clip_ method')
    prepare(options)
    walk = options.assets / 'mapping'
    if not walk.is_dir():
        raise DemoError(f'{walk} is missing: choose another folder with --assets')
    objects = read_objects(walk)
    files = {name: options.out / f'built_map.{name}' for name in ('yaml', 'json', 'npz')}
    build_map('--tum', walk, '--out', files['yaml'], '--report', files['json'], '--record-to',
              files['npz'], '--no-check', **options.detector, **options.encoder)
    detections = load_observations(files['npz'])
    review = review_map(
        LandmarkMap.from_file(files['yaml']), objects,
        count_sightings(tuple(read_frames(walk)), detections),
        json.loads(files['json'].read_text())['left_out'])
    print('\n'.join(console_lines(review)), flush=True)
    successes = _judge(options, files['yaml'])
    print('\n' + '\n'.join(success_lines(successes)) + '\n', flush=True)
    draw_map_review(review, detections.map_from_camera, options.out / PICTURE)
    landmark_of = review.landmark_of
    run_demo(replace(options, wake_up_map=WakeUpMap(
        files['yaml'], lambda object_id: landmark_of.get(object_id, ''),
        section(review, successes, len(detections)))))


def _judge(options: DemoOptions, built_map_file: Path) -> dict[str, Summary]:
    """Localize every second image of the wake-ups in the built and the true map."""
    clip = ClipOptions(pretrained=str(options.encoder['clip_pretrained']))
    frames = read_folder(options.assets / 'sequence', FolderOptions(layout='tum'))
    frames = frames.select(range(0, frames.count, 2))
    print(f'localizing {frames.count} images of the wake-ups in both maps', flush=True)
    look = load_networks(DetectorOptions(model=str(options.detector['model'])), clip)
    recorded = record_every_frame(frames, look)
    method = Method(options.method, options.values.options())
    summaries = {}
    for name, file in (('built map', built_map_file), ('true map', options.assets / 'map.yaml')):
        landmark_map = LandmarkMap.from_file(file)
        queries = make_queries_of(recorded, landmark_map, embed_map(
            clip, landmark_map, [str(file)], options.values.landmark_embeddings))
        summaries[name], = summarize(run_methods(
            landmark_map, [method], make_queries(queries, landmark_map), trials=1))
    return summaries
