# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real odometry messages: the camera's pose at an image, and the robot's speed."""

import threading
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from frames import stamp
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import make_transform, transform_from_pose
from cliploc_ros.ros.conversions import pose_to_msg, pose_with_covariance_msg
from cliploc_ros.ros.inputs import robot_state
from cliploc_ros.ros.inputs.robot_state import RobotStateSource
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.receivers import RunningLocalizer
from cliploc_ros.ros.watch import LaterError, LocalizerPose, NoLocalizerPoseError

OPTICAL = [0.3, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5]  # looks along the base's x axis
BASE_FROM_CAMERA = transform_from_pose(np.array(OPTICAL[:3]), np.array(OPTICAL[3:]))
PARAMETERS = RelocalizerParameters(base_frame='base_link', base_from_camera=OPTICAL,
                                   tf_timeout_s=0.0)


def odom_from_base(seconds):
    """A robot that turns at 20 degrees per second and drives at 0.1 m/s along x."""
    turn = Rotation.from_euler('z', 20.0 * seconds, degrees=True).as_matrix()
    return make_transform(turn, np.array([0.1 * seconds, 2.0, 0.0]))


def message(seconds, child_frame='base_link', frame='odom'):
    odometry = Odometry(header=Header(stamp=stamp(seconds), frame_id=frame),
                        child_frame_id=child_frame)
    odometry.pose.pose = pose_to_msg(odom_from_base(seconds))
    return odometry


@pytest.fixture
def robot(make_node):
    return RobotStateSource(make_node())


@pytest.fixture
def source(robot):
    return robot.odometry


def talk(source, *seconds, **frames):
    for moment in seconds:
        source.take(message(moment, **frames))


def place(robot, seconds, **values):
    image = Header(frame_id='camera', stamp=stamp(seconds))
    return robot.at(image, replace(PARAMETERS, **values)).place


def test_a_body_that_nobody_places_links_nothing_and_is_named_once(robot, source, capfd,
                                                                  monkeypatch):
    monkeypatch.setattr(robot_state, 'LOG_PERIOD_S', 0.0)  # log lines are not throttled
    talk(source, 10.0, child_frame='wheels')
    assert place(robot, 10.0) is None and place(robot, 10.0) is None
    said = capfd.readouterr().err
    assert said.count('localizing without odometry: ') == 1
    assert find_spec('tf2_ros') or 'set base_frame to wheels, and base_from_camera' in said


def test_an_image_waits_for_the_message_after_it(robot, source):
    talk(source, 10.0)
    late = threading.Timer(0.05, talk, (source, 10.1))
    late.start()
    np.testing.assert_allclose(place(robot, 10.03).odom_from_frame,
                               odom_from_base(10.03) @ BASE_FROM_CAMERA, atol=1e-9)
    late.join()


@pytest.mark.parametrize('frames', [{'frame': 'other'}, {'child_frame': 'camera'}])
def test_places_in_two_odometry_frames_do_not_compare(robot, source, frames):
    talk(source, 9.9, 10.0)
    first = place(robot, 9.95)
    assert place(robot, 9.96).run == first.run
    talk(source, 10.1, 10.2, **frames)
    assert place(robot, 10.15).run != first.run and place(robot, 9.95) is None


@pytest.mark.parametrize(('moments_s', 'moved'), [
    ((10.1, 10.2), {'x': -100.0}),
    ((13.0, 13.1), {'y': 0.6})])  # 1.4 m away and turned, after a silence
def test_an_origin_that_is_reset_is_a_restart_and_reported_once(robot, source, moments_s, moved):
    stamps_ns = []
    source.on_restart(stamps_ns.append)
    talk(source, *np.arange(9.5, 10.05, 0.1))
    run = place(robot, 10.0).run
    for moment in moments_s:
        restarted = message(moment)
        for axis, metres in moved.items():
            setattr(restarted.pose.pose.position, axis, metres)
        source.take(restarted)
    assert stamps_ns == [round(moments_s[0] * 1e9)]
    assert place(robot, sum(moments_s) / 2).run != run


def test_odometry_that_goes_on_is_no_restart_and_invalid_messages_change_nothing(robot, source):
    restarts = []
    source.on_restart(restarts.append)
    talk(source, 9.9, 10.1, 10.0)  # one of them late
    run = place(robot, 9.95).run
    for number, (x_m, w) in enumerate(((np.nan, 1.0), (1e300, 1.0), (1.0, 2.0), (1.0, np.nan))):
        broken = message(10.04 + 0.01 * number)
        broken.pose.pose.position.x, broken.pose.pose.orientation = x_m, Quaternion(w=w)
        source.take(broken)
    talk(source, 10.2)
    np.testing.assert_allclose(place(robot, 10.03).odom_from_frame,
                               odom_from_base(10.03) @ BASE_FROM_CAMERA, atol=1e-9)
    assert place(robot, 10.03).run == run
    talk(source, 13.0)
    for moment in (9.0, 11.0, 13.5):  # before, in a gap, after
        assert place(robot, moment) is None
    assert source.recent(1.0, 1.0).header.stamp == stamp(13.0)
    source.forget()
    talk(source, 2.0)
    assert not restarts, 'a jump of the clock is reported by TimeJumps'


