# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A room of twelve objects and a perfect view of it: simulated, for tests without recordings."""

from dataclasses import replace

import numpy as np
import yaml

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
MAP_FROM_CAMERA = transform_from_pose(np.array([0.3, -0.2, -0.5]),
                                      np.array([0.02, -0.05, 0.03, 0.99794]))


def make_room() -> LandmarkMap:
    """Twelve objects of three classes, scattered before the camera."""
    rng, count = np.random.default_rng(7), 12
    quats = rng.normal(size=(count, 4))
    return LandmarkMap(
        'map', tuple(f'thing_{i}' for i in range(count)),
        tuple(f'thing number {i}' for i in range(count)),
        tuple('abc'[i % 3] for i in range(count)),
        np.c_[rng.uniform(-2, 2, (count, 2)), rng.uniform(3, 6, count)],
        rng.uniform(0.05, 0.3, (count, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True))


def doubled_room(offset) -> LandmarkMap:
    """The room twice; the second one is an offset (3,) away [m]."""
    room = make_room()
    return replace(room, landmark_ids=(*room.landmark_ids, *(f'{one}_2' for one in
                                                            room.landmark_ids)),
                   labels=room.labels * 2, class_ids=room.class_ids * 2,
                   centers=np.concatenate([room.centers, room.centers + offset]),
                   semi_axes=np.tile(room.semi_axes, (2, 1)),
                   quats_xyzw=np.tile(room.quats_xyzw, (2, 1)))


def see_room(room: LandmarkMap, map_from_camera=MAP_FROM_CAMERA) -> Detections:
    """What a perfect detector sees of the room, one box for each landmark in its order."""
    outlines = project_ellipsoids(invert_transform(map_from_camera), room.centers, room.shapes)
    boxes = ellipse_bboxes(ellipses_in_pixels(outlines, CAMERA))
    return Detections(boxes, room.class_ids, np.full(len(room), 0.9))


def write_map(room: LandmarkMap, path) -> None:
    """Write a map file."""
    landmarks = {
        landmark_id: {'label': room.labels[i], 'class_id': room.class_ids[i],
                      'center': room.centers[i].tolist(), 'semi_axes': room.semi_axes[i].tolist(),
                      'orientation': room.quats_xyzw[i].tolist()}
        for i, landmark_id in enumerate(room.landmark_ids)}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {
        'map': {'frame_id': room.frame_id, 'landmarks': landmarks}}}}))
