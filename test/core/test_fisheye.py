# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated room seen through fisheyes: boxes by projecting surfaces, not by Camera."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer

SIZE = np.array([640, 480])
REQUESTS = 10


@pytest.fixture(scope='module')
def room():
    """Twenty-four upright objects of ten classes in a room of 6 x 5 m."""
    rng, count = np.random.default_rng(1), 24
    quats = Rotation.from_euler('z', rng.uniform(0, 360, (count, 1)), degrees=True).as_quat()
    return LandmarkMap(
        'map', tuple(f'thing {i}' for i in range(count)),
        tuple(f'label {i}' for i in range(count)),
        tuple('abcdefghij'[i % 10] for i in range(count)),
        rng.uniform((0, 0, 0.2), (6, 5, 1.8), (count, 3)), rng.uniform(0.06, 0.35, (count, 3)),
        quats)


def surfaces(room):
    """Points (L, 2000, 3) on the ellipsoids, by a spiral over each."""
    steps = np.arange(2000)
    z = 1.0 - (2 * steps + 1) / 2000
    turn = steps * np.pi * (3 - np.sqrt(5))
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    return np.array([Rotation.from_quat(quat).apply(sphere * axes) + center for center, axes, quat
                     in zip(room.centers, room.semi_axes, room.quats_xyzw, strict=True)])


def fisheye_pixels(points, focal_px, d):
    """OpenCV's equation: the radius is a polynomial of the angle to the axis."""
    across = np.linalg.norm(points[..., :2], axis=-1)
    angle = np.arctan2(across, points[..., 2])
    radius = angle * (1 + sum(one * angle**(2 * n) for n, one in enumerate(d, start=1)))
    return focal_px * points[..., :2] * (radius / across)[..., None] + SIZE / 2


def looks(room, focal_px, d, rng):
    """Yield requests from random places: a pose, and the boxes of what the image shows."""
    points = surfaces(room)
    for _ in range(REQUESTS):
        axes = Rotation.from_euler('ZXZ', rng.normal((0, -90, 0), (120, 8, 4)), degrees=True)
        pose = make_transform(axes.as_matrix(), rng.uniform((1, 1, 0.5), (5, 4, 1.2)))
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = fisheye_pixels(inside, focal_px, d)
        boxes = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
        cut = np.clip(boxes, 0, np.tile(SIZE, 2))
        shown = (cut[:, 2:] - cut[:, :2]).prod(axis=1) > 0.7 * (boxes[:, 2:] - boxes[:, :2]).prod(
            axis=1)
        rows = np.nonzero(shown & (np.linalg.norm(inside, axis=2).min(axis=1) > 0.2)
                          & ((cut[:, 2:] - cut[:, :2]).min(axis=1) > 8))[0]
        noisy = np.clip(cut[rows] + rng.normal(0, 1, (len(rows), 4)), 0, np.tile(SIZE, 2))
        yield pose, Detections(noisy, tuple(room.class_ids[row] for row in rows),
                               np.full(len(rows), 0.8))


@pytest.mark.parametrize(('wide_deg', 'd'), [
    (120.0, (0.0,) * 4), (190.0, (0.0,) * 4), (150.0, (-0.02, 0.01, -0.005, 0.001))])
def test_poses_of_a_fisheye_are_right(room, wide_deg, d):
    """Taken for pinholes, 10 of 10 images of an ideal fisheye were accepted .2 to .5 m off."""
    focal_px = SIZE[0] / np.radians(wide_deg)
    camera = Camera(*SIZE.tolist(), focal_px, focal_px, *(SIZE / 2), 'equidistant', d)
    relocalizer = Relocalizer(room, RelocalizerOptions(matching='class'))
    found = [(relocalizer.relocalize([Observation(camera, detections)]), pose)
             for pose, detections in looks(room, focal_px, d, np.random.default_rng(2))]
    accepted = [pose_error(one.map_from_camera, pose) for one, pose in found if one.accepted]
    assert len(accepted) >= 8
    assert max(distance_m for distance_m, _ in accepted) < 0.12
    assert max(angle_deg for _, angle_deg in accepted) < 3.0


def test_pixels_of_a_fisheye_are_rays_up_to_88_degrees_and_none_behind():
    angles = np.radians([1.0, 45.0, 80.0, 88.0, 91.0, 110.0])
    wide = Camera(1000, 1000, 200.0, 200.0, 500.0, 500.0, 'equidistant', (0.0,) * 4)
    for turn in np.radians([0.0, 37.0, 90.0, 200.0]):
        direction = np.array([np.cos(turn), np.sin(turn)])
        points = wide.normalize_points(500.0 + 200.0 * angles[:, None] * direction)
        np.testing.assert_allclose(points[:4], np.tan(angles[:4])[:, None] * direction, rtol=1e-4,
                                   atol=1e-9)
        assert np.isnan(points[4:]).all()
        np.testing.assert_allclose(wide.project_normalized(points[:4]),
                                   500.0 + 200.0 * angles[:4, None] * direction, atol=0.1)


def test_boxes_far_from_the_axis_of_a_fisheye_have_no_use():
    wide = Camera(1000, 1000, 200.0, 200.0, 500.0, 500.0, 'equidistant', (0.0,) * 4)
    at = 500.0 + 200.0 * np.radians([20.0, 60.0, 74.0, 76.0, 95.0])
    boxes = np.array([[at[0], 490, at[1], 510], [at[0], 490, at[2], 510],
                      [at[0], 490, at[3], 510], [at[2], 490, at[4], 510]])
    assert np.isfinite(wide.normalize_bboxes(boxes)).all(axis=1).tolist() == [
        True, True, False, False]
    straight = Camera(1000, 1000, 100.0, 100.0, 500.0, 500.0)
    assert np.isfinite(straight.normalize_bboxes(boxes)).all()