@pytest.mark.parametrize('moments', [
    np.arange(9.5, 10.05, 0.05), [9.6, 10.0], [9.0, 10.0], [9.7, 9.8, 10.8], [7.0, 10.0]])
def test_poses_give_the_mean_speed_where_the_twist_is_empty(source, moments):
    talk(source, *moments)
    assert source.speeds_by_poses(0.0) == (pytest.approx(0.1), pytest.approx(np.radians(20.0)))


# ---- the pose of the localizer, carried by odometry ---------------------------------------------
MAP_FROM_BASE = make_transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.ones(3))


def shown(seconds, frame_id='/map', pose=MAP_FROM_BASE):
    return pose_with_covariance_msg(Header(frame_id=frame_id, stamp=stamp(seconds)), pose,
                                    np.eye(6))


@pytest.fixture
def amcl(make_node):
    """A localizer that has not published a pose yet."""
    return make_node('amcl').create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)


@pytest.fixture
def localizer(robot, amcl, wait):
    running = RunningLocalizer(robot._node, robot.transforms)
    running.open(replace(PARAMETERS, localizer_pose='amcl_pose'))
    wait(lambda: not running.find(), 'the localizer')
    return LocalizerPose(robot._node, robot, running)


def at(localizer, robot, seconds, frame_ids=('other', 'map')):
    image = Header(frame_id='camera', stamp=stamp(seconds))
    return localizer.at(image, robot.at(image, PARAMETERS), PARAMETERS, frame_ids)


def test_without_odometry_a_pose_holds_for_half_a_second(localizer, robot):
    localizer.hear(shown(10.0))
    for seconds in (10.51, 9.49):
        with pytest.raises(NoLocalizerPoseError):
            at(localizer, robot, seconds)
    for seconds in (10.49, 9.51):
        frame_id, pose = at(localizer, robot, seconds)
        assert frame_id == 'map'
        np.testing.assert_allclose(pose, MAP_FROM_BASE @ BASE_FROM_CAMERA, atol=1e-9)


def test_odometry_carries_the_pose_on(localizer, robot):
    talk(robot.odometry, *np.arange(9.0, 14.05, 0.1))
    localizer.hear(shown(10.0))
    for seconds in (10.0, 12.0, 9.5):
        moved = np.linalg.inv(odom_from_base(10.0)) @ odom_from_base(seconds)
        np.testing.assert_allclose(at(localizer, robot, seconds)[1],
                                   MAP_FROM_BASE @ moved @ BASE_FROM_CAMERA, atol=1e-6)
    localizer.hear(shown(13.0))
    np.testing.assert_allclose(at(localizer, robot, 13.0)[1], MAP_FROM_BASE @ BASE_FROM_CAMERA,
                               atol=1e-6)


def test_a_pose_from_before_odometry_waits_for_the_next_one(localizer, robot):
    talk(robot.odometry, *np.arange(9.0, 10.05, 0.1))
    localizer.hear(shown(5.0))
    with pytest.raises(LaterError):
        at(localizer, robot, 10.0)


def test_a_localizer_that_says_nothing_for_two_metres_is_silent(localizer, robot):
    localizer.hear(shown(10.0))
    for tick in range(22):
        one = message(10.0 + 0.1 * tick)
        one.pose.pose.position.x, one.pose.pose.orientation.z = 0.1 * tick, 0.0
        one.pose.pose.orientation.w = 1.0
        robot.odometry.take(one)
    assert at(localizer, robot, 11.9)[0] == 'map'
    with pytest.raises(NoLocalizerPoseError):
        at(localizer, robot, 12.1)


def test_what_is_no_pose_of_one_localizer_is_refused(localizer, robot, make_node, wait):
    def is_refused(msg=None, **given):
        if msg is not None:
            localizer.hear(msg)
        with pytest.raises(NoLocalizerPoseError):
            at(localizer, robot, 10.0, **given)
    is_refused()  # none was published
    broken = shown(10.0)
    broken.pose.pose.orientation.w = np.nan
    is_refused(broken)
    is_refused(shown(10.0, 'odom'))
    localizer.hear(shown(10.0))
    at(localizer, robot, 10.0)
    is_refused(frame_ids=('other',))
    localizer.forget()
    is_refused()
    localizer.hear(shown(10.0))
    make_node('other').create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)
    wait(lambda: robot._node.count_publishers('/amcl_pose') == 2, 'the second localizer')
    is_refused()
