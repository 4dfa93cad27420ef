# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated walk around a table of known ellipsoids, with a perfect detector."""

from dataclasses import replace

import numpy as np
from scene import CAMERA, boxes_of, map_of
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.options import PoseErrors
from cliploc_ros.offline.mapping.posed_detections import PosedDetections

CLASSES = ('book', 'bottle', 'cup')


def make_table(count=9) -> LandmarkMap:
    """Return ellipsoids of three classes, at least 40 cm apart, around the origin."""
    rng = np.random.default_rng(3)
    places = [(0.5 * x, 0.5 * y) for x in (-1, 0, 1) for y in (-1, 0, 1)][:count]
    centers = np.c_[np.array(places), np.full(count, 0.8)] + rng.uniform(-0.05, 0.05, (count, 3))
    quats = Rotation.from_euler('z', rng.uniform(0, np.pi, (count, 1))).as_quat()
    return replace(map_of([CLASSES[row % 3] for row in range(count)], centers,
                          rng.uniform(0.06, 0.15, (count, 3))), quats_xyzw=quats)


def join_maps(joined: LandmarkMap, *maps: LandmarkMap) -> LandmarkMap:
    """Join the landmarks of several maps; ids get a mark from the second map on."""
    for number, one in enumerate(maps, start=1):
        joined = joined.with_more(replace(one, landmark_ids=tuple(
            name + '_b' * number for name in one.landmark_ids)))
    return joined


def moved(table: LandmarkMap, places) -> LandmarkMap:
    """Return the map with some landmarks at other places: {row: (x, y, z)}."""
    centers = table.centers.copy()
    for row, place in places.items():
        centers[row] = place
    return replace(table, centers=centers)


def without(table: LandmarkMap, *rows) -> LandmarkMap:
    """Return the map without some landmarks."""
    return table.select([row for row in range(len(table)) if row not in rows])


def look_at(position, target=(0.0, 0.0, 0.8)):
    """Return map_from_camera of an upright camera that looks at a point."""
    forward = np.asarray(target) - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return make_transform(np.stack([right, np.cross(forward, right), forward], axis=1),
                          np.asarray(position, dtype=float))


def walk_around(frames=60, turn_deg=300.0, radius=2.2):
    """Return poses (F, 4, 4) on an arc around the table, at varying height."""
    angles = np.radians(np.linspace(0.0, turn_deg, frames))
    return np.array([look_at(np.array([radius * np.cos(a), radius * np.sin(a),
                                       1.5 + 0.3 * np.sin(2 * a)])) for a in angles])


def see(table: LandmarkMap, poses, noise_px=0.0, missed=0.0, seed=0) -> PosedDetections:
    """Return simulated detections: boxes with noise, clipped to the image; some are missed."""
    return see_rows(table, poses, noise_px, missed, seed)[0]


def see_rows(table: LandmarkMap, poses, noise_px=0.0, missed=0.0, seed=0, camera=CAMERA):
    """Return simulated detections, and the row of the landmark in each box."""
    rng = np.random.default_rng(seed)
    size = np.array([camera.width, camera.height] * 2, dtype=float)
    rows, boxes, counts = [], [], [0]
    for pose in poses:
        full = boxes_of(table, pose, camera)
        full = full + rng.normal(scale=noise_px, size=full.shape) if noise_px else full
        clipped = np.clip(full, 0.0, size)
        seen = (clipped[:, 2:] - clipped[:, :2] > 8.0).all(axis=1)
        seen &= rng.random(len(seen)) >= missed
        boxes.append(clipped[seen])
        rows.append(np.nonzero(seen)[0])
        counts.append(int(seen.sum()))
    bboxes, shown = np.concatenate(boxes), np.concatenate(rows)
    classes = np.array([CLASSES.index(name) for name in table.class_ids], dtype=np.int64)
    return PosedDetections(
        (camera,), np.asarray(poses), 0.2 * np.arange(len(poses)), np.cumsum(counts), bboxes,
        CLASSES, classes[shown], np.full(len(bboxes), 0.9)), shown


def merged(*parts: PosedDetections) -> PosedDetections:
    """Return the boxes of several recordings of the same frames."""
    frames = np.concatenate([part.frames for part in parts])
    order = np.argsort(frames, kind='stable')
    return replace(
        parts[0], frame_offsets=np.searchsorted(frames[order], np.arange(len(parts[0]) + 1)),
        **{name: np.concatenate([getattr(part, name) for part in parts])[order]
           for name in ('bboxes_xyxy', 'classes', 'scores')})


def measure_depth(detections, table, scale=1.0, holes=0.0):
    """Add the depth of the ellipsoid's surface in each box, with errors."""
    rng = np.random.default_rng(0)
    depths = np.full(len(detections.classes), np.nan, dtype=np.float32)
    for row, frame in enumerate(detections.frames):
        camera, pose = detections.camera_of(frame), detections.map_from_camera[frame]
        ahead = (table.centers - pose[:3, 3]) @ pose[:3, :3]
        pixels = ahead[:, :2] / ahead[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        box = detections.bboxes_xyxy[row]
        away = np.linalg.norm(pixels - 0.5 * (box[:2] + box[2:]), axis=1)
        nearest = (away + 1e6 * (ahead[:, 2] < 0.0)).argmin()
        if rng.random() >= holes:
            surface = ahead[nearest, 2] - 0.6 * table.semi_axes[nearest].mean()
            depths[row] = scale * surface * rng.normal(1.0, 0.02)
    return replace(detections, depths=depths, depth_spreads=np.full_like(depths, 0.02))


def nearest_errors(built: LandmarkMap, table: LandmarkMap):
    """Return the distance [m] from each true landmark to the nearest built one of its class."""
    errors = []
    for center, name in zip(table.centers, table.class_ids, strict=True):
        same = np.array([class_id == name for class_id in built.class_ids])
        errors.append(np.linalg.norm(built.centers[same] - center, axis=1).min(initial=np.inf))
    return np.array(errors)


def shape_error_m(built: LandmarkMap, table: LandmarkMap):
    """Return the mean error of distances between landmarks, wherever the map lies [m]."""
    rows = [np.linalg.norm(built.centers - center, axis=1).argmin() for center in table.centers]
    found, true = (np.linalg.norm(centers[:, None] - centers[None], axis=2)
                   for centers in (built.centers[rows], table.centers))
    return float(np.abs(found - true).mean())


def draw_errors(stamps_s, errors: PoseErrors, seed=1):
    """Return errors (F, 6) of poses: x, y, z [m], rotation vector [rad]."""
    drawn = np.random.default_rng(seed).normal(size=(len(stamps_s), 6))
    for frame, step_s in enumerate(np.diff(stamps_s), start=1):
        kept = np.exp(-step_s / errors.correlation_s) if errors.correlation_s else 0.0
        drawn[frame] = kept * drawn[frame - 1] + np.sqrt(1.0 - kept ** 2) * drawn[frame]
    return drawn * errors.sigmas


def disturb(detections: PosedDetections, errors) -> PosedDetections:
    """Return the detections with errors (F, 6) added to their poses, in the map's axes."""
    poses = detections.map_from_camera.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += errors[:, :3]
    return detections.with_poses(poses)
