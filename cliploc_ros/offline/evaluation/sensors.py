# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors besides the camera, made of the true poses and of noise."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.depth import (
    CHORD_DEVIATION,
    SURFACE_SHARE,
    depth_deviations,
    depth_of,
    half_chord,
)
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import Observation
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.trials import PosedQuery

# Of the boxes of a kitchen, a tenth have no depth. The share of those whose depth is of something
# else, and between which values that is [m], are guesses.
_NO_DEPTH, _SOMETHING_ELSE, _ANY_DEPTH_M = 0.1, 0.05, (0.5, 5.0)


def with_vertical(queries: Sequence[PosedQuery], noise_deg: float = 0.0, seed: int = 0
                  ) -> tuple[PosedQuery, ...]:
    """Return queries with a known vertical, as from an accelerometer.

    Parameters
    ----------
    noise_deg : float
        Standard deviation of the error of each vertical [deg], a rotation about a random level
        axis.
    seed : int
        Equal seeds give equal noise in any order of the queries.
    """
    found = []
    for query in queries:
        rng = np.random.default_rng([seed, query.number])
        up = turned(query.map_from_camera[2, :3], np.radians(noise_deg) * rng.normal(), rng)
        found.append(replace(
            query, observation=replace(query.observation, up_in_camera=up), neighbours=tuple(
                _same_vertical(one, query.observation, up) for one in query.neighbours)))
    return tuple(found)


def _same_vertical(one: Observation, other: Observation, up_in_other: NDArray[np.float64]
                   ) -> Observation:
    """Return what another camera of the robot sees, with the same vertical."""
    if one.odom_from_camera is None or other.odom_from_camera is None:
        return one
    turn = one.odom_from_camera[:3, :3].T @ other.odom_from_camera[:3, :3]
    return replace(one, up_in_camera=turn @ up_in_other)


def with_neighbours(queries: Sequence[PosedQuery], groups: Sequence[int], noise_m: float = 0.0,
                    noise_deg: float = 0.0, seed: int = 0) -> tuple[PosedQuery, ...]:
    """Return queries with the other frames of their group, linked by odometry.

    Parameters
    ----------
    queries : sequence of PosedQuery
        All frames.
    groups : sequence of int
        The group of each.
    noise_m, noise_deg : float
        Standard deviations of the error of each step from one frame to the next in time, on each
        axis.
    seed : int
        Equal seeds give equal noise.

    Raises
    ------
    OptionsError
        No group has a second frame.
    """
    found: dict[int, PosedQuery] = {}
    for group in dict.fromkeys(groups):
        frames = sorted((one for one, its in zip(queries, groups, strict=True) if its == group),
                        key=lambda one: one.observation.stamp_ns)
        rng = np.random.default_rng([seed, abs(group), 1])
        joined = [replace(one.observation, odom_from_camera=pose) for one, pose in zip(
            frames, _odometry(frames, noise_m, noise_deg, rng), strict=True)]
        for row, query in enumerate(frames):
            near = sorted(range(len(frames)), key=lambda other: abs(other - row))[1:MAX_FRAMES]
            found[query.number] = replace(query, observation=joined[row], neighbours=tuple(
                joined[other] for other in sorted(near)))
    if not any(one.neighbours for one in found.values()):
        raise OptionsError('--fuse: no query of this input has neighbouring frames in its group')
    return tuple(found[query.number] for query in queries)


def simulate_depths(centers: NDArray[np.float64], shapes: NDArray[np.float64],
                    map_from_camera: NDArray[np.float64], rng: np.random.Generator,
                    scale: float = 1.0) -> NDArray[np.float64]:
    """Return the depths (m,) [m] that an RGB-D camera would measure in m boxes; NaN for none.

    Parameters
    ----------
    centers, shapes : ndarray (m, 3), (m, 6)
        Of the ellipsoid that each box shows, in the map; NaN where it shows something else.
    map_from_camera : ndarray (4, 4)
    scale : float
        Measured over true depth.
    """
    camera_from_map = invert_transform(map_from_camera)
    rotation, translation = (np.ascontiguousarray(camera_from_map[:3, :3]),
                             np.ascontiguousarray(camera_from_map[:3, 3]))
    depths = rng.uniform(*_ANY_DEPTH_M, len(centers))
    seen = np.isfinite(centers).all(axis=1) & (rng.random(len(centers)) >= _SOMETHING_ELSE)
    for row in np.nonzero(seen)[0]:
        share = rng.normal(SURFACE_SHARE, CHORD_DEVIATION)
        depths[row] = (depth_of(rotation, translation, centers[row]) - share * half_chord(
            centers[row], shapes[row], rotation, translation))
    depths = scale * depths + rng.normal(size=len(depths)) * depth_deviations(depths)
    depths[(rng.random(len(depths)) < _NO_DEPTH) | (depths <= 0.0)] = np.nan
    return depths


def _odometry(frames: Sequence[PosedQuery], noise_m: float, noise_deg: float,
              rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Return odom_from_camera (4, 4) of each frame, with a random error of each step."""
    poses = [np.eye(4)]
    for before, after in pairwise(frames):
        step = invert_transform(before.map_from_camera) @ after.map_from_camera
        turn = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3)).as_matrix()
        shift = noise_m * rng.normal(size=3)
        poses.append(poses[-1] @ step @ make_transform(turn, shift))
    return poses


def turned(direction: NDArray[np.float64], angle: float, rng: np.random.Generator
            ) -> NDArray[np.float64]:
    """Return a direction (3,) rotated by an angle [rad] about a random perpendicular axis."""
    axis = np.cross(direction, rng.normal(size=3))
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    return np.asarray(turn.apply(direction))
