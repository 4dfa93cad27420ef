# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated room of twelve objects with a perfect view, for tests without recordings."""

from dataclasses import replace

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
)
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    make_transform,
    transform_from_pose,
)
from cliploc_ros.core.keyframes.features import DIMENSIONS
from cliploc_ros.core.keyframes.layer import KeyframeLayer, layer_path, save_layer
from cliploc_ros.core.map import map_file
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.offline.recording.layer_words import with_words

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
#: Looks along the map's z axis, not level: rotate room and pose first if a vertical matters.
MAP_FROM_CAMERA = transform_from_pose(np.array([0.3, -0.2, -0.5]),
                                      np.array([0.02, -0.05, 0.03, 0.99794]))


def unit_rows(rows):
    """Return the rows (n, d), each divided by its length."""
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def rigid(position=(0.0, 0.0, 0.0), axis='z', degrees=0.0):
    """Return a transform (4, 4): a turn about an axis, then a shift [m]."""
    return make_transform(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(),
                          np.array(position, dtype=float))


def level(x=0.0, y=0.0, yaw_deg=0.0, z=1.0):
    """Return the pose of a level camera; with yaw 0 it looks along the x axis."""
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return rigid((x, y, z), degrees=yaw_deg) @ make_transform(axes, np.zeros(3))


def map_of(class_ids, centers, semi_axes=0.2) -> LandmarkMap:
    """Return a map of upright objects; ids are thing_0, thing_1, ..., labels the classes."""
    count = len(centers)
    return LandmarkMap(
        'map', tuple(f'thing_{row}' for row in range(count)), tuple(class_ids), tuple(class_ids),
        np.array(centers, dtype=float), np.array(np.broadcast_to(semi_axes, (count, 3))),
        np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))


def make_room() -> LandmarkMap:
    """Return twelve objects of three classes, scattered in front of the camera."""
    rng, count = np.random.default_rng(7), 12
    quats = unit_rows(rng.normal(size=(count, 4)))
    return LandmarkMap(
        'map', tuple(f'thing_{i}' for i in range(count)),
        tuple(f'thing number {i}' for i in range(count)),
        tuple('abc'[i % 3] for i in range(count)),
        np.c_[rng.uniform(-2, 2, (count, 2)), rng.uniform(3, 6, count)],
        rng.uniform(0.05, 0.3, (count, 3)), quats)


def doubled_room(offset) -> LandmarkMap:
    """Return the room and a copy of it at an offset (3,) [m]."""
    return ROOM.with_more(replace(ROOM, centers=ROOM.centers + offset, landmark_ids=tuple(
        f'{landmark_id}_2' for landmark_id in ROOM.landmark_ids)))


def with_others(landmark_map: LandmarkMap, count: int) -> LandmarkMap:
    """Return the map with landmarks of another class far away, count in all."""
    count -= len(landmark_map)
    others = map_of(['far'] * count, np.random.default_rng(5).uniform(60, 90, (count, 3)))
    return landmark_map.with_more(replace(others, landmark_ids=tuple(
        f'far_{row}' for row in range(count))))


def boxes_of(landmarks: LandmarkMap, map_from_camera=MAP_FROM_CAMERA, camera=CAMERA):
    """Return the boxes (n, 4) of landmarks from a perfect detector; NaN behind the camera."""
    outlines = project_ellipsoids(invert_transform(map_from_camera), landmarks.centers,
                                  landmarks.shapes)
    return ellipse_bboxes(ellipses_in_pixels(outlines, camera))


def see_room(room: LandmarkMap, map_from_camera=MAP_FROM_CAMERA) -> Detections:
    """Return a perfect observation of the room, one box for each landmark in order."""
    return Detections(boxes_of(room, map_from_camera), room.class_ids, np.full(len(room), 0.9))


