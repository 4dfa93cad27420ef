# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handing a pose over: real subscribers, odometry, and services that answer or never do."""

import math
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace

import pytest
from builtin_interfaces.msg import Time as Stamp
from frames import stamp
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from stand_ins import KINDS, Localizer, Nav2

from cliploc_ros.ros import handoff
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.receivers import difference

PARAMETERS = RelocalizerParameters(base_frame='base_link', localizer_pose='')

# Times of odometry since the image [s].
ONE_HZ, TEN_HZ = (0.0, 1.0, 2.0), tuple(tick / 10 for tick in range(10))


def make_pose():
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id, pose.header.stamp = 'map', Stamp(sec=100)
    return pose


class Robot:
    """A relocalizer's hand-over and a localizer, whose callbacks are all executed."""

    def __init__(self, make_node, wait):
        self.node, self.wait, self._make_node = make_node('relocalizer'), wait, make_node
        self.odometry = OdometrySource(self.node)
        self.handoff = handoff.HandOff(self.node, self.odometry, CoordinateFrames(self.node))
        self.jumps = TimeJumps(self.node, self.odometry.forget)
        self.parameters = PARAMETERS

    def start(self, name, **others):
        """Start a localizer, the first of which is the robot's."""
        localizer = Localizer(self._make_node, name, **others)
        self.localizer = getattr(self, 'localizer', localizer)
        self.executor.add_node(localizer.node)
        return localizer

    def open(self, localizer_pose):
        self.parameters = replace(PARAMETERS, localizer_pose=localizer_pose)
        self.handoff.open(self.parameters)

    def hand_over(self, timeout_s=10.0, floor='map', grids=(), age_s=0.0, **changes):
        """Hand a pose over; return the elapsed time [s]."""
        start, pose = time.monotonic(), make_pose()
        pose.header.frame_id = floor
        self.handoff.hand_over(pose, replace(self.parameters, **changes), start + timeout_s,
                               start - age_s, self.jumps, grids)
        return time.monotonic() - start

    def jump(self):
        """Make the relocalizer's clock jump: to simulated time, and back."""
        for is_simulated in (True, False):
            self.node.set_parameters([Parameter('use_sim_time', value=is_simulated)])

    def meet(self):
        """Wait until the relocalizer has discovered the localizer."""
        self.wait(self.handoff.localizer._publisher.get_subscription_count, 'the subscriber')


def tell(robot, wheels, moments_s, speed_m_s=0.0, twist_m_s=0.0):
    """Publish odometry at times since the image, and wait until the last is received."""
    stand(robot, wheels, {moment_s: speed_m_s * moment_s for moment_s in moments_s}, twist_m_s)


def stand(robot, wheels, places, twist_m_s=0.0, rad_per_m=0.0, body=''):
    """Publish poses of the robot at times since the image, and wait until they are received."""
    for moment_s, x_m in places.items():
        odometry = Odometry(child_frame_id=body)
        odometry.header.stamp = stamp(100.0 + moment_s)
        odometry.pose.pose.position.x, odometry.twist.twist.linear.x = x_m, twist_m_s
        odometry.pose.pose.orientation.z = math.sin(rad_per_m * x_m / 2)
        odometry.pose.pose.orientation.w = math.cos(rad_per_m * x_m / 2)
        wheels.publish(odometry)
    robot.wait(lambda: (newest := robot.odometry.recent(60.0, 0.0)) is not None
               and newest == odometry, 'odometry')


@pytest.fixture
def robot(context, make_node, wait):
    robot = Robot(make_node, wait)
    executor = robot.executor = MultiThreadedExecutor(4, context=context)
    executor.add_node(robot.node)

    def spin():
        with suppress(InvalidHandle):  # the shutdown below may happen while it waits
            executor.spin()
    spinning = threading.Thread(target=spin)
    spinning.start()
    yield robot
    if hasattr(robot, 'localizer'):
        robot.localizer.may_answer.set()
    executor.shutdown()
    spinning.join()


