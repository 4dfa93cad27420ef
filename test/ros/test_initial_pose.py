# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handing a pose over: real subscribers, odometry, and services that answer or never do."""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from handing_over import PARAMETERS, TEN_HZ, Robot, make_pose, stamp, stand, tell

from cliploc_ros.ros.handoff import HandOffError, NoLocalizerError, difference
from cliploc_ros.ros.inputs.stamps import TimeJumpError


@pytest.mark.clock
def test_without_a_localizer_the_pose_is_withheld_once_time_is_up(robot):
    start = time.monotonic()
    with pytest.raises(NoLocalizerError, match=r'/initialpose.*retry'):
        robot.hand_over(4.0)
    assert 3.0 < time.monotonic() - start < 5.0
    robot.localizer.subscribe()
    robot.meet()
    robot.hand_over()
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    assert len(robot.localizer.poses) == 1, 'the withheld pose is not delivered late'


@pytest.fixture
def served(robot):
    """Return a robot whose localizer receives poses and serves updates."""
    robot.localizer.subscribe()
    robot.localizer.serve()
    robot.meet()
    robot.meet_service()
    return robot


def test_a_localizer_that_is_known_gets_a_pose_after_the_deadline(served):
    assert served.hand_over(-1.0) < 0.5
    served.wait(lambda: served.localizer.poses, 'the pose')
    assert not served.localizer.updates


def test_updates_come_no_faster_than_scans(served):
    assert 2.0 < served.hand_over() < 6.0
    assert len(served.localizer.updates) == PARAMETERS.nomotion_updates


@pytest.mark.parametrize(('timeout_s', 'longest_s'), [(10.0, 4.0), (0.5, 1.0)])
def test_a_service_that_never_answers_costs_little_and_leaves_nothing(served, timeout_s,
                                                                      longest_s):
    served.localizer.may_answer.clear()
    for number in range(1, 3):
        assert served.hand_over(timeout_s) < longest_s
        served.wait(lambda n=number: len(served.localizer.poses) == n, 'the pose')
    assert not served.handoff._updater._pending_requests, 'their futures are freed'
    served.localizer.may_answer.set()
    assert served.hand_over(nomotion_updates=1) < 2.0, 'late answers do no harm'


def test_a_jump_during_the_hand_over_withholds_the_pose(robot, wheels):
    """The hand-over waits for odometry when time jumps."""
    robot.localizer.subscribe()
    robot.meet()
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(robot.hand_over)
        robot.wait(lambda: robot.odometry._heard._waiters, 'a wait for odometry')
        robot.jump()
        tell(robot, wheels, TEN_HZ)
        with pytest.raises(TimeJumpError):
            handing_over.result()
    assert not robot.localizer.poses
    tell(robot, wheels, (1.0, 1.1))
    robot.hand_over()
    robot.wait(lambda: robot.localizer.poses, 'the pose')


@pytest.fixture
def silent(robot):
    """A localizer with a topic for its pose that publishes none."""
    robot.localizer.node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)
    robot.localizer.subscribe()
    robot.handoff.open('amcl_pose')
    robot.wait(lambda: not robot.handoff.missing(), 'the localizer')
    yield robot
    robot.handoff.close()


def test_who_hears_the_pose_but_shows_none_is_no_localizer(robot):
    """Subscribers such as ros2 topic echo."""
    robot.localizer.subscribe()
    robot.handoff.open('amcl_pose')
    robot.meet()
    with pytest.raises(NoLocalizerError, match='/amcl_pose'):
        robot.hand_over()
    assert not robot.localizer.poses
    robot.handoff.close()


@pytest.mark.parametrize(('off_m', 'named'), [(0.0, ''), (4.7, r'4\.70 m')])
def test_a_localizer_has_taken_the_pose_once_it_shows_it(robot, off_m, named):
    shows = robot.localizer.node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)

    def show(pose):
        robot.localizer.poses.append(pose)
        pose.pose.pose.position.x += off_m
        pose.pose.pose.orientation.w = 1.0
        shows.publish(pose)
    robot.localizer.node.create_subscription(PoseWithCovarianceStamped, 'initialpose', show, 10)
    robot.handoff.open('amcl_pose')
    robot.wait(lambda: not robot.handoff.missing() and shows.get_subscription_count(), 'both')
    with pytest.raises(NoLocalizerError, match=named) if named else nullcontext():
        robot.hand_over(3.2)
    assert len(robot.localizer.poses) == (3 if named else 1)
    robot.handoff.close()


@pytest.fixture
def showing(served):
    """A localizer that publishes the poses it is given, and that can stop doing so."""
    localizer, node = served.localizer, served.localizer.node
    shows = node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)

    def show(pose):
        pose.pose.pose.orientation.w = 1.0
        shows.publish(pose)
    node.create_subscription(PoseWithCovarianceStamped, 'initialpose', show, 10)
    served.handoff.open('amcl_pose')
    served.wait(lambda: not served.handoff.missing() and shows.get_subscription_count(), 'both')

    def show_at(x_m, seconds):
        pose = make_pose()
        pose.pose.pose.position.x, pose.header.stamp = x_m, stamp(100.0 + seconds)
        show(pose)
    localizer.show = show_at
    yield served
    served.handoff.close()


