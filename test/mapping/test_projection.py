# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The box of an ellipsoid and its derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids, shape_matrices
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.offline.mapping.landmarks import (
    box_iou,
    linearize_box,
    move_ellipsoid,
    project_box,
)

SEMI_AXES = np.array([0.3, 0.1, 0.2])
ROTATION = Rotation.from_rotvec([0.3, -0.5, 0.8])
BASIS = ROTATION.as_matrix() * SEMI_AXES
CENTER = np.array([0.4, -0.3, 0.2])
CAMERA_FROM_MAP = make_transform(Rotation.from_rotvec([0.2, 0.4, -0.3]).as_matrix(),
                                 np.array([0.1, 0.2, 2.0]))


def box_at(center, basis, camera_from_map=CAMERA_FROM_MAP):
    box = np.empty(4)
    assert project_box(camera_from_map[:3, :3].copy(), camera_from_map[:3, 3].copy(), center,
                       basis, box)
    return box


def test_box_is_that_of_the_core():
    shapes = shape_matrices(SEMI_AXES[None], ROTATION.as_quat()[None])
    expected = ellipse_bboxes(project_ellipsoids(CAMERA_FROM_MAP, CENTER[None], shapes))[0]
    assert box_at(CENTER, BASIS) == pytest.approx(expected, abs=1e-12)


def test_ellipsoid_around_the_camera_has_no_box():
    box = np.empty(4)
    assert not project_box(np.eye(3), np.zeros(3), np.array([0.0, 0.0, 0.5]), np.eye(3), box)
    assert not project_box(np.eye(3), np.zeros(3), np.array([0.0, 0.0, -5.0]), np.eye(3), box)


def test_derivatives_are_those_of_small_steps():
    rotation, translation = CAMERA_FROM_MAP[:3, :3].copy(), CAMERA_FROM_MAP[:3, 3].copy()
    box, by_landmark, by_pose = np.empty(4), np.empty((4, 9)), np.empty((4, 6))
    assert linearize_box(rotation, translation, CENTER, BASIS, box, by_landmark, by_pose)

    def box_after(step):
        """Return the box after a step of the landmark (9,) and the pose (6,)."""
        center, basis = np.empty(3), np.empty((3, 3))
        move_ellipsoid(CENTER, BASIS, step[:9], center, basis)
        motion = make_transform(Rotation.from_rotvec(step[12:]).as_matrix(), step[9:12])
        return box_at(center, basis, motion @ CAMERA_FROM_MAP)

    for step, expected in zip(1e-6 * np.eye(15), np.hstack([by_landmark, by_pose]).T, strict=True):
        assert (box_after(step) - box_after(-step)) / 2e-6 == pytest.approx(expected, abs=1e-7)


def test_iou_counts_only_what_lies_in_the_image():
    bounds = np.array([-1.0, -1.0, 1.0, 1.0])
    outside = np.array([0.0, 0.0, 3.0, 1.0])
    assert box_iou(outside, np.array([0.0, 0.0, 1.0, 1.0]), bounds) == pytest.approx(1.0)
    assert box_iou(outside, np.array([-1.0, 0.0, 0.0, 1.0]), bounds) == 0.0
    assert box_iou(np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.5, 0.0, 1.0, 0.5]),
                   bounds) == pytest.approx(0.25)
