# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the paper's methods in the demo's world: ``python -m demo.world.compare --out DIR``.

This scores the small networks on the demo's walk, which they were not trained on, records their
output once, and runs the paper's ten methods on the recording.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cliploc_ros.command import run_command
from cliploc_ros.core.geometry.ellipsoid import box_ious
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.files.storage import make_folder
from cliploc_ros.models.clip_encoder import load_encoder_for_map
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from cliploc_ros.models.yolo_weights import import_ultralytics
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.datasets.observations import Queries, save_queries
from cliploc_ros.offline.evaluation.methods import parse_methods
from cliploc_ros.offline.evaluation.recorded_queries import make_queries_of
from cliploc_ros.offline.evaluation.run import compare_methods
from cliploc_ros.offline.evaluation.trials import make_queries
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.offline.recording.networks import run_networks
from cliploc_ros.offline.recording.recorder import record_every_frame
from demo import ASSETS
from demo.truth import SAME_OBJECT_IOU, TrueFrame, read_frames
from demo.world import train_detector


def record(sequence: Path, landmark_map: LandmarkMap, cache_dir: Path) -> Queries:
    """Run the shipped detector and CLIP on the images of a world; return queries for a map."""
    detector = load_detector(DetectorOptions(model=str(ASSETS / 'yolo.pt')))
    clip = ClipOptions(model=str(ASSETS / 'clip.json'), cache_dir=str(cache_dir),
                       pretrained=str(ASSETS / 'clip.safetensors'))
    encoder, labels = load_encoder_for_map(clip, landmark_map, [], 'text')
    frames = read_folder(sequence, FolderOptions(layout='tum'))
    recorded = record_every_frame(frames, partial(
        run_networks, detector.detect, encoder))
    return make_queries_of(recorded, landmark_map, labels)


def score_detector(sequence: Path) -> float:
    """Return the mAP50 of the shipped detector on a world's images."""
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_score_') as name:
        data = train_detector.write_dataset({'train': [sequence], 'val': [sequence]},
                                            Path(name) / 'data')
        model = import_ultralytics().YOLO(ASSETS / 'yolo.pt')
        return float(train_detector.score(model, data, Path(name)).box.map50)


def score_clip(frames: Sequence[PosedQuery], truth: Sequence[TrueFrame],
               landmark_ids: Sequence[str]) -> tuple[float, float, int]:
    """Return CLIP's top-1 and top-3 accuracy, and the number of detected objects.

    An object counts if it is in the map and a detection overlaps its true box by an IoU of more
    than .5.
    """
    ranks = []
    for frame, true_frame in zip(frames, truth, strict=True):
        for box in true_frame.boxes:
            ious = box_ious(box.bbox_xyxy[None], frame.observation.detections.bboxes_xyxy)[0]
            if box.object_id in landmark_ids and ious.max(initial=0.0) > SAME_OBJECT_IOU:
                similarities = np.asarray(frame.observation.similarities)[int(np.argmax(ious))]
                own = similarities[landmark_ids.index(box.object_id)]
                ranks.append(int((similarities > own).sum()))
    counted, number = np.array(ranks), max(len(ranks), 1)
    return int((counted < 1).sum()) / number, int((counted < 3).sum()) / number, len(ranks)


def run(arguments: list[str]) -> int:
    """Score the networks, record their output, and compare the methods on it."""
    parser = argparse.ArgumentParser(prog='compare', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--out', type=Path, default=Path('demo_compare'), metavar='DIR')
    parser.add_argument('--trials', type=int, default=5, help='number of seeds (%(default)s)')
    parser.add_argument('--iterations', type=int, default=500, help="the paper's %(default)s")
    parser.add_argument('--every', type=int, default=1, metavar='N',
                        help='ask for the pose of each N-th image (%(default)s)')
    parser.add_argument('--budget', type=float, default=2.0, metavar='S',
                        help='time limit of a search [s] (%(default)s), which some exhaustive '
                        'searches reach')
    parser.add_argument('--workers', type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args(arguments)
    make_folder(options.out)
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_compare_') as cache:
        queries = record(ASSETS / 'sequence', landmark_map, Path(cache))
    save_queries(options.out / 'queries.npz', queries)
    first, third, count = score_clip(queries.frames, list(read_frames(ASSETS / 'sequence')),
                                     landmark_map.landmark_ids)
    print(f'detector: mAP50 {score_detector(ASSETS / "sequence"):.3f}; CLIP: top-1 {first:.3f}, '
          f'top-3 {third:.3f} of {count} detected objects, {len(landmark_map)} labels\n')
    paper = RelocalizerOptions(iterations=options.iterations, time_budget_s=options.budget)
    compare_methods(landmark_map, make_queries(queries, landmark_map)[::options.every],
                    parse_methods(['all', 'auto'], paper, len(landmark_map)), options.out,
                    trials=options.trials, workers=options.workers)
    return 0


if __name__ == '__main__':
    sys.exit(run_command(lambda: run(sys.argv[1:])))
