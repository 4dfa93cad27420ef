# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose is handed over only while odometry shows that the robot has not moved since its image."""

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
from builtin_interfaces.msg import Time
from handing_over import ONE_HZ, TEN_HZ, tell
from nav_msgs.msg import Odometry

from cliploc_ros.ros.outputs.handoff import HandOffError


@pytest.mark.parametrize('moments_s', [ONE_HZ, TEN_HZ, (0.0, 0.5, 2.5)])
@pytest.mark.parametrize('speeds', [{'speed_m_s': 0.5}, {'twist_m_s': 0.5}])
def test_a_robot_that_drives_gets_no_pose_however_slow_its_odometry(robot, wheels, moments_s,
                                                                    speeds):
    """By poses without a twist, or by a twist with poses that stand still."""
    robot.localizer.subscribe()
    robot.meet()
    tell(robot, wheels, moments_s, **speeds)
    with pytest.raises(HandOffError, match=r'^the robot moves at 0\.50 m/s'):
        robot.hand_over()
    assert not robot.localizer.poses


@pytest.mark.parametrize('moments_s', [ONE_HZ, TEN_HZ])
def test_a_robot_at_rest_gets_its_pose_however_slow_its_odometry(robot, wheels, moments_s):
    """A source that sends only a twist looks the same at rest."""
    robot.localizer.subscribe()
    robot.meet()
    tell(robot, wheels, moments_s)
    assert robot.hand_over() < 1.5, 'two messages at 1 Hz are enough'
    robot.wait(lambda: robot.localizer.poses, 'the pose')


@pytest.mark.parametrize(('x_m', 'angle_rad', 'is_withheld'), [
    (0.12, 0.0, True), (-0.12, 0.0, True), (0.0, 0.1, True), (0.08, 0.07, False)])
def test_a_robot_that_has_moved_since_its_image_gets_no_pose(robot, wheels, x_m, angle_rad,
                                                              is_withheld):
    """It stopped half a second before the hand-over."""
    robot.localizer.subscribe()
    robot.meet()
    for tick in range(11):
        odometry = Odometry()
        odometry.header.stamp = Time(sec=100 + tick // 10, nanosec=tick % 10 * 10**8)
        share = min(1.0, tick / 5)
        odometry.pose.pose.position.x = share * x_m
        odometry.pose.pose.orientation.z = math.sin(share * angle_rad / 2)
        odometry.pose.pose.orientation.w = math.cos(share * angle_rad / 2)
        wheels.publish(odometry)
    robot.wait(lambda: robot.odometry.recent(60.0, 0.0) == odometry, 'odometry')
    if is_withheld:
        with pytest.raises(HandOffError, match=r'^the robot has moved'):
            robot.hand_over()
        assert not robot.localizer.poses
    else:
        robot.hand_over()
        robot.wait(lambda: robot.localizer.poses, 'the pose')


def stand(robot, wheels, places):
    """Publish where the robot was at moments since the image, and wait until that is heard."""
    for moment_s, x_m in places.items():
        odometry = Odometry()
        odometry.header.stamp = Time(sec=int(100 + moment_s), nanosec=round(moment_s % 1 * 1e9))
        odometry.pose.pose.position.x = x_m
        wheels.publish(odometry)
    robot.wait(lambda: robot.odometry.recent(60.0, 0.0) == odometry, 'odometry')


@pytest.mark.parametrize('places', [
    {-0.5: 0.0, 0.5: 1.0, 1.5: 1.0}, {-1.5: 0.0, 0.5: 0.2, 1.5: 0.2}, {-0.5: 0.0, 0.6: 1.0,
                                                                     0.8: 1.0, 1.0: 1.0}])
def test_slow_odometry_tells_that_the_robot_has_moved_since_its_image(robot, wheels, places):
    """It was somewhere between two places when the image was taken, and stands now."""
    robot.localizer.subscribe()
    robot.meet()
    stand(robot, wheels, places)
    with pytest.raises(HandOffError, match=r'^the robot has moved'):
        robot.hand_over()
    assert not robot.localizer.poses


@pytest.mark.parametrize(('x_m', 'is_withheld'), [(1.0, True), (0.0, False)])
def test_an_image_newer_than_odometry_waits_for_it(robot, wheels, x_m, is_withheld):
    robot.localizer.subscribe()
    robot.meet()
    stand(robot, wheels, {-2.0: 0.0, -1.0: 0.0})
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(robot.hand_over)
        robot.wait(lambda: robot.odometry._heard._waiters, 'it to wait for odometry')
        stand(robot, wheels, {0.3: x_m})
        if is_withheld:
            with pytest.raises(HandOffError, match=r'^the robot has moved by 1\.00 m'):
                handing_over.result()
            assert not robot.localizer.poses
        else:
            handing_over.result()
            robot.wait(lambda: robot.localizer.poses, 'the pose')


@pytest.mark.parametrize('moments_s', [(-4.0, -3.5, -3.0), (1.0, 2.0), (-4.0, 0.5, 1.0)])
def test_odometry_that_does_not_tell_whether_the_robot_has_moved_withholds_the_pose(
        robot, wheels, moments_s):
    """All of it is older than the image or newer, or it was silent about the image."""
    robot.localizer.subscribe()
    robot.meet()
    stand(robot, wheels, dict.fromkeys(moments_s, 0.0))
    with pytest.raises(HandOffError, match=r'^/odom does not tell whether the robot has moved'):
        robot.hand_over(2.5)
    assert not robot.localizer.poses


@pytest.mark.parametrize('speed_m_s', [0.0, 0.5])
@pytest.mark.parametrize('moments_s', [(7.0, 7.0, 7.0), (0.0, 10.0)])
def test_odometry_that_tells_no_speed_is_not_taken_for_rest(robot, wheels, moments_s, speed_m_s):
    """Its stamps stand still, or its poses are too far apart; the twist is empty."""
    robot.localizer.subscribe()
    robot.meet()
    tell(robot, wheels, moments_s, speed_m_s)
    with pytest.raises(HandOffError, match=r'^/odom shows neither a twist nor poses that tell a '
                       r'speed: the robot may be moving; stamp its poses'):
        robot.hand_over()
    assert not robot.localizer.poses


def test_after_the_deadline_odometry_of_late_will_do(robot, wheels):
    robot.localizer.subscribe()
    robot.meet()
    tell(robot, wheels, TEN_HZ)
    assert robot.hand_over(-1.0) < 0.5
    robot.wait(lambda: robot.localizer.poses, 'the pose')
