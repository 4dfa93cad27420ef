# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A filter that fuses all answers: ``python -m studies.covariance continuous --help``.

A robot walks through simulated worlds and is localized with every image, as in continuous mode. A
Kalman filter fuses odometry with the accepted poses, once with their own covariances, once with
those for a filter (cliploc_ros.core.localizer). A filter is consistent if its errors are within
its 3-sigma ellipsoids as often as they should be.
"""

import argparse
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tqdm import tqdm

from cliploc_ros.command import positive_int
from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    make_transform,
    move_covariance,
    pose_difference,
)
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.trials import PosedQuery
from studies.worlds.places import KINDS
from studies.worlds.world import make_walk

_IMAGES, _FRAMES, _WINDOW_S = 40, 5, 5.0
# Odometry: a random walk with these deviations on each axis after a metre and a radian.
_DRIFT_M, _DRIFT_RAD = 0.03, 0.03
COVARIANCES = ('their own', 'for a filter')


class Filter(NamedTuple):
    """A pose and its covariance, see cliploc_ros.core.fit.covariance; odometry of the pose."""

    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]
    odometry: NDArray[np.float64]

    def predicted(self, odometry: NDArray[np.float64]) -> 'Filter':
        """Return the filter after a motion by odometry."""
        motion = invert_transform(self.odometry) @ odometry
        pose = self.pose @ motion
        ways = [np.linalg.norm(motion[:3, 3]), Rotation.from_matrix(motion[:3, :3]).magnitude()]
        noise = np.repeat(np.array([_DRIFT_M, _DRIFT_RAD]) ** 2 * ways, 3)
        return Filter(pose, move_covariance(self.covariance, pose[:3, 3] - self.pose[:3, 3])
                      + np.diag(noise), odometry)

    def updated(self, pose: NDArray[np.float64], covariance: NDArray[np.float64]) -> 'Filter':
        """Return the filter after a measurement that it takes for independent."""
        gain = np.linalg.solve(self.covariance + covariance, self.covariance).T
        step = gain @ pose_difference(self.pose, pose)
        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        return Filter(make_transform(turn @ self.pose[:3, :3], self.pose[:3, 3] + step[:3]),
                      self.covariance - gain @ self.covariance, self.odometry)


def walk_squares(kind: str, seed: int) -> NDArray[np.float64]:
    """Return the NEES of both filters (n, 2) after each accepted pose of a walk, see COVARIANCES.

    Parameters
    ----------
    kind : str
        One of KINDS.
    """
    world = make_walk(kind, seed, _IMAGES)
    session = Localizer(Relocalizer(world.landmark_map, RelocalizerOptions(
        k=min(3, len(world.landmark_map)), crops='all')))
    filters: list[Filter] = []
    squares = []
    odometry = _odometry(world.queries, np.random.default_rng([seed, 1]))
    for query, pose in zip(world.queries, odometry, strict=True):
        found = session.answer(Query((replace(query.observation, odom_from_camera=pose),),
                                     limit=_FRAMES, length_s=_WINDOW_S))
        filters = [one.predicted(pose) for one in filters]
        if not found.accepted:
            continue
        assert found.map_from_camera is not None and found.covariance is not None
        for_filter = session.covariance_for_filter(found)
        assert for_filter is not None
        filters = [one.updated(found.map_from_camera, covariance) for one, covariance in
                   zip(filters, (found.covariance, for_filter), strict=True)] if filters \
            else [Filter(found.map_from_camera, found.covariance, pose)] * len(COVARIANCES)
        squares.append([normalized_square(one.pose, one.covariance, query.map_from_camera)
                        for one in filters])
    return np.array(squares).reshape(-1, len(COVARIANCES))


def _odometry(queries: tuple[PosedQuery, ...], rng: np.random.Generator
              ) -> list[NDArray[np.float64]]:
    """Return odom_from_camera (4, 4) of each image."""
    poses = [np.eye(4)]
    for before, after in pairwise(queries):
        step = invert_transform(before.map_from_camera) @ after.map_from_camera
        ways = [np.linalg.norm(step[:3, 3]), Rotation.from_matrix(step[:3, :3]).magnitude()]
        drawn = rng.normal(size=(2, 3)) * (np.array([_DRIFT_M, _DRIFT_RAD])
                                           * np.sqrt(ways))[:, None]
        poses.append(poses[-1] @ step @ make_transform(
            Rotation.from_rotvec(drawn[1]).as_matrix(), drawn[0]))
    return poses


def run(arguments: list[str]) -> int:
    """Print the share of consistent states of both filters."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=['room', 'office'])
    parser.add_argument('--worlds', type=positive_int, default=10, metavar='N',
                        help='of each kind')
    parser.add_argument('--first-seed', type=int, default=0, metavar='N')
    options = parser.parse_args(arguments)
    if options.first_seed < 0:
        raise OptionsError(f'--first-seed: {options.first_seed} is below 0')
    tasks = [(kind, options.first_seed + number) for kind in options.kinds
             for number in range(options.worlds)]
    squares = np.concatenate([walk_squares(*task) for task in tqdm(tasks, 'walks', disable=None)])
    print(f'{len(squares)} accepted poses of {_IMAGES * len(tasks)} images')
    print('| covariances | states within 95 % | within 3 sigma (99.7 %) | median of NEES / 5.35 |')
    print('|---|---|---|---|')
    for name, own in zip(COVARIANCES, squares.T, strict=True):
        print(f'| {name} | {(own < chi2.ppf(0.95, 6)).mean():.3f} '
              f'| {(own < chi2.ppf(0.9973, 6)).mean():.3f} '
              f'| {np.median(own) / chi2.median(6):.2f} |')
    return 0