def test_a_localizer_that_dies_while_it_settles_has_not_taken_the_pose(showing):
    """It published the pose, but then answers no update and publishes nothing more."""
    showing.localizer.may_answer.clear()
    with pytest.raises(NoLocalizerError, match=r'took the pose, but has ended or hangs'):
        showing.hand_over()
    assert len(showing.localizer.poses) == 1
    showing.localizer.may_answer.set()


class RearTransforms:
    """Replaces tf2's buffer: it knows a frame at the robot's origin, turned by 180 degrees."""

    def lookup_transform(self, target, source, stamp, timeout):
        if (target, source) != ('base_link', 'rear'):
            raise LookupError('unknown frame')
        found = TransformStamped()
        found.transform.rotation.z, found.transform.rotation.w = 1.0, 0.0
        return found


@pytest.mark.parametrize(('x_m', 'driven_m', 'body', 'named'), [
    (0.0, 0.0, 'base_link', ''), (2.0, 0.0, 'base_link', r'differs from it by 2\.00 m'),
    (2.0, 2.0, 'base_link', ''), (0.0, 2.0, 'base_link', r'differs from it by 2\.00 m'),
    (2.0, 2.0, 'wheels', r'differs from it by 2\.00 m'), (-2.0, 2.0, 'rear', '')])
def test_where_the_localizer_is_once_it_has_settled_decides(showing, wheels, x_m, driven_m, body,
                                                            named):
    """It answers no update but shows a pose, also that of a robot that has driven off.

    The robot drives after the pose was taken. Nobody places `wheels` at the robot; `rear` looks
    back.
    """
    showing.handoff._transforms._buffer = RearTransforms()
    stand(showing, wheels, dict.fromkeys((-0.1, 0.0, 0.1, 0.2, 0.3, 0.4), 0.0), body=body)
    showing.localizer.may_answer.clear()
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(showing.hand_over)
        showing.wait(lambda: showing.localizer.updates, 'an update')
        stand(showing, wheels, {0.4 + 0.1 * tick: driven_m * tick / 20 for tick in range(1, 21)},
              twist_m_s=5.0 * driven_m / 10, body=body)
        showing.localizer.show(x_m, 2.4)
        with pytest.raises(NoLocalizerError, match=named) if named else nullcontext():
            handing_over.result()
    showing.localizer.may_answer.set()


@pytest.mark.parametrize(('timeout_s', 'named', 'times'), [
    (3.2, 'no message on', 3), (0.3, 'too little time', 0)])
def test_the_pose_comes_again_until_time_is_up(silent, timeout_s, named, times):
    with pytest.raises(NoLocalizerError, match=named):
        silent.hand_over(timeout_s)
    assert len(silent.localizer.poses) == times


@pytest.mark.parametrize('timeout_s', [10.0, 0.3])
def test_a_robot_that_drives_is_told_so_however_little_time_is_left(silent, wheels, timeout_s):
    tell(silent, wheels, TEN_HZ, twist_m_s=0.5)
    with pytest.raises(HandOffError, match=r'moves at 0\.50'):
        silent.hand_over(timeout_s)
    assert not silent.localizer.poses


@pytest.mark.parametrize(('end', 'error'), [
    (Robot.jump, TimeJumpError), (lambda robot: robot.handoff.stop(), HandOffError)])
def test_what_ends_a_hand_over_ends_the_wait_for_the_localizer(silent, end, error):
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(silent.hand_over)
        silent.wait(lambda: silent.localizer.poses, 'the pose')
        start = time.monotonic()
        end(silent)
        with pytest.raises(error):
            handing_over.result()
    assert time.monotonic() - start < 3.0
    assert len(silent.localizer.poses) == 1


@pytest.mark.parametrize(('x_m', 'yaw_deg', 'frame', 'is_taken_over'), [
    (0.0, 0.0, 'map', True), (0.55, 0.0, '/map', True), (0.0, 24.0, 'map', True),
    (0.65, 0.0, 'map', False), (0.0, 26.0, 'map', False), (0.0, 0.0, 'floor_2', False),
    (math.nan, 0.0, 'map', False), (0.0, math.nan, 'map', False)])
def test_how_near_the_localizer_has_to_be(x_m, yaw_deg, frame, is_taken_over):
    """Limits: .3 m and three deviations of .1 m, 10 degrees and three deviations of 5."""
    given, shown = make_pose(), make_pose()
    given.pose.pose.orientation.w = 1.0
    given.pose.covariance[0], given.pose.covariance[7] = 0.1**2, 0.02**2
    given.pose.covariance[35] = math.radians(5.0)**2
    shown.header.frame_id, shown.pose.pose.position.x = frame, x_m
    shown.pose.pose.orientation.z = math.sin(math.radians(yaw_deg) / 2)
    shown.pose.pose.orientation.w = math.cos(math.radians(yaw_deg) / 2)
    assert (not difference(given, shown)) == is_taken_over
    shown.pose.pose.orientation.y = 1e200
    assert difference(given, shown)
