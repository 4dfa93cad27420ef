# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A process that takes and shows poses as AMCL does, or fails to in one of the ways of AMCL.

It shows its pose after the first scan with a new one, and after one with an update that was
requested. Else a robot at rest has none shown. Arguments, as name=value:

deaf     this many poses are lost on their way: the subscription has not met their publisher
shows_x  this x in place of its own, or nan
at_x     set_initial_pose: it begins with a pose at this x, and shows it
"""

import math
import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Empty

SCAN_PERIOD_S = 0.1


class Amcl(Node):
    """The part of AMCL between initialpose and amcl_pose."""

    def __init__(self, deaf=0, shows_x=None, at_x=None):
        super().__init__('amcl')
        self.deaf, self.shows_x = int(deaf), shows_x
        self.pose, self.is_new, self.is_asked = None, False, False
        self.publisher = self.create_publisher(
            PoseWithCovarianceStamped, 'amcl_pose', QoSProfile(
                depth=1, reliability=ReliabilityPolicy.RELIABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.create_service(Empty, 'request_nomotion_update', self.update)
        self.create_timer(SCAN_PERIOD_S, self.scan)
        self.create_subscription(PoseWithCovarianceStamped, 'initialpose', self.take, 10)
        print('subscribed', flush=True)
        if at_x is not None:
            self.pose, self.is_new = PoseWithCovarianceStamped(), True
            self.pose.pose.pose.position.x = float(at_x)
            self.pose.pose.pose.orientation.w = 1.0

    def take(self, pose):
        if self.deaf:
            self.deaf -= 1
            print('lost', flush=True)
            return
        self.pose, self.is_new = pose, True
        print('took', flush=True)

    def update(self, _, response):
        self.is_asked = True
        return response

    def scan(self):
        if self.pose is None or not (self.is_new or self.is_asked):
            return
        self.is_new = self.is_asked = False
        q = self.pose.pose.pose.orientation  # AMCL is planar
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        shown = PoseWithCovarianceStamped()
        shown.header.frame_id, shown.header.stamp = 'map', self.get_clock().now().to_msg()
        shown.pose.pose.position.x = (self.pose.pose.pose.position.x if self.shows_x is None
                                      else float(self.shows_x))
        shown.pose.pose.position.y = self.pose.pose.pose.position.y
        shown.pose.pose.orientation.z = math.sin(yaw / 2)
        shown.pose.pose.orientation.w = math.cos(yaw / 2)
        self.publisher.publish(shown)


if __name__ == '__main__':
    rclpy.init()
    with suppress(ExternalShutdownException):
        rclpy.spin(Amcl(**dict(argument.split('=') for argument in sys.argv[1:])))