@pytest.fixture
def wheels(robot, make_node):
    """Create a silent publisher of odometry that the robot subscribes to."""
    wheels = make_node('wheels').create_publisher(Odometry, 'odom', 10)
    robot.odometry.open()
    robot.wait(lambda: wheels.get_subscription_count() and robot.odometry.is_published,
               'the discovery of the odometry')
    yield wheels
    robot.odometry.close()


def test_without_a_localizer_the_pose_is_withheld_once_time_is_up(robot):
    """Who hears the pose but shows none, such as ros2 topic echo, is no localizer."""
    robot.open('amcl_pose')
    with pytest.raises(handoff.NoLocalizerError, match=r'/initialpose.*retry'):
        robot.hand_over(1.5)
    robot.start('ros2 topic echo')
    robot.meet()
    start = time.monotonic()
    with pytest.raises(handoff.NoLocalizerError, match='localizer_pose: amcl_pose'):
        robot.hand_over(1.5)
    assert 0.5 < time.monotonic() - start < 3.0
    assert not robot.localizer.poses
    robot.handoff.close()
    robot.open('')
    robot.hand_over()
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    assert len(robot.localizer.poses) == 1, 'the withheld pose is not delivered late'


@pytest.fixture
def served(robot):
    """Return a robot whose localizer receives poses and serves updates."""
    robot.start('amcl')
    robot.meet()
    robot.wait(robot.handoff._updater.service_is_ready, 'the service')
    return robot


def test_updates_come_no_faster_than_scans_and_without_an_answer_cost_little(served):
    assert 2.0 < served.hand_over() < 6.0
    assert len(served.localizer.updates) == PARAMETERS.nomotion_updates
    served.localizer.may_answer.clear()
    for timeout_s, longest_s in ((10.0, 4.0), (0.5, 1.0), (-1.0, 0.5)):
        assert served.hand_over(timeout_s) < longest_s
    served.wait(lambda: len(served.localizer.poses) == 4, 'the poses')
    assert not served.handoff._updater._pending_requests, 'their futures are freed'
    served.localizer.may_answer.set()
    assert served.hand_over(nomotion_updates=1) < 2.0, 'late answers do no harm'


def test_a_jump_during_the_hand_over_withholds_the_pose(robot, wheels):
    """The hand-over waits for odometry when time jumps."""
    robot.start('ros2 topic echo')
    robot.meet()
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(robot.hand_over)
        robot.wait(lambda: robot.odometry._heard._waiters, 'a wait for odometry')
        robot.jump()
        tell(robot, wheels, TEN_HZ)
        with pytest.raises(TimeJumpError):
            handing_over.result()
    assert not robot.localizer.poses


@pytest.fixture
def showing(served):
    """A localizer that shows the poses it is given."""
    served.open('amcl_pose')
    served.wait(lambda: not served.handoff.localizer.missing()
                and served.localizer._pose.get_subscription_count(), 'both')
    yield served
    served.handoff.close()


@pytest.mark.parametrize(('off_m', 'timeout_s', 'named', 'times'), [
    (0.0, 3.2, '', 1), (4.7, 3.2, r'4\.70 m', 3),
    (math.nan, 3.2, r'nobody publishes /map, .* receives scans', 3),
    (math.nan, 0.3, 'too little time', 0)])
def test_a_localizer_has_taken_the_pose_once_it_shows_it(showing, off_m, timeout_s, named, times):
    showing.localizer.off_m = off_m
    with pytest.raises(handoff.NoLocalizerError, match=named) if named else nullcontext():
        showing.hand_over(timeout_s)
    assert len(showing.localizer.poses) == times


def test_a_localizer_that_dies_while_it_settles_has_not_taken_the_pose(showing):
    """It published the pose, but then answers no update and publishes nothing more."""
    showing.localizer.may_answer.clear()
    with pytest.raises(handoff.NoLocalizerError, match=r'took the pose, but has ended or hangs'):
        showing.hand_over()
    assert len(showing.localizer.poses) == 1
    showing.localizer.may_answer.set()
    showing.localizer.off_m = math.nan
    with pytest.raises(handoff.NoLocalizerError, match='no message on'):
        showing.hand_over(1.0)  # what it showed before does not count


