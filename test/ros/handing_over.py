# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer's hand-over, a localizer, and the odometry of a robot."""

import math
import threading
import time
from dataclasses import replace

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from std_srvs.srv import Empty

from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumps
from cliploc_ros.ros.parameters import RelocalizerParameters

PARAMETERS = RelocalizerParameters(base_frame='base_link')

# Times of odometry since the image [s].
ONE_HZ, TEN_HZ = (0.0, 1.0, 2.0), tuple(tick / 10 for tick in range(10))


def stamp(seconds):
    return Time(sec=math.floor(seconds), nanosec=round(seconds % 1 * 1e9))


def make_pose():
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id, pose.header.stamp = 'map', Time(sec=100)
    return pose


class Localizer:
    """Replaces AMCL: receives initial poses, and answers update requests while it may."""

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
    """A relocalizer's hand-over and a localizer, whose callbacks are all executed."""

    def __init__(self, make_node, wait):
        self.node, self.wait = make_node('relocalizer'), wait
        self.localizer = Localizer(make_node('amcl'))
        self.odometry = OdometrySource(self.node)
        self.handoff = HandOff(self.node, self.odometry, CoordinateFrames(self.node))
        self.jumps = TimeJumps(self.node, self.odometry.forget)

    def hand_over(self, timeout_s=10.0, **changes):
        """Hand a pose over; return the elapsed time [s]."""
        start = time.monotonic()
        self.handoff.hand_over(make_pose(), replace(PARAMETERS, **changes), start + timeout_s,
                               start, self.jumps)
        return time.monotonic() - start

    def jump(self):
        """Make the relocalizer's clock jump: to simulated time, and back."""
        for is_simulated in (True, False):
            self.node.set_parameters([Parameter('use_sim_time', value=is_simulated)])

    def meet(self):
        """Wait until the relocalizer has discovered the localizer."""
        self.wait(lambda: self.handoff._publisher.get_subscription_count(), 'the subscriber')

    def meet_service(self):
        self.wait(self.handoff._updater.service_is_ready, 'the service')


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
