# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What makes queries fail: ``python -m studies.blame --help``.

The true pose is refined on the boxes of its query like any hypothesis, and compared with what the
search found. The first of these that holds is to blame:

objects     the true pose explains fewer objects than a sample needs
map         refinement leads the true pose away from the truth
candidates  too few of the pairs that it explains are correspondence candidates
choice      the search found a right pose, or the best one has more support than the true one
search      the true pose has more support than any that the search found

The last column counts failing queries with five or more objects whose true landmark is a candidate
of a box: there association allows a right pose. In several images an object counts once.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.confidence import tilt_handicaps, utilities
from cliploc_ros.core.acceptance.support import Support, compared_frame, support
from cliploc_ros.core.fit.finalists import Finalist, Match, matches_of
from cliploc_ros.core.fit.refinement import refine_rig
from cliploc_ros.core.fit.verification import cameras_from_last, make_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import SearchedFrame
from cliploc_ros.offline.datasets.queries import Queries, load_queries
from cliploc_ros.offline.evaluation.sensors import with_neighbours, with_vertical
from cliploc_ros.offline.evaluation.trials import PosedQuery, make_queries

CAUSES = ('objects', 'map', 'candidates', 'search', 'choice')
_MATCHINGS = {'hybrid': 'labels', 'class': 'classes'}
# Deviations of the simulated sensors, as in doc/results.md.
_VERTICAL_NOISE_DEG, _ODOMETRY_NOISE = 1.0, (0.01, 0.5)
_MANY = 5


class Blame(NamedTuple):
    """What makes a query fail."""

    cause: str  #: One of CAUSES; empty if the query does not fail
    #: Number of landmarks that are correspondence candidates of a box that shows them
    candidates: int


class Known(NamedTuple):
    """Queries, and the options that say what else is known."""

    name: str
    queries: Sequence[PosedQuery]
    options: RelocalizerOptions


def blame(landmark_map: LandmarkMap, relocalizer: Relocalizer, query: PosedQuery, limit_m: float
          ) -> Blame:
    """Return what makes a query fail.

    Parameters
    ----------
    relocalizer : Relocalizer
        Of this map.
    limit_m : float
        A pose within this distance of the truth is right [m].
    """
    frames = [relocalizer.search(one) for one in (*query.neighbours, query.observation)]
    found = relocalizer.locate(frames)
    errors = [pose_error(one.map_from_camera, query.map_from_camera)[0]
              for one in found.hypotheses]
    true_pose, matches = _refined(frames, query.map_from_camera, landmark_map.position_sigmas)
    candidates = [{one.landmark for one in its
                   if [one.detection, one.landmark] in frame.scene.pairs.tolist()}
                  for frame, its in zip(frames, matches, strict=True)]
    least = frames[-1].sample_size
    if errors and errors[0] <= limit_m:
        cause = ''
    elif len({one.landmark for its in matches for one in its}) < least:
        cause = 'objects'
    elif pose_error(true_pose, query.map_from_camera)[0] > limit_m:
        cause = 'map'
    elif max(map(len, candidates)) < least:
        cause = 'candidates'
    elif any(error <= limit_m for error in errors):
        cause = 'choice'
    else:
        its = _support(landmark_map, frames, true_pose, matches)
        best = [(one.support, one.map_from_camera) for one in found.hypotheses[:1]]
        leads = [_lead(*one, relocalizer.options) for one in ((its, true_pose), *best)]
        cause = 'search' if int(np.argmax(leads)) == 0 else 'choice'
    return Blame(cause, len(set().union(*candidates)))


def _refined(frames: Sequence[SearchedFrame], map_from_camera: NDArray[np.float64],
             sigmas: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[tuple[Match, ...]]]:
    """Return a pose (4, 4) of the last frame after refinement, and what it explains in each."""
    rig = make_rig([one.scene for one in frames],
                   cameras_from_last([one.observation for one in frames]),
                   np.stack([one.vertical for one in frames]), sigmas)
    camera_from_map = invert_transform(map_from_camera)
    refined = refine_rig(rig, np.ascontiguousarray(camera_from_map[:3, :3]),
                         np.ascontiguousarray(camera_from_map[:3, 3]))
    pose = Finalist(refined.rotation, refined.translation, refined.score, 0, 0,
                    np.empty(0, dtype=np.int64))
    return pose.map_from_camera, matches_of(rig, pose)