class RearTransforms:
    """Replaces tf2's buffer: it knows a frame at the robot's origin, turned by 180 degrees."""

    def lookup_transform(self, target, source, stamp, timeout):
        if (target, source) != ('base_link', 'rear'):
            raise LookupError('unknown frame')
        found = TransformStamped()
        found.transform.rotation.z, found.transform.rotation.w = 1.0, 0.0
        return found


@pytest.mark.parametrize(('x_m', 'driven_m', 'body', 'named'), [
    (2.0, 0.0, 'base_link', r'differs from it by 2\.00 m'), (2.0, 2.0, 'base_link', ''),
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
        showing.localizer.show(x_m, stamp(102.4))
        with pytest.raises(handoff.NoLocalizerError, match=named) if named else nullcontext():
            handing_over.result()
    showing.localizer.may_answer.set()


@pytest.mark.parametrize(('end', 'error'), [
    (Robot.jump, TimeJumpError), (lambda robot: robot.handoff.stop(), handoff.HandOffError)])
def test_what_ends_a_hand_over_ends_the_wait_for_the_localizer(showing, end, error):
    showing.localizer.off_m = math.nan
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(showing.hand_over)
        showing.wait(lambda: showing.localizer.poses, 'the pose')
        start = time.monotonic()
        end(showing)
        with pytest.raises(error):
            handing_over.result()
    assert time.monotonic() - start < 3.0
    assert len(showing.localizer.poses) == 1


@pytest.mark.parametrize(('x_m', 'yaw_deg', 'frame', 'is_taken_over'), [
    (0.55, 0.0, '/map', True), (0.0, 24.0, 'map', True), (0.65, 0.0, 'map', False),
    (0.0, 26.0, 'map', False), (0.0, 0.0, 'floor_2', False), (math.nan, 0.0, 'map', False),
    (0.0, math.nan, 'map', False)])
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


@pytest.mark.parametrize(('now_s', 'published_s'), [(200, 100), (50, 50), (0, 100)])
def test_the_stamp_is_the_images_but_not_later_than_now(now_s, published_s):
    """A pose without any scatter gets a centimetre."""
    pose = make_pose()
    usable = handoff.usable_pose(pose, Time(seconds=now_s))
    assert usable.header.stamp.sec == published_s
    assert (pose.header.stamp.sec, usable.header.frame_id) == (100, 'map')
    # x, xy, yx, y and yaw: the elements that AMCL reads
    assert [usable.pose.covariance[i] for i in (0, 1, 6, 7, 35)] == [1e-4, 0.0, 0.0, 1e-4, 1e-5]


# ---- odometry shows whether the robot has moved since its image ---------------------------------

@pytest.fixture
def listening(robot, wheels):
    """Return a robot whose localizer receives poses."""
    robot.start('ros2 topic echo')
    robot.meet()
    return robot


def is_withheld(robot, timeout_s=10.0):
    """Hand a pose over; return the reason why it is withheld, or ''."""
    try:
        robot.hand_over(timeout_s)
    except handoff.HandOffError as error:
        assert not robot.localizer.poses
        return str(error)
    robot.wait(lambda: robot.localizer.poses, 'the pose')
    return ''


@pytest.mark.parametrize(('moments_s', 'speeds'), [
    (ONE_HZ, {'speed_m_s': 0.5}), ((0.0, 0.5, 2.5), {'twist_m_s': 0.5})])
def test_a_robot_that_drives_gets_no_pose_however_slow_its_odometry(listening, wheels, moments_s,
                                                                    speeds):
    """Motion shows in poses without a twist, or in a twist with constant poses."""
    tell(listening, wheels, moments_s, **speeds)
    assert 'moves at 0.50 m/s' in is_withheld(listening)


@pytest.mark.parametrize(('moments_s', 'timeout_s'), [(ONE_HZ, 10.0), (TEN_HZ, -1.0)])
def test_a_robot_at_rest_gets_its_pose_however_slow_its_odometry(listening, wheels, moments_s,
                                                                 timeout_s):
    """A source of twists only looks the same at rest. Late odometry will do."""
    tell(listening, wheels, moments_s)
    assert listening.hand_over(timeout_s) < 1.5, 'two messages at 1 Hz are enough'
    listening.wait(lambda: listening.localizer.poses, 'the pose')


@pytest.mark.parametrize(('places', 'rad_per_m', 'has_moved'), [
    *(({tick / 10: min(1.0, tick / 5) * x_m for tick in range(11)}, rad_per_m, has_moved)
      for x_m, rad_per_m, has_moved in ((-0.12, 0.0, True), (0.01, 10.0, True),
                                        (0.08, 0.8, False))),
    # slow odometry: it was between two places
    ({-1.5: 0.0, 0.5: 0.2, 1.5: 0.2}, 0.0, True),
    ({-0.5: 0.0, 0.6: 1.0, 0.8: 1.0, 1.0: 1.0}, 0.0, True)])
def test_a_robot_that_has_moved_since_its_image_gets_no_pose(listening, wheels, places, rad_per_m,
                                                             has_moved):
    """The robot stopped before the hand-over."""
    stand(listening, wheels, places, rad_per_m=rad_per_m)
    assert ('has moved' in is_withheld(listening)) == has_moved


@pytest.mark.parametrize(('x_m', 'has_moved'), [(1.0, True), (0.0, False)])
def test_an_image_newer_than_odometry_waits_for_it(listening, wheels, x_m, has_moved):
    stand(listening, wheels, {-2.0: 0.0, -1.0: 0.0})
    with ThreadPoolExecutor(1) as pool:
        handing_over = pool.submit(is_withheld, listening)
        listening.wait(lambda: listening.odometry._heard._waiters, 'a wait for odometry')
        stand(listening, wheels, {0.3: x_m})
        assert ('has moved by 1.00 m' in handing_over.result()) == has_moved


@pytest.mark.parametrize(('places', 'named'), [
    # older than the image, newer, or with a gap around it
    *((dict.fromkeys(moments_s, 0.0), 'does not cover') for moments_s in (
        (-4.0, -3.5, -3.0), (1.0, 2.0), (-4.0, 0.5, 1.0))),
    # the stamp is constant, or the poses are too far apart; the twist is empty
    ({7.0: 0.0}, 'the speed is unknown'), ({0.0: 0.0, 10.0: 5.0}, 'the speed is unknown')])
def test_odometry_that_does_not_tell_of_rest_withholds_the_pose(listening, wheels, places, named):
    for _ in range(3 if len(places) == 1 else 1):
        stand(listening, wheels, places)
    assert named in is_withheld(listening, 2.5)


# ---- any localizer ------------------------------------------------------------------------------

def withheld(robot, named, timeout_s=1.7):
    with pytest.raises(handoff.NoLocalizerError, match=named) if named else nullcontext():
        robot.hand_over(timeout_s)


@pytest.mark.parametrize('name', [*KINDS][:-1])
def test_any_localizer_confirms_the_pose_that_it_takes(robot, name):
    """Success, another place, silence, two at once, death; ros2 topic echo does not count."""
    transforms, topic = robot.handoff._transforms, KINDS[name][3]
    localizer = robot.start(name, tell=lambda *placed: [
        listener(*placed) for listener in transforms.listeners])
    transforms._buffer = localizer
    robot.open('auto')
    robot.wait(lambda: not robot.handoff.localizer.missing(), 'the localizer')
    assert robot.handoff.localizer.pose_topic == (f'/{topic}' if topic else '')
    robot.start('ros2 topic echo')
    withheld(robot, '', 5.0)
    localizer.off_m = 2.0
    withheld(robot, r'differs from it by 2\.00 m')
    localizer.off_m = math.nan
    withheld(robot, f'no message on {f"/{topic}" if topic else "tf from the map"} since')
    count, others = len(localizer.poses), [
        other for other in KINDS if KINDS[other][0] != KINDS[name][0]
        and bool(KINDS[other][3]) is bool(topic) and KINDS[other][6]]
    other = robot.start(others[0])
    robot.wait(robot.handoff.localizer.missing, 'the second localizer')
    withheld(robot, f'several localizers.*/{KINDS[others[0]][0]} on .*stop all but one', 0.7)
    assert len(localizer.poses) == count and not other.poses
    robot.executor.shutdown()  # rclpy fails where a node ends while it is executed
    for node in (localizer.node, other.node):
        node.destroy_node()
    robot.wait(lambda: 'nobody' in robot.handoff.localizer.missing(), 'their end')
    withheld(robot, "nobody publishes the localizer's pose", 0.7)


# ---- Nav2's grid follows the robot from floor to floor ------------------------------------------

GRIDS = {f'floor_{number}': f'/maps/{number}.yaml' for number in range(3)}
POSE = 'pose in map'


@pytest.fixture
def nav2(showing, make_node):
    """Start map_server and costmaps."""
    nav2 = Nav2(make_node('nav2'))
    showing.executor.add_node(nav2._node)
    showing.enter = lambda floor, timeout_s=5.0, **how: showing.hand_over(
        timeout_s, f'floor_{floor}', GRIDS, nomotion_updates=0, **how)
    yield nav2
    nav2.ended.set()


@pytest.mark.needs('nav2_msgs')
def test_fifty_changes_between_three_floors(showing, nav2):
    """The grid is loaded, then the costmaps are cleared, then the pose is given, once."""
    floor, expected = 0, []
    for step in range(51):
        showing.enter(floor)
        expected += [str(floor), 'global', 'local', POSE]
        showing.wait(lambda: nav2.order == expected, f'step {step}')  # noqa: B023
        floor = (floor + random.Random(step).randint(1, 2)) % 3
    showing.enter(nav2.order[-4])
    showing.wait(lambda: nav2.order == [*expected, POSE], 'a pose on the loaded floor')
    nav2.grids.publish(OccupancyGrid())
    showing.wait(lambda: not showing.handoff.floors.loaded, 'the grid of another program')
    showing.enter(nav2.order[-5])
    showing.wait(lambda: nav2.order == [*expected, POSE, *expected[-4:]], 'the grid again')


@pytest.mark.needs('nav2_msgs')
@pytest.mark.parametrize(('broken', 'named', 'got'), [
    ('result', 'load_map: result 1', '1'), ('1', 'load_map does not answer', '1'),
    ('grid', 'result 0, and no such grid on map', '1'),
    ('global', 'clear_entirely_global_costmap does not answer', '1 global'),
    ('local', 'clear_entirely_local_costmap does not answer', '1 global local'),
    ('amcl', r'differs from it by 3\.00 m', f'1 global local {POSE}')])
def test_what_fails_withholds_the_pose_and_restores_the_grid(showing, nav2, broken, named, got):
    showing.enter(0)
    showing.wait(lambda: len(nav2.order) == 4, 'the first floor')
    nav2.order.clear()
    nav2.broken, showing.localizer.off_m = broken, 3.0 * (broken == 'amcl')
    with pytest.raises(handoff.NoLocalizerError, match=f"{named}.*'floor_0' is requested again"):
        showing.enter(1, 1.5)
    nav2.broken, showing.localizer.off_m = '', 0.0
    nav2.ended.set()
    showing.wait(lambda: ' '.join(nav2.order) == f'{got} 0' and (
        showing.handoff.floors.loaded == {'map': 'floor_0'} or broken == 'grid'), 'the grid')
    showing.enter(1)
    showing.wait(lambda: nav2.order[-4:] == ['1', 'global', 'local', POSE], 'the next request')


@pytest.mark.needs('nav2_msgs')
def test_nothing_changes_after_a_ride_without_a_grid_or_map_server(showing, nav2):
    """A lift brings the robot to another floor while odometry shows rest."""
    with pytest.raises(handoff.HandOffError, match=r'image is 6\.0 s old, as by a lift'):
        showing.enter(1, age_s=6.0)
    with pytest.raises(handoff.NoLocalizerError, match="'floor_7' has no nav2_map"):
        showing.enter(7)
    showing.executor.shutdown()
    nav2._node.destroy_service(nav2.load_map)
    with pytest.raises(handoff.NoLocalizerError, match=r'serves .*load_map|load_map does not'):
        showing.enter(2, 1.5)
    assert not nav2.order and not showing.localizer.poses
