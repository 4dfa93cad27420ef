# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A simulation that is reset while a robot moves: real /clock and odometry."""

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from processes import wait_for
from rosgraph_msgs.msg import Clock
from scene import MAP_FROM_CAMERA, see_room
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from tester import RELIABLE, make_frame, transform_of
from watched import BASE_FROM_CAMERA, MOUNT, ROOM, stamp

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.ros.conversions import pose_to_msg

STEP_S = 0.02


class World:
    """A robot that turns to and fro; each run has an odometry origin and headings of its own."""

    def __init__(self, tester, now_s):
        self._tester, self.now_s, self._run = tester, now_s, 0
        self._clock = tester.create_publisher(Clock, '/clock', RELIABLE)
        self._odom = tester.create_publisher(Odometry, 'odom', RELIABLE)

    def close(self):
        for publisher in (self._clock, self._odom):
            self._tester.destroy_publisher(publisher)

    def map_from_camera(self, at_s):
        """Return the camera's pose: the robot turns by 10 degrees within 2 s and back."""
        degrees = 5.0 * np.sin(np.pi * at_s / 2.0) + 4.0 * (self._run % 3) - 4.0
        return MAP_FROM_CAMERA @ make_transform(
            Rotation.from_euler('y', degrees, degrees=True).as_matrix(), np.zeros(3))

    def map_from_base(self, at_s):
        return self.map_from_camera(at_s) @ invert_transform(BASE_FROM_CAMERA)

    def reset(self, now_s):
        """Begin another run at a time."""
        self.now_s, self._run = now_s, self._run + 1
        self._clock.publish(Clock(clock=stamp(now_s)))

    def step(self):
        """Go on by 0.1 s, with an image in the middle."""
        odom_from_map = make_transform(
            Rotation.from_euler('z', 70.0 * self._run, degrees=True).as_matrix(),
            np.array([3.0 * self._run, -4.0, 0.0]))
        for tick in range(5):
            self._clock.publish(Clock(clock=stamp(self.now_s)))
            odometry = Odometry(child_frame_id='base_link',
                                header=Header(frame_id='odom', stamp=stamp(self.now_s)))
            odometry.pose.pose = pose_to_msg(odom_from_map @ self.map_from_base(self.now_s))
            self._odom.publish(odometry)
            if tick == 2:
                at_s = self.now_s - STEP_S / 2
                self._tester.publish(make_frame(see_room(ROOM, self.map_from_camera(at_s)), at_s))
            self.now_s = round(self.now_s + STEP_S, 6)
        for _ in range(6):
            self._tester.spin()

    def check(self):
        """Request a pose; check that it is the robot's in the present run."""
        future = self._tester.ask()
        wait_for(future.done, 'an answer', work=self.step)
        assert future.result().success, future.result().message
        self._tester.wait(lambda: self._tester.poses and self._tester.initial_poses, 'the poses')
        pose = self._tester.poses[-1]
        at_s = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
        error_m, error_deg = pose_error(transform_of(pose.pose.pose), self.map_from_base(at_s))
        assert error_m < 0.05 and error_deg < 1.0, (error_m, error_deg)
        self._tester.forget()


@pytest.mark.parametrize(('before_s', 'back_s'), [(100.0, 5.0), (600.0, 598.0)])
def test_the_first_request_after_a_reset_is_right(own_relocalizer, tester, before_s, back_s):
    process = own_relocalizer(
        base_from_camera=MOUNT, base_frame='base_link', algorithm='auto', use_sim_time=True,
        max_speed_m_s=10.0, max_turn_rad_s=10.0, timeout_s=20.0)
    world = World(tester, before_s)
    for _ in range(10):
        world.step()
    world.check()
    world.reset(world.now_s - back_s)
    world.check()
    world.close()
    assert 'jumped back' in process.output()
    assert process.alive and 'Traceback' not in process.output()
