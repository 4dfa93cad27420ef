# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated errors of poses and odometry, and errors of the resulting maps."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.options import OdometryErrors, PoseErrors
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

KINDS = ('independent', 'correlated', 'drifting')
DRIFT_S = 10.0  # time after which a random walk reaches its level
_ALIGNING_STEPS, _ALIGNED_SHARE = 10, 0.7


def disturb(detections: PosedDetections, errors: NDArray[np.float64]) -> PosedDetections:
    """Return the detections with errors (F, 6) added to their poses, in the map's axes."""
    poses = detections.map_from_camera.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += errors[:, :3]
    return detections.with_poses(poses)


def with_odometry(detections: PosedDetections, truth: PosedDetections,
                  rng: np.random.Generator, noise: OdometryErrors) -> PosedDetections:
    """Return the detections with odometry: true motions with a random error of each step."""
    before, after = truth.map_from_camera[:-1], truth.map_from_camera[1:]
    steps = np.linalg.inv(before) @ after
    sigmas = noise.sigmas(np.linalg.norm(steps[:, :3, 3], axis=1),
                          Rotation.from_matrix(steps[:, :3, :3]).magnitude())
    drawn = rng.normal(size=(len(steps), 6)) * np.repeat(sigmas, 3, axis=1)
    steps[:, :3, :3] = Rotation.from_rotvec(drawn[:, 3:]).as_matrix() @ steps[:, :3, :3]
    steps[:, :3, 3] += drawn[:, :3]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return replace(detections, odom_from_camera=np.array(poses))


def draw_errors(kind: str, stamps_s: NDArray[np.float64], errors: PoseErrors,
                rng: np.random.Generator) -> NDArray[np.float64]:
    """Return errors (F, 6) of poses: x, y, z [m], rotation vector [rad].

    Parameters
    ----------
    kind : str
        One of KINDS.
    stamps_s : ndarray (F,)
    errors : PoseErrors
        Drifting errors reach these deviations after DRIFT_S.
    """
    drawn = rng.normal(size=(len(stamps_s), 6))
    steps_s = np.diff(stamps_s)[:, None]
    if kind == 'drifting':
        drawn[0] = 0.0
        drawn[1:] = np.cumsum(drawn[1:] * np.sqrt(steps_s / DRIFT_S), axis=0)
    if kind == 'correlated':
        kept = np.exp(-steps_s / errors.correlation_s)
        for frame, keep in enumerate(kept):
            drawn[frame + 1] = keep * drawn[frame] + np.sqrt(1 - keep ** 2) * drawn[frame + 1]
    return np.asarray(drawn * errors.sigmas)


def offsets_m(found: LandmarkMap, truth: LandmarkMap) -> NDArray[np.float64]:
    """Return the distance of each true landmark (L,) to the nearest found one of its class [m]."""
    return _nearest(found.centers, found, truth)[0]


def aligned_offsets_m(found: LandmarkMap, truth: LandmarkMap) -> NDArray[np.float64]:
    """Return these distances after the rigid motion that aligns most landmarks."""
    centers = found.centers
    for _ in range(_ALIGNING_STEPS):
        distances, nearest = _nearest(centers, found, truth)
        limit = max(float(np.quantile(distances, _ALIGNED_SHARE)), 1e-6)
        near = (distances <= limit) & (nearest >= 0)
        if np.count_nonzero(near) < 3:
            break
        source, target = found.centers[nearest[near]], truth.centers[near]
        turn, _ = Rotation.align_vectors(target - target.mean(axis=0),
                                         source - source.mean(axis=0))
        centers = turn.apply(found.centers - source.mean(axis=0)) + target.mean(axis=0)
    return _nearest(centers, found, truth)[0]


def _nearest(centers: NDArray[np.float64], found: LandmarkMap, truth: LandmarkMap
             ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return distance and row of the landmark nearest to each true one, infinite and -1 if none.

    ``centers`` are those of the found landmarks.
    """
    same = np.array(truth.class_ids)[:, None] == np.array(found.class_ids)
    distances = np.linalg.norm(truth.centers[:, None] - centers, axis=2)
    distances[~same] = np.inf
    rows = distances.argmin(axis=1)
    nearest = distances[np.arange(len(rows)), rows]
    return nearest, np.where(np.isfinite(nearest), rows, -1)
