# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError

NO_MOUNT = [0.0] * 7


@pytest.fixture
def ask(make_node):
    frame = CoordinateFrames(make_node())
    return lambda base, mount: frame.camera_from_base(base, mount, 'camera', Time(), 0.0)


def test_without_a_base_the_camera_itself_is_meant(ask):
    for mount in (NO_MOUNT, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]):
        np.testing.assert_array_equal(ask('', mount), np.eye(4))


def test_a_camera_ahead_of_the_base_has_the_base_behind(ask):
    np.testing.assert_allclose(ask('base_link', [0.2, 0.0, 1.5, 0.0, 0.0, 0.0, 1.0])[:, 3],
                               [-0.2, 0.0, -1.5, 1.0])


def test_an_optical_frame_in_numbers(ask):
    # z of the camera is ahead (x), x of it to the right (-y), y of it down (-z)
    camera_from_base = ask('base_link', [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5])
    np.testing.assert_allclose(camera_from_base, [[0, -1, 0, 0], [0, 0, -1, 1],
                                                  [1, 0, 0, -0.3], [0, 0, 0, 1]], atol=1e-12)


@given(st.lists(st.floats(-100.0, 100.0), min_size=3, max_size=3),
       st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(
           lambda q: np.linalg.norm(q) > 0.1))
def test_it_is_the_inverse_of_the_mount(position, quat_xyzw):
    mount = [*position, *(quat_xyzw / np.linalg.norm(quat_xyzw)).tolist()]
    # a mount needs no tf2, and so no node
    camera_from_base = CoordinateFrames(None).camera_from_base('base_link', mount, 'camera',
                                                               Time(), 0.0)
    base_from_camera = transform_from_pose(np.array(mount[:3]), np.array(mount[3:]))
    np.testing.assert_allclose(base_from_camera @ camera_from_base, np.eye(4), atol=1e-10)


def test_a_base_that_nobody_places_is_named_with_the_remedy(ask):
    # also where tf2_ros is not installed
    for _ in range(2):
        with pytest.raises(NoTransformError, match='set base_from_camera'):
            ask('base_link', NO_MOUNT)
