# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handing a pose over: real subscribers, odometry and services that answer, or never do."""

import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor
from std_srvs.srv import Empty

from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.inputs.time_jumps import TimeJumpError
from cliploc_ros.ros.outputs.handoff import (
    HandOff,
    HandOffError,
    NoLocalizerError,
    is_taken,
)

VALUES = {'base_frame': 'base_link', 'max_speed_m_s': 0.1, 'max_turn_rad_s': 0.2,
          'nomotion_updates': 10, 'require_localizer': True}


def make_pose():
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id, pose.header.stamp = 'map', Time(sec=100)
    return pose


class Localizer:
    """Stands for AMCL: hears initial poses, and answers update requests while it may."""

    def __init__(self, node):
        self.node = node
        self.poses, self.updates = [], []
        self.may_answer = threading.Event()
        self.may_answer.set()
        self._group = ReentrantCallbackGroup()

    def subscribe(self):
        self.node.create_subscription(PoseWithCovarianceStamped, 'initialpose',
                                      self.poses.append, 10)

    def serve(self):
        def update(_, response):
            self.updates.append(time.monotonic())
            self.may_answer.wait()
            return response
        self.node.create_service(Empty, 'request_nomotion_update', update,
                                 callback_group=self._group)


class Robot:
    """A relocalizer's hand-over and a localizer, all of whose callbacks are executed."""

    def __init__(self, make_node, wait):
        self.node, self.wait = make_node('relocalizer'), wait
        self.localizer = Localizer(make_node('amcl'))
        self.odometry = OdometrySource(self.node)
        self.handoff = HandOff(self.node, self.odometry)

    def hand_over(self, timeout_s=10.0, **changes):
        """Hand a pose over; return how long it took [s]."""
        start = time.monotonic()
        self.handoff.hand_over(make_pose(), VALUES | changes, start + timeout_s, start)
        return time.monotonic() - start

    def meet(self):
        """Wait until the relocalizer knows the localizer."""
        self.wait(lambda: self.handoff._publisher.get_subscription_count(), 'the subscriber')

    def meet_service(self):
        self.wait(self.handoff._updater.service_is_ready, 'the service')


@pytest.fixture
def robot(context, make_node, wait):
    robot = Robot(make_node, wait)
    executor = MultiThreadedExecutor(4, context=context)
    for node in (robot.node, robot.localizer.node):
        executor.add_node(node)

    def spin():
        with suppress(InvalidHandle):  # the shutdown below may come while it waits
            executor.spin()
    spinning = threading.Thread(target=spin)
    spinning.start()
    yield robot
    robot.localizer.may_answer.set()
    executor.shutdown()
    spinning.join()


def test_a_localizer_that_is_there_gets_the_pose(robot):
    robot.localizer.subscribe()
    robot.meet()
    assert robot.hand_over() < 1.0
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    assert robot.localizer.poses[0].header == make_pose().header


@pytest.mark.clock
def test_without_a_localizer_the_pose_is_withheld(robot):
    start = time.monotonic()
    with pytest.raises(NoLocalizerError, match=r'^nobody subscribes /initialpose: start the '
                       r'localizer \(AMCL\), or set require_localizer: false$'):
        robot.hand_over()
    assert 1.0 < time.monotonic() - start < 5.0
    robot.localizer.subscribe()
    robot.meet()
    robot.hand_over()
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    assert len(robot.localizer.poses) == 1, 'the one that was withheld is not delivered late'


def test_a_localizer_that_starts_meanwhile_is_waited_for(robot):
    starting = threading.Timer(0.3, robot.localizer.subscribe)
    starting.start()
    assert robot.hand_over() > 0.2
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    starting.join()


def test_a_robot_without_a_localizer_need_not_wait_for_one(robot):
    assert robot.hand_over(require_localizer=False) < 1.0


@pytest.mark.clock
@pytest.mark.parametrize('timeout_s', [0.3, 0.0, -1.0])
def test_no_wait_goes_beyond_the_deadline(robot, timeout_s):
    start = time.monotonic()
    with pytest.raises(HandOffError, match='nobody subscribes'):
        robot.hand_over(timeout_s)
    assert time.monotonic() - start < max(timeout_s, 0.0) + 0.5


def test_a_localizer_that_is_known_gets_a_pose_after_the_deadline(robot):
    robot.localizer.subscribe()
    robot.localizer.serve()
    robot.meet()
    robot.meet_service()
    assert robot.hand_over(-1.0) < 0.5
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    assert not robot.localizer.updates


def test_updates_come_no_faster_than_scans(robot):
    robot.localizer.subscribe()
    robot.localizer.serve()
    robot.meet()
    robot.meet_service()
    assert 2.0 < robot.hand_over() < 6.0
    assert len(robot.localizer.updates) == VALUES['nomotion_updates']


