# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    move_covariance,
    pose_error,
    quaternion_from_transform,
    rotation_angle_deg,
    transform_from_pose,
)

numbers = st.floats(-3.0, 3.0)
transforms = st.builds(
    lambda position, turn: transform_from_pose(np.array(position),
                                               Rotation.from_rotvec(turn).as_quat()),
    st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers))


@given(transforms)
def test_inverse(a_from_b):
    assert a_from_b @ invert_transform(a_from_b) == pytest.approx(np.eye(4), abs=1e-12)


@given(transforms)
def test_quaternion_and_back(a_from_b):
    quat_xyzw = quaternion_from_transform(a_from_b)
    assert quat_xyzw[3] >= 0
    assert transform_from_pose(a_from_b[:3, 3], quat_xyzw) == pytest.approx(a_from_b, abs=1e-9)


def test_a_quarter_turn_about_z():
    turn = transform_from_pose(np.array([1.0, 2.0, 3.0]), np.array([0, 0, 0.5**0.5, 0.5**0.5]))
    assert turn @ (1.0, 0.0, 0.0, 1.0) == pytest.approx([1.0, 3.0, 3.0, 1.0])
    assert rotation_angle_deg(turn[:3, :3]) == pytest.approx(90.0)
    assert pose_error(turn, np.eye(4)) == pytest.approx((14**0.5, 90.0))


def test_moving_a_covariance_by_a_lever(rng):
    """The moved origin's covariance equals that of moved samples."""
    spread = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    lever = np.array([0.5, -1.0, 0.2])
    samples = rng.multivariate_normal(np.zeros(6), spread, 200_000)
    moved = samples.copy()
    moved[:, :3] += np.cross(samples[:, 3:], lever)
    assert move_covariance(spread, lever) == pytest.approx(np.cov(moved.T), abs=3e-4)
