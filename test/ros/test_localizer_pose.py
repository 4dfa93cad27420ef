# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The localizer's pose of the camera at the stamp of an image, from its topic and odometry."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header
from test_odometry import (
    BASE_FROM_CAMERA,
    OPTICAL,
    RobotStateSource,
    message,
    odom_from_base,
    stamp,
    talk,
)

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.watch import LaterError, LocalizerPose, NoLocalizerPoseError

PARAMETERS = RelocalizerParameters(base_frame='base_link', base_from_camera=OPTICAL,
                                   tf_timeout_s=0.0, watch='amcl_pose')
MAP_FROM_BASE = make_transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.ones(3))


def shown(seconds, frame_id='/map', pose=MAP_FROM_BASE):
    return pose_with_covariance_msg(Header(frame_id=frame_id, stamp=stamp(seconds)), pose,
                                    np.eye(6))


@pytest.fixture
def robot(make_node):
    return RobotStateSource(make_node())


@pytest.fixture
def amcl(make_node):
    """A localizer that has not published a pose yet."""
    return make_node('amcl').create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)


@pytest.fixture
def localizer(robot, amcl, wait):
    found = LocalizerPose(robot._node, robot)
    wait(lambda: robot._node.count_publishers('/amcl_pose'), 'the localizer')
    return found


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
