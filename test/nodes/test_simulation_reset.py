# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulation that is reset while a robot moves: real /clock, odometry and transforms."""


import numpy as np
import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from processes import wait_for
from rosgraph_msgs.msg import Clock
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tester import RELIABLE, make_frame, transform_of

from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    make_transform,
    pose_error,
    transform_from_pose,
)
from cliploc_ros.ros.conversions import pose_to_msg
from cliploc_ros.ros.outputs.map_to_odom import transform_msg

ROOM = make_room()
# The camera looks along the base's x axis.
MOUNT = [0.0, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5]
BASE_FROM_CAMERA = transform_from_pose(np.array(MOUNT[:3]), np.array(MOUNT[3:]))
CAMERA_FRAME = 'camera_optical_frame'
STEP_S = 0.02
PARAMETERS = {'base_frame': 'base_link', 'algorithm': 'auto', 'use_sim_time': True,
              'max_speed_m_s': 10.0, 'max_turn_rad_s': 10.0, 'timeout_s': 20.0,
              'tf_timeout_s': 2.0}


def stamp(seconds):
    return Time(sec=int(seconds), nanosec=round((seconds % 1) * 1e9))


class World:
    """A simulation of a robot that turns to and fro, with odometry and, on demand, a lift.

    Each run has its own origin of odometry, headings of the robot and heights of the lift.
    """

    def __init__(self, tester, with_transforms):
        self._tester = tester
        self._clock = tester.create_publisher(Clock, '/clock', RELIABLE)
        self._odom = tester.create_publisher(Odometry, 'odom', RELIABLE)
        self._tf = None
        if with_transforms:
            from tf2_msgs.msg import TFMessage
            self._tf = tester.create_publisher(TFMessage, '/tf', 100)
        self.now_s, self._run, self._number = 0.0, 0, 0
        #: How many boxes an image shows at most.
        self.boxes = 12

    def close(self):
        for publisher in filter(None, (self._clock, self._odom, self._tf)):
            self._tester.destroy_publisher(publisher)

    def reset(self, now_s):
        """Begin another run at a time."""
        self.now_s, self._run = now_s, self._run + 1
        self.tell_time()

    def tell_time(self):
        self._clock.publish(Clock(clock=stamp(self.now_s)))

    def map_from_camera(self, at_s):
        """Return the camera's pose: the robot turns by 10 degrees within 2 s and back."""
        degrees = 5.0 * np.sin(np.pi * at_s / 2.0) + 4.0 * (self._run % 3) - 4.0
        return MAP_FROM_CAMERA @ make_transform(
            Rotation.from_euler('y', degrees, degrees=True).as_matrix(), np.zeros(3))

    def base_from_camera(self, at_s):
        """Return the mount, on a lift that rises if there are transforms."""
        if self._tf is None:
            return BASE_FROM_CAMERA
        lift = np.array([0.0, 0.0, 0.3 * ((at_s + 2.0 * self._run) % 5.0)])
        return make_transform(np.eye(3), lift) @ BASE_FROM_CAMERA

    def map_from_base(self, at_s):
        return self.map_from_camera(at_s) @ invert_transform(self.base_from_camera(at_s))

    def odom_from_base(self, at_s):
        run = make_transform(Rotation.from_euler('z', 70.0 * self._run, degrees=True).as_matrix(),
                             np.array([3.0 * self._run, -4.0, 0.0]))
        return run @ self.map_from_base(at_s)

    def frame(self, at_s):
        """Return the messages of an image."""
        boxes = see_room(ROOM, self.map_from_camera(at_s))
        rows = np.argsort(np.abs(boxes.bboxes_xyxy[:, 0] - CAMERA.cx))[:self.boxes]
        return make_frame(boxes.select(np.sort(rows)), at_s)

    def step(self):
        """Go on by 0.1 s, with an image in the middle."""
        for tick in range(5):
            self.tell_time()
            self._tell_places()
            if tick == 2:
                self._tester.publish(self.frame(self.now_s - STEP_S / 2))
            self._number += 1
            self.now_s = round(self.now_s + STEP_S, 6)
        for _ in range(6):
            self._tester.spin()

    def _tell_places(self):
        odometry = Odometry(child_frame_id='base_link',
                            header=Header(frame_id='odom', stamp=stamp(self.now_s)))
        odometry.pose.pose = pose_to_msg(self.odom_from_base(self.now_s))
        self._odom.publish(odometry)
        if self._tf is None:
            return
        from tf2_msgs.msg import TFMessage
        self._tf.publish(TFMessage(transforms=[
            transform_msg(odometry.header, 'base_link', self.odom_from_base(self.now_s)),
            transform_msg(Header(frame_id='base_link', stamp=odometry.header.stamp), CAMERA_FRAME,
                          self.base_from_camera(self.now_s))]))

    def go_on(self, seconds):
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.step()

    def ask(self):
        """Ask, and go on until there is an answer; return it."""
        future = self._tester.ask()
        wait_for(future.done, 'an answer', work=self.step)
        return future.result()

    def check(self, answer):
        """Check that an answer is the robot's pose in the present run."""
        assert answer.success, answer.message
        self._tester.wait(lambda: self._tester.poses and self._tester.initial_poses, 'the poses')
        pose = self._tester.poses[-1]
        at_s = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
        error_m, error_deg = pose_error(transform_of(pose.pose.pose), self.map_from_base(at_s))
        assert error_m < 0.05 and error_deg < 1.0, (error_m, error_deg)
        self._tester.forget()


