# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from builtin_interfaces.msg import Time

from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError

NO_MOUNT = [0.0] * 7


@pytest.fixture
def ask(make_node):
    frame = CoordinateFrames(make_node())
    return lambda base, mount: frame.camera_from_base(base, mount, 'camera', Time(), 0.0)


def test_without_a_base_the_camera_itself_is_meant(ask):
    for mount in (NO_MOUNT, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]):
        np.testing.assert_array_equal(ask('', mount), np.eye(4))


def test_an_optical_frame_in_numbers(ask):
    # the camera's z is ahead (x), its x to the right (-y), its y down (-z)
    camera_from_base = ask('base_link', [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5])
    np.testing.assert_allclose(camera_from_base, [[0, -1, 0, 0], [0, 0, -1, 1],
                                                  [1, 0, 0, -0.3], [0, 0, 0, 1]], atol=1e-12)


def test_a_base_that_nobody_places_is_named_with_the_remedy(ask):
    # also if tf2_ros is not installed
    for _ in range(2):
        with pytest.raises(NoTransformError, match='base_from_camera'):
            ask('base_link', NO_MOUNT)