def with_boxes(seen: Detections, bboxes_xyxy, class_ids) -> Detections:
    """Return detections with further boxes (m, 4) of some classes."""
    return Detections(np.concatenate([seen.bboxes_xyxy, bboxes_xyxy]),
                      (*seen.class_ids, *class_ids), np.full(len(seen) + len(class_ids), 0.9))


ROOM = make_room()
SEEN = see_room(ROOM)
#: Options with which boxes need no similarities.
BY_CLASS = RelocalizerOptions(matching='class')


def observe(room: LandmarkMap, map_from_camera=MAP_FROM_CAMERA, rows=None, **known
            ) -> Observation:
    """Return a perfect observation of some landmarks, in the order of their rows."""
    seen = see_room(room, map_from_camera)
    rows = np.arange(len(room)) if rows is None else np.array(rows, dtype=np.int64)
    return Observation(CAMERA, seen.select(rows), **known)


def depth_image(room: LandmarkMap, map_from_camera, bboxes_xyxy):
    """Return depth (h, w) [m]: boxes (n, 4) at the near side of objects, and a wall at 8 m."""
    camera_from_map = invert_transform(map_from_camera)
    centers = room.centers @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    with np.errstate(invalid='ignore', divide='ignore'):
        pixels = CAMERA.fx * centers[:, :2] / centers[:, 2:] + (CAMERA.cx, CAMERA.cy)
    pixels[centers[:, 2] < 0.5] = np.inf
    near_m = centers[:, 2] - 0.6 * np.cbrt(room.semi_axes.prod(axis=1))
    seen = [(near_m[np.linalg.norm(pixels - (box[:2] + box[2:]) / 2, axis=1).argmin()],
             *np.maximum(box.astype(int), 0)) for box in bboxes_xyxy]
    depths_m = np.full((CAMERA.height, CAMERA.width), 8.0, dtype=np.float32)
    for depth_m, left, top, right, bottom in sorted(seen, reverse=True):
        depths_m[top:bottom, left:right] = depth_m
    return depths_m


def embeddings_of(landmark_ids, means, key='key') -> LandmarkEmbeddings:
    """Return image embeddings (L, d) of landmarks, without medoids."""
    return LandmarkEmbeddings(key, tuple(landmark_ids), means.astype(np.float16), np.empty(
        (0, means.shape[1]), np.float16), np.zeros(len(means) + 1, np.int64))


def make_layer(room: LandmarkMap, keyframes=6, points=40) -> KeyframeLayer:
    """Return keyframes with random points that no image shows."""
    rng, total = np.random.default_rng(0), keyframes * points
    descriptors = rng.integers(0, 120, (total, DIMENSIONS)).astype(np.uint8)
    return with_words(KeyframeLayer(
        room.frame_id, room.landmark_ids, room.centers.astype(np.float32), (CAMERA,),
        np.tile(np.eye(4), (keyframes, 1, 1)), np.arange(0, total + 1, points),
        rng.integers(0, 10_000, (total, 2)).astype(np.uint16),
        rng.normal(size=(total, 3)).astype(np.float32), descriptors,
        np.zeros(total, np.uint16), descriptors[:1]))


def write_map(room: LandmarkMap, path) -> None:
    """Write a map file."""
    landmarks = {
        landmark_id: {'label': room.labels[i], 'class_id': room.class_ids[i],
                      'center': room.centers[i].tolist(), 'semi_axes': room.semi_axes[i].tolist(),
                      'orientation': room.quats_xyzw[i].tolist()}
        for i, landmark_id in enumerate(room.landmark_ids)}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {
        'map': {'frame_id': room.frame_id, 'landmarks': landmarks} | (
            {'nav2_map': room.nav2_map} if room.nav2_map else {})}}}))


def write_bare_map(path, layer) -> None:
    """Write a map with keyframes only, and its layer, as build_map does."""
    map_file.write_map(path, LandmarkMap.empty(layer.frame_id), besides={
        layer_path(path): lambda place, digest: save_layer(place, replace(layer,
                                                                          set_digest=digest))})