def test_updates_end_with_the_deadline_and_the_pose_is_delivered(robot):
    robot.localizer.subscribe()
    robot.localizer.serve()
    robot.meet()
    robot.meet_service()
    assert robot.hand_over(1.0) < 1.5
    assert 0 < len(robot.localizer.updates) < 6
    robot.wait(lambda: robot.localizer.poses, 'the pose')


@pytest.mark.parametrize(('timeout_s', 'longest_s'), [(10.0, 4.0), (0.5, 1.0)])
def test_a_service_that_never_answers_costs_little_and_leaves_nothing(robot, timeout_s,
                                                                         longest_s):
    robot.localizer.subscribe()
    robot.localizer.may_answer.clear()
    robot.localizer.serve()
    robot.meet()
    robot.meet_service()
    for number in range(1, 4):
        assert robot.hand_over(timeout_s) < longest_s
        robot.wait(lambda n=number: len(robot.localizer.poses) == n, 'the pose')
    assert not robot.handoff._updater._pending_requests, 'their futures are freed'
    robot.localizer.may_answer.set()
    assert robot.hand_over(nomotion_updates=1) < 2.0, 'late answers do no harm'


@pytest.fixture
def wheels(robot, make_node):
    """A publisher of odometry that has said nothing yet; the robot listens to it."""
    wheels = make_node('wheels').create_publisher(Odometry, 'odom', 10)
    robot.odometry.open()
    robot.wait(lambda: wheels.get_subscription_count() and robot.odometry.is_published,
               'the wheels to be heard')
    yield wheels
    robot.odometry.close()


def rest(wheels):
    """Publish half a second of odometry of a robot at rest."""
    for tick in range(6):
        odometry = Odometry()
        odometry.header.stamp = Time(sec=100, nanosec=tick * 10**8)
        odometry.pose.pose.orientation.w = 1.0
        wheels.publish(odometry)


def tell(robot, wheels, moments_s, speed_m_s=0.0, twist_m_s=0.0):
    """Publish odometry at moments since the image, and wait until the last is heard."""
    for moment_s in moments_s:
        odometry = Odometry()
        odometry.header.stamp = Time(sec=100 + int(moment_s), nanosec=round(moment_s % 1 * 1e9))
        odometry.pose.pose.position.x = speed_m_s * moment_s
        odometry.twist.twist.linear.x = twist_m_s
        wheels.publish(odometry)
    robot.wait(lambda: (newest := robot.odometry.recent(60.0, 0.0)) is not None
               and newest == odometry, 'odometry')


ONE_HZ = (0.0, 1.0, 2.0)
TEN_HZ = tuple(tick / 10 for tick in range(10))


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
        with pytest.raises(HandOffError, match=r'^the robot has moved by .* since its image'):
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
    with pytest.raises(HandOffError, match=r'^the robot has moved by .* since its image'):
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


@pytest.mark.clock
def test_odometry_that_says_nothing_is_not_taken_for_rest(robot, wheels):
    robot.localizer.subscribe()
    robot.meet()
    start = time.monotonic()
    with pytest.raises(HandOffError, match='the robot may be moving'):
        robot.hand_over(0.3)
    assert time.monotonic() - start < 0.8
    assert not robot.localizer.poses


def test_after_the_deadline_odometry_of_late_will_do(robot, wheels):
    robot.localizer.subscribe()
    robot.meet()
    robot.wait(lambda: robot.odometry.speeds_by_poses(0.0) is not None, 'odometry',
               lambda: rest(wheels))
    assert robot.hand_over(-1.0) < 0.5
    robot.wait(lambda: robot.localizer.poses, 'the pose')


def test_without_time_to_see_it_rest_a_robot_is_not_taken_to_rest(robot, wheels):
    """One message of odometry, whose twist many leave empty: it may be moving."""
    robot.localizer.subscribe()
    robot.meet()
    robot.wait(lambda: robot.odometry.recent(2.0, 0.1), 'odometry',
               lambda: wheels.publish(Odometry()))
    start = time.monotonic()
    with pytest.raises(HandOffError, match='too little time'):
        robot.hand_over(0.3)
    assert time.monotonic() - start < 0.8
    assert not robot.localizer.poses


def test_a_jump_between_search_and_hand_over_withholds_the_pose(robot):
    robot.localizer.subscribe()
    robot.meet()
    received_at = time.monotonic()
    robot.handoff.forget()
    with pytest.raises(TimeJumpError):
        robot.handoff.hand_over(make_pose(), VALUES, received_at + 10.0, received_at)
    assert not robot.localizer.poses


