# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The vertical from the base and from the IMU."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Vector3
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.robot_state import NoVerticalError, VerticalSource
from cliploc_ros.ros.parameters import RelocalizerParameters

OPTICAL = [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]  # looks along the base's x axis
CAMERA_FROM_BASE = np.linalg.inv(transform_from_pose(np.array(OPTICAL[:3]), np.array(OPTICAL[3:])))
AT = Time(sec=50)
NOT_MEASURED = [-1.0] + 8 * [0.0]


def imu(acceleration=(0.0, 0.0, 9.81), quat_xyzw=None, frame_id='base_link', seconds=50.0):
    orientation = Quaternion() if quat_xyzw is None else Quaternion(
        **dict(zip('xyzw', map(float, quat_xyzw), strict=True)))
    stamp = Time(sec=int(seconds), nanosec=round((seconds % 1) * 1e9))
    return Imu(header=Header(stamp=stamp, frame_id=frame_id), orientation=orientation,
               orientation_covariance=NOT_MEASURED if quat_xyzw is None else [0.0] * 9,
               linear_acceleration=Vector3(**dict(zip('xyz', acceleration, strict=True))))


def parameters(gravity='imu', base_frame='base_link'):
    return RelocalizerParameters(gravity=gravity, base_frame=base_frame, tf_timeout_s=0.0)


@pytest.fixture
def source(make_node):
    node = make_node()
    return VerticalSource(node, CoordinateFrames(node))


def up(source, **changes):
    return source.up_in_camera(parameters(**changes), CAMERA_FROM_BASE, 'camera', AT)


def test_an_accelerometer_at_rest_points_up(source):
    for number in range(10):  # half of them too old to count
        source.take(imu((0.0 if number > 4 else 5.0, 0.0, 9.81), seconds=49.55 + 0.05 * number))
    for gravity in ('imu', 'base_frame'):
        np.testing.assert_allclose(up(source, gravity=gravity), [0, -1, 0], atol=1e-12)


def test_a_sample_out_of_order_costs_nothing_and_a_jump_back_all_samples(source):
    for seconds in (50.0, 49.99, 50.01):
        source.take(imu(seconds=seconds))
    assert len(source._samples) == 3
    source.take(imu(seconds=48.0))
    assert len(source._samples) == 1


TILT = Rotation.from_euler('xyz', [5.0, -8.0, 30.0], degrees=True)
GRAVITY = tuple(9.81 * TILT.inv().apply([0, 0, 1]))
TILTED_UP = CAMERA_FROM_BASE[:3, :3] @ TILT.inv().apply([0, 0, 1])


@pytest.mark.parametrize(('acceleration', 'quat_xyzw', 'covariance', 'expected'), [
    (GRAVITY, TILT.as_quat(), 0.0, TILTED_UP),
    ((3.0, 0.0, 11.0), TILT.as_quat(), 0.0, TILTED_UP),  # of a robot that moves
    ((0.0, 0.0, 0.0), TILT.as_quat(), 0.0, TILTED_UP),  # not filled
    # 3 degrees off: a cheap accelerometer
    ((GRAVITY[0] + 0.5, *GRAVITY[1:]), TILT.as_quat(), 0.0, TILTED_UP),
    # rclcpp, rclpy and every driver that fills only the acceleration send w = 1
    (GRAVITY, (0, 0, 0, 1), 0.0, TILTED_UP),
    # a simulator without noise
    ((0.0, 0.0, 9.81), (0, 0, 0, 1), 1e-6, (0, -1, 0))])
def test_an_orientation_counts_more_than_an_acceleration_but_not_a_default_one(
        source, acceleration, quat_xyzw, covariance, expected):
    msg = imu(acceleration, quat_xyzw)
    msg.orientation_covariance[0] = covariance
    source.take(msg)
    np.testing.assert_allclose(up(source), expected, atol=1e-12)


@pytest.mark.parametrize(('quat_xyzw', 'acceleration', 'named'), [
    ((0, 0, 0, 1), GRAVITY, ' 9 degrees'),  # a constant one, with a covariance
    ((1, 0, 0, 0), (0.0, 0.0, 9.81), '180 degrees')])  # NED in place of ENU
def test_an_orientation_that_contradicts_gravity_is_refused(source, quat_xyzw, acceleration,
                                                            named):
    msg = imu(acceleration, quat_xyzw)
    msg.orientation_covariance[0] = 1e-4
    source.take(msg)
    with pytest.raises(NoVerticalError, match=named):
        up(source)


def test_a_wrong_orientation_stays_refused_when_the_robot_starts(source):
    """It was detected at rest; now the accelerometer cannot show it."""
    wrong = Rotation.from_euler('y', 60, degrees=True).as_quat()
    for number in range(20):
        acceleration = (0.0, 0.0, 9.81) if number < 15 else (4.0, 0.0, 9.81)
        source.take(imu(acceleration, wrong, seconds=48.1 + 0.1 * number))
    with pytest.raises(NoVerticalError, match='60 degrees'):
        up(source)


@pytest.mark.parametrize(('messages', 'named'), [
    ([imu(frame_id='')], 'no frame_id'), ([imu((0.0, 0.0, 11.0))], r'11\.00 m/s'),
    ([imu((0.0, 0.0, 0.0))], 'neither an'),
    ([imu(quat_xyzw=Rotation.from_euler('y', angle, degrees=True).as_quat(), seconds=seconds,
          acceleration=(0.0, 0.0, 0.0)) for angle, seconds in ((-40, 49.95), (40, 50.05))],
     'turns too fast'),
    ([imu(seconds=50.0), imu(seconds=10.0)], 'no message on /imu')])
def test_what_is_not_known_is_said(source, messages, named):
    for msg in messages:
        source.take(msg)
    with pytest.raises(NoVerticalError, match=named):
        up(source)


def test_it_listens_from_open_to_close(source, make_node, spin_until):
    talker = make_node('imu_driver')
    publisher = talker.create_publisher(Imu, 'imu', 10)
    source.open('base_frame')
    for _ in range(2):  # opening it twice has no effect
        source.open('imu')
    spin_until([talker, source._node], lambda: len(source._samples),
               'a message', work=lambda: publisher.publish(imu()))
    np.testing.assert_allclose(up(source), [0, -1, 0], atol=1e-12)
    assert publisher.get_subscription_count() == 1
    source.close()
    assert not source._samples
    with pytest.raises(NoVerticalError, match='no message on /imu'):
        up(source)
