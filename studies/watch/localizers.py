# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives with a simulated localizer: right with drift, displaced, or of a camera mounted wrong."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S
from studies.acceptance.places import observation_of
from studies.worlds.world import make_drive

#: Time between looks [s].
LOOK_S = 2.0
# A localizer drifts, and its sensors correct it: deviations on x and y [m], and of the yaw [deg];
# errors fall to 1 / e in this many looks. Odometry: of a step [m] [deg].
_DRIFT_M, _DRIFT_DEG, _DRIFT_LOOKS = (0.05, 0.3), 1.0, 5.0
_STEP_M, _STEP_DEG = 0.01, 0.3


class Drive(NamedTuple):
    """What a camera saw on a drive, and where it was."""

    name: str
    landmark_map: LandmarkMap
    observations: Sequence[Observation]  #: With odometry
    poses: NDArray[np.float64]  #: (k, 4, 4): true map_from_camera
    #: (L,): see studies.worlds.world.Drive
    changed: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    #: (2, 2): least and greatest x and y where a localizer may put the robot [m]
    bounds: NDArray[np.float64]


def simulated_drive(kind: str, seed: int, images: int, changed: float = 0.0,
                    labels: bool = False) -> Drive:
    """Return a drive through a world; without labels, objects are matched by class."""
    found = make_drive(kind, seed, images, changed)
    poses = np.array([one.map_from_camera for one in found.world.queries])
    seen = [one.observation if labels else replace(one.observation, similarities=None)
            for one in found.world.queries]
    stamped = [replace(one, stamp_ns=round(row * LOOK_S * NS_PER_S))
               for row, one in enumerate(seen)]
    return Drive(kind, found.world.landmark_map, with_odometry(stamped, poses, seed), poses,
                 found.changed, found.wrong, np.array([(0.0, 0.0), found.size]))


def with_odometry(observations: Sequence[Observation], poses: NDArray[np.float64], seed: int
                  ) -> list[Observation]:
    """Return observations with odometry along true poses (k, 4, 4), with errors of each step."""
    rng = np.random.default_rng([seed, 11])
    odom, way_m, found = poses[0], 0.0, []
    for row, one in enumerate(observations):
        if row:
            step = invert_transform(poses[row - 1]) @ poses[row]
            length = float(np.linalg.norm(step[:3, 3]))
            moved = length > 1e-3 or np.trace(step[:3, :3]) < 3.0 - 1e-5
            error = make_transform(
                Rotation.from_rotvec(np.radians(_STEP_DEG) * rng.normal(size=3)).as_matrix(),
                _STEP_M * rng.normal(size=3)) if moved else np.eye(4)
            odom, way_m = odom @ step @ error, way_m + length
        found.append(replace(one, odom_from_camera=odom, odom_way_m=way_m))
    return found


def drifting(poses: NDArray[np.float64], rng: np.random.Generator, drift_m: float | None = None
             ) -> NDArray[np.float64]:
    """Return the poses (k, 4, 4) of a localizer whose errors come and go."""
    count, keep = len(poses), np.exp(-1.0 / _DRIFT_LOOKS)
    noise = rng.normal(size=(count, 3))
    for row in range(1, count):
        noise[row] = keep * noise[row - 1] + np.sqrt(1.0 - keep ** 2) * noise[row]
    # the mean length of a vector of two normal values is 1.25 deviations
    noise[:, :2] *= (rng.uniform(*_DRIFT_M) if drift_m is None else drift_m) / 1.25
    lengths = np.linalg.norm(noise[:, :2], axis=1, keepdims=True)
    noise[:, :2] *= np.minimum(1.0, _DRIFT_M[1] / np.maximum(lengths, 1e-9))
    noise[:, 2] *= np.radians(_DRIFT_DEG)
    return np.array([displaced(pose, x, y, yaw)
                     for pose, (x, y, yaw) in zip(poses, noise.tolist(), strict=True)])


def displaced(pose: NDArray[np.float64], x: float, y: float, yaw: float
              ) -> NDArray[np.float64]:
    """Return a pose (4, 4) moved in the plane [m] and turned about its vertical [rad]."""
    turn = Rotation.from_euler('z', yaw).as_matrix()
    return make_transform(turn @ pose[:3, :3], pose[:3, 3] + (x, y, 0.0))


def kidnapped(pose: NDArray[np.float64], metres: float, degrees: float,
              bounds: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return wrong_from_right (4, 4), which displaces a localizer at a pose (4, 4) in a place."""
    x, y = 0.0, 0.0
    if metres:
        angles = rng.uniform(-np.pi, np.pi, 50)
        steps = metres * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ends = pose[:2, 3] + steps
        outside = np.maximum(bounds[0] - ends, ends - bounds[1]).clip(0.0).sum(axis=1)
        x, y = steps[int(np.argmin(outside))]
    wrong = displaced(pose, x, y, np.radians(degrees) * rng.choice((-1.0, 1.0)))
    return wrong @ invert_transform(pose)


def turned_camera(degrees: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a turn (4, 4) about a random axis: stated_from_true of a camera that was hit."""
    axis = rng.normal(size=3)
    return make_transform(Rotation.from_rotvec(
        np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix(), np.zeros(3))


def recorded_drive(name: str, recorded: PosedDetections, landmark_map: LandmarkMap,
                   rows: Sequence[int]) -> Drive:
    """Return some frames of a recording, in the order of time, as a drive, by class."""
    poses = recorded.map_from_camera[np.array(rows)]
    seen = [observation_of(recorded, row, round(recorded.stamps_s[row] * NS_PER_S))
            for row in rows]
    none = np.zeros(len(landmark_map), dtype=np.bool_)
    return Drive(name, landmark_map, with_odometry(seen, poses, rows[0]), poses, none, none,
                 np.array([poses[:, :2, 3].min(axis=0), poses[:, :2, 3].max(axis=0)]))
