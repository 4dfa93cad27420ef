# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer's hand-over, a localizer, and the odometry of a robot."""

import threading
import time
from dataclasses import replace

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Empty

from cliploc_ros.ros.inputs.odometry import OdometrySource
from cliploc_ros.ros.outputs.handoff import HandOff
from cliploc_ros.ros.parameters import RelocalizerParameters

PARAMETERS = RelocalizerParameters(base_frame='base_link')

# Moments of odometry since the image [s].
ONE_HZ, TEN_HZ = (0.0, 1.0, 2.0), tuple(tick / 10 for tick in range(10))


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
        self.handoff.hand_over(make_pose(), replace(PARAMETERS, **changes), start + timeout_s,
                               start)
        return time.monotonic() - start

    def meet(self):
        """Wait until the relocalizer knows the localizer."""
        self.wait(lambda: self.handoff._publisher.get_subscription_count(), 'the subscriber')

    def meet_service(self):
        self.wait(self.handoff._updater.service_is_ready, 'the service')


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
