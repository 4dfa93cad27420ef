# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom, and transforms before and after a jump; mostly with the real tf2_ros."""

import time
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest
from frames import stamp
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.ros.conversions import transform_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumpError
from cliploc_ros.ros.map_to_odom import MapToOdom
from cliploc_ros.ros.parameters import RelocalizerParameters

PARAMETERS = RelocalizerParameters(base_frame='base_link', tf_timeout_s=5.0)
QUARTER_LEFT = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
MAP_FROM_BASE = transform_from_pose(np.array([5.0, 5.0, 0.0]), np.array(QUARTER_LEFT))


STAMP = stamp(100.0)


def moving(seconds, x_m, parent='odom', child='base_link'):
    """Return a transform of a robot that is x_m ahead and turned to the left."""
    return transform_msg(Header(frame_id=parent, stamp=stamp(seconds)), child,
                         transform_from_pose(np.array([x_m, 0.0, 0.0]), np.array(QUARTER_LEFT)))


class Robot:
    """A node with transforms and map -> odom, and a broadcaster and subscriber of /tf."""

    def __init__(self, make_node, spin_until):
        from tf2_msgs.msg import TFMessage
        from tf2_ros import StaticTransformBroadcaster, TransformBroadcaster
        self.node, self.world = make_node(), make_node('world')
        self.transforms = CoordinateFrames(self.node)
        self.map_to_odom = MapToOdom(self.node, self.transforms)
        self.odometry = OdometrySource(self.node)
        self.odometry.on_restart(self.map_to_odom.forget)
        self.broadcaster = TransformBroadcaster(self.world)
        self.static_broadcaster = StaticTransformBroadcaster(self.world)
        self.heard = []
        self.world.create_subscription(TFMessage, '/tf', lambda msg: self.heard.extend(
            transform for transform in msg.transforms if transform.header.frame_id == 'map'), 10)
        self._spin_until = spin_until
        self.transforms.open()

    def spin_until(self, condition, what, work=lambda: None):
        self._spin_until([self.node, self.world], condition, what, work)

    def place(self, seconds, source='base_link'):
        """Return the robot's x according to tf2; None if tf2 has no transform."""
        try:
            return self.transforms.lookup('odom', source, stamp(seconds), 0.0)[0, 3]
        except NoTransformError:
            return None

    def tell(self, seconds, x_m):
        """Broadcast the robot's pose until it is received."""
        self.spin_until(lambda: self.place(seconds) == x_m, f'{x_m} m at {seconds} s',
                        lambda: self.broadcaster.sendTransform(moving(seconds, x_m)))


    def tell_odometry(self, seconds, x_m):
        """Take one message of odometry."""
        odometry = Odometry(header=Header(frame_id='odom', stamp=stamp(seconds)),
                            child_frame_id='base_link')
        odometry.pose.pose.position.x = x_m
        self.odometry.take(odometry)


@pytest.fixture
def robot(make_node, spin_until):
    robot = Robot(make_node, spin_until)
    yield robot
    robot.map_to_odom.close()
    robot.transforms.close()


@pytest.mark.needs('tf2_ros')
@pytest.mark.parametrize(('restart_s', 'x_m'), [
    (100.0, None),  # the clock jumps
    (103.0, 2.5), (2.0, 1.0)])  # odometry restarts, and no clock jumps
def test_a_jump_or_a_restart_ends_the_broadcast_until_the_next_pose(robot, restart_s, x_m):
    """Its origin is reset, at once or during a silence, or a bag loops."""
    robot.map_to_odom.open()
    robot.tell(100.0, 1.0)
    robot.tell_odometry(99.9, 1.0)
    robot.tell_odometry(100.0, 1.0)
    received_at = time.monotonic()
    header = Header(frame_id='map', stamp=STAMP)
    robot.map_to_odom.update(header, MAP_FROM_BASE, PARAMETERS, received_at)
    robot.spin_until(lambda: robot.heard, 'map -> odom')
    t = robot.heard[0].transform.translation
    # the same heading in both, so odom is a metre behind along its x axis
    np.testing.assert_allclose([t.x, t.y, t.z], [4.0, 5.0, 0.0], atol=1e-9)
    assert robot.heard[0].child_frame_id == 'odom'
    if x_m is None:
        robot.map_to_odom.forget()
    else:
        robot.tell_odometry(restart_s, x_m)
    # images from before: the search ends after the restart, or the image arrives after it
    for at in (received_at, time.monotonic())[:1 if restart_s <= 100.0 else 2]:
        with pytest.raises(TimeJumpError):
            robot.map_to_odom.update(header, MAP_FROM_BASE, PARAMETERS, at)
    robot.spin_until(lambda: robot.world.count_publishers('/tf') == 2, 'messages in transit')
    robot.heard.clear()
    end = time.monotonic() + 0.5  # five periods
    robot.spin_until(lambda: time.monotonic() > end, 'silence')
    assert not robot.heard
    if x_m is not None:
        robot.tell(restart_s, 2.0)
    robot.map_to_odom.update(Header(frame_id='map', stamp=stamp(restart_s)), MAP_FROM_BASE,
                             PARAMETERS, time.monotonic())
    robot.spin_until(lambda: robot.heard, 'map -> odom again')
    assert robot.heard[-1].transform.translation.x == pytest.approx(4.0 if x_m is None else 3.0)


def test_map_to_odom_pauses_while_another_node_broadcasts_it(make_node):
    frames, sent = CoordinateFrames(node := make_node()), []
    map_to_odom = MapToOdom(node, frames)
    map_to_odom._broadcaster = SimpleNamespace(sendTransform=lambda t: sent.append(deepcopy(t)))
    map_to_odom._transform, map_to_odom._timer = moving(100.0, 0.0, 'map', 'odom'), 'open'
    map_to_odom._broadcast()
    frames.listeners[-1](sent[0], False)
    frames.listeners[-1](moving(100.0, 0.0), False)
    assert map_to_odom.rival('odom') == '', 'its own transform, and that of odometry'
    frames.listeners[-1](moving(100.0, 0.0, 'map', '/odom'), False)
    map_to_odom._broadcast()
    assert len(sent) == 1
    map_to_odom._others.clear()
    with pytest.raises(NoTransformError, match='contradicts the earlier poses'):
        map_to_odom.pause()
    map_to_odom._broadcast()
    assert len(sent) == 1, 'poses contradict each other'
    frames_of_others = moving(100.0, 0.0, 'map', '/odom')
    map_to_odom.hear(frames_of_others, False)
    with pytest.raises(NoTransformError, match=r"'map' -> 'odom'.*publish_tf"):
        map_to_odom.update(Header(frame_id='map'), np.eye(4), PARAMETERS, 0.0)


@pytest.mark.needs('tf2_ros')
def test_transforms_from_before_a_jump_are_forgotten(robot):
    robot.static_broadcaster.sendTransform(moving(0.0, 7.0, child='shelf'))
    robot.spin_until(lambda: robot.place(0.0, 'shelf') == 7.0, 'the static transform')
    for seconds, x_m in ((99.0, 1.0), (100.0, 2.0)):
        robot.tell(seconds, x_m)
    robot.transforms.forget()
    assert robot.place(99.5) is None and robot.place(100.0) is None
    assert robot.place(0.0, 'shelf') == 7.0, 'the transform is not repeated'
    # a late message from before
    robot.tell(100.02, 3.0)
    for seconds, x_m in ((95.0, 11.0), (96.0, 12.0)):
        robot.tell(seconds, x_m)
    assert robot.place(95.5) == pytest.approx(11.5)
    assert robot.place(97.0) is None, 'no interpolation across the jump'
