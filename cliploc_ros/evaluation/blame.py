# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What makes queries fail: ``python -m cliploc_ros.evaluation.blame --help``.

The true pose is refined on the boxes of its query like any hypothesis, and compared with what the
search found. The first of these that holds is to blame:

map         the true pose explains too few boxes, or refinement leads it away from the truth
candidates  too few of the pairs that it explains are correspondence candidates
choice      the search found a right pose, or the best one has more support than the true one
search      the true pose has more support than any that the search found
"""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.confidence import ComparedFrame, support, utilities
from cliploc_ros.core.fit.finalists import Finalist, Match, matches_of
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.rig import make_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.sensors import with_vertical
from cliploc_ros.evaluation.trials import Query, make_queries

CAUSES = ('map', 'candidates', 'search', 'choice')
_VERTICAL_NOISE_DEG = 1.0


def blame(landmark_map: LandmarkMap, relocalizer: Relocalizer, query: Query, limit_m: float
          ) -> str:
    """Return what makes a query fail, see CAUSES; empty if it does not fail.

    Parameters
    ----------
    landmark_map : LandmarkMap
    relocalizer : Relocalizer
        Of this map.
    query : Query
        Its neighbours are not used.
    limit_m : float
        A pose within this distance of the truth is right [m].
    """
    frame = relocalizer.search(query.observation)
    found = relocalizer.locate([frame])
    errors = [pose_error(one.map_from_camera, query.map_from_camera)[0]
              for one in found.hypotheses]
    if errors and errors[0] <= limit_m:
        return ''
    true_pose, matches = _refined(frame, query.map_from_camera, landmark_map.position_sigmas)
    pairs = {(one.detection, one.landmark) for one in matches}
    if (len(pairs) < frame.sample_size
            or pose_error(true_pose, query.map_from_camera)[0] > limit_m):
        return 'map'
    if len(pairs & set(map(tuple, frame.scene.pairs.tolist()))) < frame.sample_size:
        return 'candidates'
    if any(error <= limit_m for error in errors):
        return 'choice'
    detections = query.observation.detections
    compared = ComparedFrame(detections.bboxes_xyxy, detections.class_ids,
                             query.observation.similarities, frame.scene,
                             query.observation.similarity_rows)
    true_support = support(landmark_map, [compared], true_pose[None], [matches])
    supports = [true_support, *(one.support for one in found.hypotheses[:1])]
    return 'search' if int(np.argmax(utilities(supports))) == 0 else 'choice'


def _refined(frame: SearchedFrame, map_from_camera: NDArray[np.float64],
             sigmas: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[Match, ...]]:
    """Return a pose (4, 4) after refinement on a frame, and what it explains."""
    rig = make_rig([frame.scene], np.eye(4)[None], frame.vertical[None], sigmas)
    camera_from_map = invert_transform(map_from_camera)
    refined = refine_rig(rig, np.ascontiguousarray(camera_from_map[:3, :3]),
                         np.ascontiguousarray(camera_from_map[:3, 3]))
    pose = Finalist(refined.rotation, refined.translation, refined.score, 0, 0,
                    np.empty(0, dtype=np.int64))
    return pose.map_from_camera, matches_of(rig, pose)[0]


def count_causes(landmark_map: LandmarkMap, queries: Sequence[Query],
                 options: RelocalizerOptions, limit_m: float) -> Counter[str]:
    """Return how many queries fail for each cause; '' counts those that do not fail."""
    relocalizer = Relocalizer(landmark_map,
                              replace(options, k=min(options.k, len(landmark_map))))
    return Counter(blame(landmark_map, relocalizer, query, limit_m) for query in queries)


def run(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog='blame', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, metavar='YAML')
    parser.add_argument('--limit', type=float, default=0.5, metavar='M',
                        help='error of a right pose (%(default)s)')
    parser.add_argument('--frames', choices=('main', 'all'), default='main')
    options = parser.parse_args(arguments)
    landmark_map = LandmarkMap.from_file(options.map)
    queries = make_queries(load_queries(options.queries, landmark_map.landmark_ids),
                           landmark_map, options.frames == 'all')
    print(f'{len(queries)} queries, right within {options.limit:g} m')
    print(f'{"":28}{"right":>7}' + ''.join(f'{cause:>12}' for cause in CAUSES))
    for name, asked in (('one image', queries),
                        (f'vertical to {_VERTICAL_NOISE_DEG:g} degree',
                         with_vertical(queries, _VERTICAL_NOISE_DEG))):
        counts = count_causes(landmark_map, asked, RelocalizerOptions(), options.limit)
        print(f'{name:28}{counts[""]:7}' + ''.join(f'{counts[one]:12}' for one in CAUSES))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
