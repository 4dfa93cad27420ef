# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera was, as messages of odometry tell it."""

import threading
import time

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import make_transform, transform_from_pose
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import pose_to_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.inputs.odometry_window import NoOdometryError

OPTICAL = [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]  # looks along the base's x axis
BASE_FROM_CAMERA = transform_from_pose(np.array(OPTICAL[:3]), np.array(OPTICAL[3:]))
VALUES = {'base_frame': 'base_link', 'tf_timeout_s': 0.0}


def stamp(seconds):
    return Time(sec=int(seconds), nanosec=round((seconds % 1) * 1e9))


def odom_from_base(seconds):
    """A robot that turns by 20 degrees a second and drives 0.1 m/s along x."""
    turn = Rotation.from_euler('z', 20.0 * seconds, degrees=True).as_matrix()
    return make_transform(turn, np.array([0.1 * seconds, 2.0, 0.0]))


def message(seconds, child_frame='base_link', frame='odom'):
    odometry = Odometry(header=Header(stamp=stamp(seconds), frame_id=frame),
                        child_frame_id=child_frame)
    odometry.pose.pose = pose_to_msg(odom_from_base(seconds))
    return odometry


@pytest.fixture
def source(make_node):
    node = make_node()
    return OdometrySource(node, CoordinateFrames(node))


def talk(source, *seconds, **frames):
    for moment in seconds:
        source.take(message(moment, **frames))


def place(source, seconds):
    return source.camera_place(VALUES, np.linalg.inv(BASE_FROM_CAMERA), 'camera', stamp(seconds))


def test_the_camera_is_where_its_mount_has_it(source):
    talk(source, 9.9, 10.0, 10.1)
    np.testing.assert_allclose(place(source, 10.05).odom_from_camera,
                               odom_from_base(10.05) @ BASE_FROM_CAMERA, atol=1e-9)


def test_odometry_of_the_camera_needs_no_mount(source):
    talk(source, 10.0, child_frame='camera')
    np.testing.assert_allclose(place(source, 10.0).odom_from_camera, odom_from_base(10.0),
                               atol=1e-9)


@pytest.mark.parametrize(('body', 'named'), [('wheels', r'wheels|tf2_ros'),
                                             ('', 'no child_frame_id')])
def test_a_body_that_nobody_places_is_an_error(source, body, named):
    talk(source, 10.0, child_frame=body)
    with pytest.raises(CliplocError, match=named):
        place(source, 10.0)


def test_the_message_after_the_image_is_waited_for(source):
    talk(source, 10.0)
    late = threading.Timer(0.05, talk, (source, 10.1))
    late.start()
    np.testing.assert_allclose(place(source, 10.05).odom_from_camera,
                               odom_from_base(10.05) @ BASE_FROM_CAMERA, atol=1e-9)
    late.join()


@pytest.mark.parametrize('moments', [[], [10.0], [12.0], [1.0]])
def test_no_time_is_lost_where_odometry_says_nothing(source, moments):
    talk(source, *moments)
    start = time.monotonic()
    with pytest.raises(NoOdometryError):
        place(source, 10.3)
    assert time.monotonic() - start < 0.5
    assert source.follows(stamp(10.3)) == (moments in ([10.0], [12.0]))
    assert source.recent(5.0) is (source._newest if moments else None)


@pytest.mark.parametrize('frames', [{'frame': 'other'}, {'child_frame': 'camera'}])
def test_places_of_two_frames_have_nothing_in_common(source, frames):
    talk(source, 9.9, 10.0)
    first = place(source, 9.95)
    assert place(source, 9.96).run == first.run
    talk(source, 10.1, 10.2, **frames)
    assert place(source, 10.15).run != first.run
    with pytest.raises(NoOdometryError):
        place(source, 9.95)


def test_a_message_that_is_none_changes_nothing(source):
    talk(source, 9.9, 10.0)
    first = place(source, 9.95)
    broken = message(10.05)
    broken.pose.pose.position.x = float('nan')
    source.take(broken)
    talk(source, 10.1)
    np.testing.assert_allclose(place(source, 10.05).odom_from_camera,
                               odom_from_base(10.05) @ BASE_FROM_CAMERA, atol=1e-9)
    assert place(source, 10.05).run == first.run
    assert source.recent(1.0).header.stamp == stamp(10.1)


def test_it_listens_only_while_it_is_asked(source, make_node, spin_until):
    talker = make_node('wheels')
    publisher = talker.create_publisher(Odometry, 'odom', 10)
    with source.listening(), source.listening():
        spin_until([talker, source._node], lambda: len(source._window), 'a message',
                   work=lambda: publisher.publish(message(10.0)))
        run = place(source, 10.0).run
        assert publisher.get_subscription_count() == 1
    assert source._subscription is None and source.recent(0.0) is None
    talk(source, 10.0)
    assert place(source, 10.0).run != run, 'nobody knows what happened in between'


def test_poses_tell_how_fast_the_robot_is_where_the_twist_is_empty(source):
    talk(source, *np.arange(9.5, 10.05, 0.05))
    assert source.speeds_by_poses() == (pytest.approx(0.1), pytest.approx(np.radians(20.0)))


@pytest.mark.parametrize('moments', [[], [10.0], [9.9, 10.0], [9.0, 10.0]])
def test_too_few_poses_tell_no_speed(source, moments):
    talk(source, *moments)
    start = time.monotonic()
    assert source.speeds_by_poses() == (0.0, 0.0)
    assert time.monotonic() - start < 3.0