def test_a_jump_during_the_hand_over_withholds_the_pose(robot, wheels):
    """The hand-over waits for odometry when time jumps."""
    robot.localizer.subscribe()
    robot.meet()
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(robot.hand_over)
        robot.wait(lambda: robot.odometry._heard._waiters, 'it to wait for odometry')
        robot.handoff.forget()
        rest(wheels)
        with pytest.raises(TimeJumpError, match='time jumped back before'):
            handing_over.result()
        assert not robot.localizer.poses
        handing_over = pool.submit(robot.hand_over)
        robot.wait(handing_over.done, 'the next hand-over', lambda: rest(wheels))
        assert handing_over.exception() is None
    robot.wait(lambda: robot.localizer.poses, 'the pose')


@pytest.fixture
def silent(robot):
    """A localizer that has a topic for its pose, but shows none."""
    robot.localizer.node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', 10)
    robot.localizer.subscribe()
    robot.handoff.open('amcl_pose')
    robot.wait(lambda: not robot.handoff.missing(), 'the localizer')
    yield robot
    robot.handoff.close()


def test_who_hears_the_pose_but_shows_none_is_no_localizer(robot):
    """Such as ros2 topic echo."""
    robot.localizer.subscribe()
    robot.handoff.open('amcl_pose')
    robot.meet()
    with pytest.raises(NoLocalizerError, match=r'^nobody publishes /amcl_pose: start the '
                       r'localizer \(AMCL\), or name the topic of its pose by localizer_pose$'):
        robot.hand_over()
    assert not robot.localizer.poses
    robot.handoff.close()


def test_the_pose_comes_again_until_time_is_up(silent):
    with pytest.raises(NoLocalizerError, match=r'^the localizer did not take the pose: /amcl_pose '
                       r'shows nothing since initialpose was published 3 times in 3 s: see '):
        silent.hand_over(3.2)
    assert len(silent.localizer.poses) == 3


def test_a_pose_is_not_given_without_time_to_see_it_taken(silent):
    with pytest.raises(NoLocalizerError, match=r'^too little time is left to see whether'):
        silent.hand_over(0.3)
    assert not silent.localizer.poses


def test_a_robot_that_moves_meanwhile_gets_the_pose_no_more(silent, wheels):
    tell(silent, wheels, TEN_HZ)
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(silent.hand_over)
        silent.wait(lambda: silent.localizer.poses, 'the pose')
        tell(silent, wheels, (1.0, 1.1, 1.2), twist_m_s=0.5)
        with pytest.raises(HandOffError, match=r'^the robot moves at 0\.50 m/s'):
            handing_over.result()
    assert len(silent.localizer.poses) == 1


@pytest.mark.parametrize(('what', 'error'), [('forget', TimeJumpError), ('stop', HandOffError)])
def test_what_ends_a_hand_over_ends_the_wait_for_the_localizer(silent, what, error):
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(silent.hand_over)
        silent.wait(lambda: silent.localizer.poses, 'the pose')
        start = time.monotonic()
        getattr(silent.handoff, what)()
        with pytest.raises(error, match=r'time jumped|was deactivated'):
            handing_over.result()
    assert time.monotonic() - start < 3.0
    assert len(silent.localizer.poses) == 1


@pytest.mark.parametrize(('x_m', 'yaw_deg', 'frame', 'is_taken_over'), [
    (0.0, 0.0, 'map', True), (0.55, 0.0, '/map', True), (0.0, 24.0, 'map', True),
    (0.65, 0.0, 'map', False), (0.0, 26.0, 'map', False), (0.0, 0.0, 'floor_2', False),
    (math.nan, 0.0, 'map', False), (0.0, math.nan, 'map', False)])
def test_how_near_the_localizer_has_to_be(x_m, yaw_deg, frame, is_taken_over):
    """.3 m and three deviations of .1 m, 10 degrees and three of 5."""
    given, shown = make_pose(), make_pose()
    given.pose.pose.orientation.w = 1.0
    given.pose.covariance[0], given.pose.covariance[7] = 0.1**2, 0.02**2
    given.pose.covariance[35] = math.radians(5.0)**2
    shown.header.frame_id, shown.pose.pose.position.x = frame, x_m
    shown.pose.pose.orientation.z = math.sin(math.radians(yaw_deg) / 2)
    shown.pose.pose.orientation.w = math.cos(math.radians(yaw_deg) / 2)
    assert is_taken(given, shown) == is_taken_over
    shown.pose.pose.orientation.y = 1e200
    assert not is_taken(given, shown)


def test_a_hand_over_ends_with_the_node(robot):
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(robot.hand_over)
        robot.wait(handing_over.running, 'the hand-over')
        start = time.monotonic()
        robot.handoff.stop()
        with pytest.raises(HandOffError):
            handing_over.result()
    assert time.monotonic() - start < 1.0
