# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A standing robot that retries: ``python -m studies.acceptance.retries``.

Every retry is another chance of a false accept. A robot stands at each query and looks 20 times;
each look misses boxes and shifts the others at random. The robot localizes in the true map, and
in a map whose objects have exchanged places, where every pose is wrong. The session is the same
class that the relocalizer node uses.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cliploc_ros.command import run_command
from cliploc_ros.core.acceptance.verdict import refusal
from cliploc_ros.core.geometry.tolerances import RIGHT_M
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.on_demand import recorded_crops
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.session import Session
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.summary import wilson_interval
from cliploc_ros.evaluation.trials import Query, make_queries
from studies.acceptance.troubles import exchange_landmarks

LOOKS = 20
_PERIOD_NS = 100_000_000
# What a detector does to the same view another time. Guesses.
_MISSED_SHARE = 0.2
_SHIFT_SHARE = 0.02  # of the box's sides, standard deviation


@dataclass(frozen=True)
class Retries:
    """The looks of one robot.

    Parameters
    ----------
    alone : ndarray (LOOKS,) of bool
        Whether each look would be accepted without the others.
    accepted : ndarray (LOOKS,) of bool
        Whether each look is accepted, after those before it.
    errors_m : ndarray (LOOKS,)
        Infinite where no pose was found.
    """

    alone: NDArray[np.bool_]
    accepted: NDArray[np.bool_]
    errors_m: NDArray[np.float64]

    @property
    def first_error_m(self) -> float:
        """Return the error of the first accepted pose, which ends the retries; NaN without."""
        return float(self.errors_m[np.argmax(self.accepted)]) if self.accepted.any() else np.nan


def retry(landmark_map: LandmarkMap, queries: Sequence[Query], options: RelocalizerOptions,
          seed: int = 0) -> Iterator[Retries]:
    """Let a robot retry at each query.

    Parameters
    ----------
    landmark_map : LandmarkMap
    queries : sequence of Query
    options : RelocalizerOptions
    seed : int
        Seed of the random boxes.
    """
    relocalizer, rng = Relocalizer(landmark_map, options), np.random.default_rng(seed)
    for query in queries:
        session = Session(relocalizer)
        alone, accepted, errors_m = [], [], []
        for number in range(LOOKS):
            look = replace(_flickering(query.observation, rng), odom_from_camera=np.eye(4),
                           stamp_ns=(number + 1) * _PERIOD_NS)
            found = session.localize(look, crops=recorded_crops(look, options))
            accepted.append(found.accepted)
            alone.append(found.evidence is not None and not refusal(
                replace(found.evidence, earlier=()), options))
            errors_m.append(np.inf if found.map_from_camera is None else
                            pose_error(found.map_from_camera, query.map_from_camera)[0])
        yield Retries(np.array(alone), np.array(accepted), np.array(errors_m))


def _flickering(observation: Observation, rng: np.random.Generator) -> Observation:
    """Return an observation without some of its boxes; the others are shifted."""
    detections = observation.detections
    rows = np.nonzero(rng.random(len(detections)) > _MISSED_SHARE)[0]
    sides = np.tile(np.diff(detections.bboxes_xyxy.reshape(-1, 2, 2), axis=1)[:, 0], 2)
    shifted = replace(detections, bboxes_xyxy=detections.bboxes_xyxy
                      + _SHIFT_SHARE * sides * rng.normal(size=sides.shape))
    return replace(observation, detections=shifted.select(rows), similarities=np.ascontiguousarray(
        np.asarray(observation.similarities)[rows]))


def _share(count: int, total: int) -> str:
    low, high = wilson_interval(count, total)
    return f'{count} of {total} ({low:.2f} to {high:.2f}, 95 %)'


def _report(name: str, robots: Sequence[Retries]) -> str:
    total = len(robots)
    first = sum(bool(one.accepted[0]) for one in robots)
    alone = sum(bool(one.alone.any()) for one in robots)
    accepted = sum(bool(one.accepted.any()) for one in robots)
    wrong = sum(one.first_error_m > RIGHT_M for one in robots)
    return (f'{name}:\n  accepted at the first look: {_share(first, total)}\n'
            f'  within {LOOKS} looks, each alone: {_share(alone, total)}\n'
            f'  within {LOOKS} looks that agree: {_share(accepted, total)}\n'
            f'  more than {RIGHT_M:g} m off: {wrong}')


def run(arguments: list[str]) -> int:
    """Retry in the true map and elsewhere, and print the results."""
    parser = argparse.ArgumentParser(prog='retries', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--queries', type=Path, required=True, metavar='NPZ')
    parser.add_argument('--map', type=Path, required=True, metavar='YAML')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    landmark_map = LandmarkMap.from_file(options.map)
    queries = make_queries(load_queries(options.queries, landmark_map.landmark_ids), landmark_map)
    elsewhere, _ = exchange_landmarks(landmark_map, queries, 1.0,
                                      np.random.default_rng(options.seed))
    for place, its_map in (('true map', landmark_map), ('another place', elsewhere)):
        for least in (RelocalizerOptions.min_confidence, 0.5):
            name = f'{place}, min_confidence {least:g}'
            robots = retry(its_map, queries, RelocalizerOptions(min_confidence=least),
                           options.seed)
            print(_report(name, list(tqdm(robots, name, len(queries), disable=None))))
    return 0


def main() -> int:
    """Run from the command line; return the exit code."""
    return run_command(lambda: run(sys.argv[1:]))


if __name__ == '__main__':
    sys.exit(main())
