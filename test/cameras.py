# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot with four cameras among objects."""

import numpy as np
from scene import CAMERA, boxes_of, make_room, rigid
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation

NAMES = ('front', 'left', 'back', 'right')


def make_surroundings():
    """Return the room's objects four times around the robot, each time moved a little."""
    room, rng = make_room(), np.random.default_rng(11)
    centers, quats = [], []
    for row in range(4):
        turn = Rotation.from_euler('y', 90.0 * row, degrees=True)
        centers.append(turn.apply(room.centers + rng.normal(0.0, 0.6, room.centers.shape)))
        quats.append((turn * Rotation.from_quat(room.quats_xyzw)).as_quat())
    ids = tuple(f'{name}_{landmark_id}' for name in NAMES for landmark_id in room.landmark_ids)
    return LandmarkMap('map', ids, ids, 4 * room.class_ids, np.concatenate(centers),
                       np.tile(room.semi_axes, (4, 1)), np.concatenate(quats))


MAP = make_surroundings()
MOUNTS = [rigid(axis='y', degrees=90.0 * row) @ rigid((0.0, 0.0, 0.15)) for row in range(4)]


def look(rng, map_from_robot=None, objects=3, stamp_ns=0, mounts=MOUNTS, noise_px=1.0):
    """Return the observation of each camera: a few of the objects before it, with its mount."""
    map_from_robot = np.eye(4) if map_from_robot is None else map_from_robot
    seen = []
    for name, mount, stated in zip(NAMES, mounts, MOUNTS, strict=True):
        boxes = boxes_of(MAP, map_from_robot @ mount)
        with np.errstate(invalid='ignore'):
            inside = ((boxes[:, :2] > 0.0) & (boxes[:, 2:] < (CAMERA.width, CAMERA.height))
                      ).all(axis=1)
        rows = rng.permutation(np.nonzero(inside)[0])[:objects]
        boxes = boxes[rows] + rng.normal(0.0, noise_px, (len(rows), 4))
        seen.append(Observation(
            CAMERA, Detections(boxes, tuple(MAP.class_ids[row] for row in rows),
                               np.full(len(rows), 0.9)), stamp_ns=stamp_ns, camera_name=name,
            odom_from_camera=map_from_robot @ stated))
    return seen
