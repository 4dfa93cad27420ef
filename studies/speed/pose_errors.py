# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps from poses with simulated errors: plain, refined with given and with estimated errors.

Both kinds of refinement also run with simulated odometry, a random walk as OdometryErrors says.

    python -m studies.speed pose_errors --observations office.npz --every 2

Landmarks are compared with the nearest of their class in the map of the poses as they are. Errors
that drift move the whole map: all maps are also compared after the rigid motion that lays most
landmarks on one another.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.building import BuiltMap, build_map
from cliploc_ros.offline.mapping.options import MappingOptions, OdometryErrors, PoseErrors
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

LEVELS = ((0.02, 0.5), (0.05, 1.0), (0.1, 2.0))
KINDS = ('independent', 'correlated', 'drifting')
CORRELATION_S = 3.0
# A random walk reaches its level after so long; as a process that holds on to nothing it is one
# of great deviation and time constant. A guess.
DRIFT_S, _DRIFT_FACTOR, _DRIFT_CORRELATION_S = 10.0, 3.0, 90.0
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


def prior_of(kind: str, sigma_m: float, sigma_deg: float) -> PoseErrors:
    """Return what a user who knows the errors gives."""
    if kind == 'drifting':
        return PoseErrors(_DRIFT_FACTOR * sigma_m, _DRIFT_FACTOR * sigma_deg,
                          _DRIFT_CORRELATION_S)
    return PoseErrors(sigma_m, sigma_deg, CORRELATION_S if kind == 'correlated' else 0.0)


def offsets_m(found: LandmarkMap, truth: LandmarkMap) -> NDArray[np.float64]:
    """Return how far each true landmark (L,) is from the nearest found one of its class [m]."""
    return _nearest(found.centers, found, truth)[0]


def aligned_offsets_m(found: LandmarkMap, truth: LandmarkMap) -> NDArray[np.float64]:
    """Return the same after the rigid motion that lays most landmarks on one another."""
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

    The found landmarks are at centers.
    """
    same = np.array(truth.class_ids)[:, None] == np.array(found.class_ids)
    distances = np.linalg.norm(truth.centers[:, None] - centers, axis=2)
    distances[~same] = np.inf
    rows = distances.argmin(axis=1)
    nearest = distances[np.arange(len(rows)), rows]
    return nearest, np.where(np.isfinite(nearest), rows, -1)


def compare(detections: PosedDetections, kind: str, level: tuple[float, float], seed: int,
            truth: LandmarkMap, odometry: OdometryErrors) -> None:
    """Print rows of the table: plain, and refined without and with odometry."""
    drawn = draw_errors(kind, detections.stamps_s, PoseErrors(*level, CORRELATION_S),
                        np.random.default_rng(seed))
    disturbed, plain = disturb(detections, drawn), None
    linked = with_odometry(disturbed, detections, np.random.default_rng([seed, 1]), odometry)
    given = MappingOptions(pose_errors=prior_of(kind, *level), odometry_errors=odometry)
    estimated = MappingOptions(estimate_pose_errors=True, odometry_errors=odometry)
    for name, seen, options in (
            ('plain', disturbed, MappingOptions()),
            ('given', disturbed, given), ('given+odometry', linked, given),
            ('estimated', disturbed, estimated), ('estimated+odometry', linked, estimated)):
        begin = time.process_time()
        built = build_map(seen, options)
        seconds = time.process_time() - begin
        medians = np.array([np.median(measure(built.landmark_map, truth))
                            for measure in (offsets_m, aligned_offsets_m)])
        plain = medians if plain is None else plain
        _show(f'{kind:11s} {100 * level[0]:4.0f} {level[1]:4.1f} {seed:4d} {name:18s}', built,
              medians, plain, seconds)


def _show(head: str, built: BuiltMap, medians: NDArray[np.float64], plain: NDArray[np.float64],
          seconds: float) -> None:
    ratios = plain / np.maximum(medians, 1e-9)
    notes = [note for note in built.report.notes if note.startswith(('poses are off', 'odometry'))]
    print(f'{head} {built.report.landmarks:9d} {100 * medians[0]:7.1f} {ratios[0]:5.2f} '
          f'{100 * medians[1]:10.1f} {ratios[1]:5.2f} {built.report.explained:9.3f} '
          f'{built.report.median_iou:5.3f} {seconds:6.1f} {" ".join(notes)}', flush=True)


def run(arguments: Sequence[str]) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--observations', type=Path, required=True, metavar='NPZ')
    parser.add_argument('--every', type=int, default=1, metavar='N', help='(%(default)s)')
    parser.add_argument('--seeds', type=int, nargs='+', default=[0], metavar='N')
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=KINDS)
    parser.add_argument('--levels', type=int, nargs='+', choices=range(len(LEVELS)),
                        default=range(len(LEVELS)), help='rows of 2 cm, 5 cm, 10 cm')
    parser.add_argument('--odometry-noise', type=float, nargs=2, metavar=('METRES', 'DEGREES'),
                        default=(OdometryErrors.sigma_m, OdometryErrors.sigma_deg),
                        help='after a metre, on each axis (%(default)s)')
    options = parser.parse_args(arguments)
    odometry = OdometryErrors(*options.odometry_noise)
    recorded = load_observations(options.observations)
    detections = recorded.select_frames(range(0, len(recorded), options.every))
    truth = build_map(detections).landmark_map
    print('errors        cm  deg seed poses              landmarks  off cm ratio aligned cm ratio '
          'explained   IoU  cpu s')
    for kind in options.kinds:
        for level in options.levels:
            for seed in options.seeds:
                compare(detections, kind, LEVELS[level], seed, truth, odometry)
    return 0
