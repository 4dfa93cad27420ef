# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that drives to and fro in the simulated room, with an AMCL-like localizer."""

import time

import numpy as np
from frames import stamp
from nav_msgs.msg import Odometry
from scene import MAP_FROM_CAMERA, make_room, see_room
from std_msgs.msg import Header
from tester import PIXELS, RELIABLE, make_frame, transform_of

from cliploc_ros.core.geometry import transforms
from cliploc_ros.ros.conversions import pose_to_msg, pose_with_covariance_msg

ROOM = make_room()
# The camera looks along the base's x axis.
MOUNT = [0.0, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5]
BASE_FROM_CAMERA = transforms.transform_from_pose(np.array(MOUNT[:3]), np.array(MOUNT[3:]))
TICK_S, POSE_EVERY = 0.05, 5
# It turns around after this distance.
REACH_M = 0.5


def aside(metres):
    """Return a move (4, 4) along the image's rows."""
    return transforms.make_transform(np.eye(3), np.array([metres, 0.0, 0.0]))


class Robot:
    """Publishes a robot's topics, step by step, in real time."""

    def __init__(self, tester):
        self._tester, self._tick = tester, 0
        self._odom = tester.create_publisher(Odometry, 'odom', RELIABLE)
        self.speed_m_s, self._x, self._sign = 0.3, 0.0, 1.0
        #: (4, 4): start of its run of odometry; another pose after a kidnap.
        self.start = MAP_FROM_CAMERA @ aside(-1.5)
        #: The localizer's estimate of it.
        self.map_from_odom = self.start
        self.has_odom, self.has_localizer = True, True
        #: Returns the detected ones of the visible objects.
        self.sees = lambda seen: seen
        self.clock, self.on_tick = time.time, lambda now_s, map_from_odom, odom_from_base: None

    def close(self):
        self._tester.destroy_publisher(self._odom)

    @property
    def map_from_base(self):
        """The truth."""
        return self.start @ aside(self._x) @ transforms.invert_transform(BASE_FROM_CAMERA)

    def carry(self, metres):
        """Kidnap the robot; odometry and localizer do not register it."""
        self.start = self.start @ aside(metres)

    def step(self):
        """Drive for one tick."""
        if abs(self._x) > REACH_M:
            self._sign = -np.sign(self._x)
        self._x += self._sign * self.speed_m_s * TICK_S
        now_s = self.clock()
        header = Header(frame_id='odom', stamp=stamp(now_s))
        odom_from_base = aside(self._x) @ transforms.invert_transform(BASE_FROM_CAMERA)
        self.on_tick(now_s, self.map_from_odom, odom_from_base)
        if self.has_odom:
            odometry = Odometry(header=header, child_frame_id='base_link')
            odometry.pose.pose = pose_to_msg(odom_from_base)
            self._odom.publish(odometry)
        if self._tick % 2 == 0:
            seen = see_room(ROOM, self.map_from_base @ BASE_FROM_CAMERA)
            image, *others = make_frame(self.sees(seen), now_s)
            image.data = np.roll(PIXELS, self._tick).tobytes()  # a frozen image is a fault
            self._tester.publish((image, *others))
        if self._tester.initial_poses:  # as AMCL accepts it at rest
            given = transform_of(self._tester.initial_poses.pop().pose.pose)
            self.map_from_odom = given @ transforms.invert_transform(odom_from_base)
            self.show(odom_from_base, now_s)
        elif self._tick % POSE_EVERY == 0 and self.has_localizer:
            self.show(odom_from_base, now_s)
        self._tick += 1
        until = time.monotonic() + TICK_S
        while time.monotonic() < until:
            self._tester.spin()

    def show(self, odom_from_base, now_s):
        """Publish the localizer's pose."""
        shown = pose_with_covariance_msg(
            Header(frame_id='map', stamp=stamp(now_s)),
            self.map_from_odom @ odom_from_base, 0.01 * np.eye(6))
        self._tester.localizer._publisher.publish(shown)
