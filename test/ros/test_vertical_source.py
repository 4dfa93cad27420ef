# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The vertical as base and IMU tell it."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Vector3
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.inputs.coordinate_frames import BaseFrame
from cliploc_ros.ros.inputs.vertical import NoVerticalError, VerticalSource, sample_from_msg

OPTICAL = [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]  # looks along the base's x axis
CAMERA_FROM_BASE = np.linalg.inv(transform_from_pose(np.array(OPTICAL[:3]),
                                                     np.array(OPTICAL[3:])))
AT = Time(sec=50)
NOT_MEASURED = [-1.0] + 8 * [0.0]


def imu(acceleration=(0.0, 0.0, 9.81), quat_xyzw=None, frame_id='base_link', seconds=50.0):
    orientation = Quaternion() if quat_xyzw is None else Quaternion(
        **dict(zip('xyzw', map(float, quat_xyzw), strict=True)))
    stamp = Time(sec=int(seconds), nanosec=round((seconds % 1) * 1e9))
    return Imu(header=Header(stamp=stamp, frame_id=frame_id), orientation=orientation,
               orientation_covariance=NOT_MEASURED if quat_xyzw is None else [0.0] * 9,
               linear_acceleration=Vector3(**dict(zip('xyz', acceleration, strict=True))))


def values(gravity='imu', base_frame='base_link'):
    return {'gravity': gravity, 'base_frame': base_frame, 'tf_timeout_s': 0.0}


@pytest.fixture
def source(make_node):
    node = make_node()
    return VerticalSource(node, BaseFrame(node))


def up(source, **changes):
    return source.up_in_camera(values(**changes), CAMERA_FROM_BASE, 'camera', AT)


def test_nobody_asks_for_it(source):
    assert up(source, gravity='none') is None


def test_a_base_stands_upright(source):
    np.testing.assert_allclose(up(source, gravity='base_frame'), [0, -1, 0], atol=1e-12)


def test_an_accelerometer_at_rest_points_up(source):
    for number in range(10):  # half of them too old to count
        tilt = 0.0 if number > 4 else 5.0
        source.take(imu((tilt, 0.0, 9.81), seconds=49.55 + 0.05 * number))
    np.testing.assert_allclose(up(source), [0, -1, 0], atol=1e-12)


def test_an_orientation_counts_more_than_an_acceleration(source):
    tilt = Rotation.from_euler('xyz', [5.0, -8.0, 30.0], degrees=True)
    source.take(imu((3.0, 0.0, 9.0), tilt.as_quat()))
    expected = CAMERA_FROM_BASE[:3, :3] @ tilt.inv().apply([0, 0, 1])
    np.testing.assert_allclose(up(source), expected, atol=1e-12)


def test_an_imu_in_the_camera_needs_no_transform(source):
    source.take(imu((0.0, -9.81, 0.0), frame_id='camera'))
    np.testing.assert_allclose(up(source), [0, -1, 0], atol=1e-12)


def test_an_imu_that_nobody_places_is_an_error(source):
    source.take(imu(frame_id='mast'))
    with pytest.raises(CliplocError, match=r'mast|tf2_ros'):
        up(source)


@pytest.mark.parametrize(('messages', 'named'), [
    ([], 'no usable message of /imu'),
    ([imu(seconds=51.0)], 'within 100 ms'),
    ([imu(frame_id='')], 'no frame_id'),
    ([imu((0.0, 0.0, 11.0))], 'being moved: it measures 11.00'),
    ([imu((0.0, 0.0, 0.0))], 'being moved'),
    ([imu((float('nan'), 0.0, 9.81))], 'no usable message'),
    ([imu(seconds=50.0), imu(seconds=10.0)], 'no usable message'),  # time jumped back
])
def test_what_is_not_known_is_said(source, messages, named):
    for msg in messages:
        source.take(msg)
    with pytest.raises(NoVerticalError, match=named):
        up(source)


def test_fields_that_are_not_measured_say_nothing():
    msg = imu()
    msg.linear_acceleration_covariance = NOT_MEASURED
    assert sample_from_msg(msg) is None
    assert sample_from_msg(imu(quat_xyzw=(0, 0, 0, 0))).is_acceleration  # no quaternion at all


def test_it_listens_only_while_it_is_asked(source, make_node, spin_until):
    talker = make_node('imu_driver')
    publisher = talker.create_publisher(Imu, 'imu', 10)
    with source.listening('base_frame'):
        assert source._subscription is None
    with source.listening('imu'), source.listening('imu'):
        spin_until([talker, source._node], lambda: len(source._samples),
                   'a message', work=lambda: publisher.publish(imu()))
        np.testing.assert_allclose(up(source), [0, -1, 0], atol=1e-12)
    assert source._subscription is None and not source._samples