def _support(landmark_map: LandmarkMap, frames: Sequence[SearchedFrame],
             pose: NDArray[np.float64], matches: Sequence[tuple[Match, ...]]) -> Support:
    """Return the support of a pose of the last frame."""
    compared = [compared_frame(
        landmark_map, frame.observation.detections, frame.scene, frame.observation.similarities,
        frame.observation.similarity_rows) for frame in frames]
    cameras = cameras_from_last([one.observation for one in frames])
    return support(landmark_map, compared, pose @ np.linalg.inv(cameras), matches)


def _lead(its: Support, pose: NDArray[np.float64], options: RelocalizerOptions) -> float:
    """Return the utility by which a pose is chosen."""
    handicap = tilt_handicaps(pose[None], options.tilt_deviation_deg)
    return float((utilities([its]) - handicap)[0])


def count_causes(landmark_map: LandmarkMap, known: Known, limit_m: float) -> list[Blame]:
    """Return what makes each query fail."""
    options = replace(known.options, k=min(known.options.k, len(landmark_map)))
    relocalizer = Relocalizer(landmark_map, options)
    return [blame(landmark_map, relocalizer, query, limit_m) for query in known.queries]


def with_sensors(queries: Queries, landmark_map: LandmarkMap, every_frame: bool, matching: str,
                 heights_m: tuple[float, float]) -> Iterator[Known]:
    """Yield the queries of a file with more and more sensors.

    Parameters
    ----------
    every_frame : bool
        Whether the neighbouring frames are queries, too.
    matching : str
        'hybrid', or 'class' for queries without similarities.
    heights_m : tuple of float
        Range of the camera's height where it is known.
    """
    frames = make_queries(queries, landmark_map, every_frame=True)
    if matching == 'class':
        frames = tuple(replace(one, observation=replace(one.observation, similarities=None))
                       for one in frames)
    asked = [frame.is_main or every_frame for frame in queries.frames]
    groups = [frame.group for frame in queries.frames]
    level = with_vertical(frames, _VERTICAL_NOISE_DEG)
    plain = RelocalizerOptions(matching=matching)
    high = replace(plain, height_range_m=heights_m)
    several = len(set(groups)) < len(groups)
    for name, found, options in (
            ('one image', frames, plain), ('vertical', level, plain),
            ('vertical, height', level, high), ('five images', frames, plain),
            ('five, vertical, height', level, high)):
        if name.startswith('five'):
            if not several:
                continue
            found = with_neighbours(found, groups, *_ODOMETRY_NOISE)
        yield Known(name, [one for one, is_asked in zip(found, asked, strict=True) if is_asked],
                    options)


def run(arguments: list[str]) -> int:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(prog='blame', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, nargs='+', metavar='NPZ',
                        help='of the map; several seeds of simulated similarities add up')
    parser.add_argument('--map', type=Path, required=True, metavar='YAML')
    parser.add_argument('--matching', nargs='+', choices=_MATCHINGS, default=list(_MATCHINGS))
    parser.add_argument('--limit', type=float, default=0.5, metavar='M',
                        help='error of a right pose (%(default)s)')
    parser.add_argument('--frames', choices=('main', 'all'), default='main')
    parser.add_argument('--height-range', type=float, nargs=2, default=(0.8, 2.2),
                        metavar=('LOW', 'HIGH'), help='of the camera, where it is known [m]')
    options = parser.parse_args(arguments)
    landmark_map = LandmarkMap.from_file(options.map)
    files = [load_queries(path, landmark_map.landmark_ids) for path in options.queries]
    print(f'| by | known | queries | right within {options.limit:g} m | '
          + ' | '.join(CAUSES) + f' | fail with {_MANY} candidates or more |')
    print('|---|---|' + '---|' * (len(CAUSES) + 3))
    for matching in options.matching:
        low, high = options.height_range
        by_mode = zip(*(with_sensors(file, landmark_map, options.frames == 'all', matching,
                                     (low, high)) for file in files), strict=True)
        for seeds in by_mode:
            found = [one for known in seeds
                     for one in count_causes(landmark_map, known, options.limit)]
            counts = Counter(one.cause for one in found)
            many = sum(bool(one.cause) and one.candidates >= _MANY for one in found)
            print(f'| {_MATCHINGS[matching]} | {seeds[0].name} | {len(found)} | {counts[""]} | '
                  + ' | '.join(str(counts[cause]) for cause in CAUSES) + f' | {many} |',
                  flush=True)
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