@pytest.fixture
def world(own_relocalizer, tester):
    """A simulation at 100 s, and a relocalizer in it whose camera is fixed."""
    process = own_relocalizer(base_from_camera=MOUNT, **PARAMETERS)
    world = World(tester, with_transforms=False)
    world.process = process
    world.now_s = 100.0
    yield world
    world.close()
    assert process.alive and 'Traceback' not in process.output()


@pytest.mark.parametrize(('before_s', 'back_s'), [
    (100.0, 5.0), (600.0, 598.0)])
def test_the_first_request_after_a_reset_is_right(world, before_s, back_s):
    world.now_s = before_s
    world.go_on(1.0)
    world.check(world.ask())
    world.reset(world.now_s - back_s)
    world.check(world.ask())
    assert 'time jumped back by ' in world.process.output()


@pytest.fixture
def lifted(own_relocalizer, tester):
    """The same with a camera on a lift and with map -> odom: all uses of tf2."""
    process = own_relocalizer(publish_tf=True, **PARAMETERS)
    world = World(tester, with_transforms=True)
    world.process = process
    world.now_s = 100.0
    yield world
    world.close()
    assert process.alive and 'Traceback' not in process.output()


@pytest.mark.needs('tf2_ros')
@pytest.mark.parametrize(('before_s', 'back_s'), [(100.0, 3.007), (600.0, 598.0)])
def test_transforms_from_before_a_reset_are_not_used(lifted, before_s, back_s):
    """Neither between two of them nor in their place: the lift was elsewhere at that time."""
    lifted.now_s = before_s
    lifted.go_on(4.0)
    lifted.check(lifted.ask())
    lifted.reset(lifted.now_s - back_s)
    lifted.check(lifted.ask())
    lifted.check(lifted.ask())


@pytest.mark.needs('tf2_ros')
def test_map_to_odom_is_dropped_at_a_reset(lifted, tester):
    from tf2_msgs.msg import TFMessage
    heard = []
    subscription = tester.create_subscription(TFMessage, '/tf', lambda msg: heard.extend(
        one for one in msg.transforms if one.header.frame_id == 'map'), 100)
    lifted.go_on(1.0)
    lifted.check(lifted.ask())
    wait_for(lambda: heard, 'map -> odom', work=lifted.step)
    lifted.reset(95.0)
    wait_for(lambda: 'time jumped back by ' in lifted.process.output(), 'the jump',
             work=lifted.tell_time)
    lifted.go_on(1.0)
    heard.clear()
    lifted.go_on(1.0)
    assert not heard, 'it says where odometry began in the other run'
    lifted.check(lifted.ask())
    wait_for(lambda: heard, 'map -> odom again', work=lifted.step)
    t, q = heard[-1].transform.translation, heard[-1].transform.rotation
    map_from_odom = transform_from_pose(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))
    at_s = lifted.now_s
    assert pose_error(map_from_odom @ lifted.odom_from_base(at_s), lifted.map_from_base(at_s)) < (
        0.05, 1.0)
    tester.destroy_subscription(subscription)
