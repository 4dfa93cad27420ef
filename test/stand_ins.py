# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Localizers as their sources describe them: names, topics, quality of service, rates, habits.

nav2_amcl 1.3.13, beluga_amcl 2.1.1, slam_toolbox 2.8.3 (localization), robot_localization 3.8
(EKF in the map), mola_bridge_ros2 2.x. They adopt a pose with the next scan.
"""

from importlib.util import find_spec
from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SCAN_S = 0.1
# Where odometry places the robot.
ODOM_X_M = 3.0


class Kind(NamedTuple):
    """What a localizer does on the graph."""

    node: str
    takes: str = 'initialpose'
    depth: int = 10  #: of the subscription
    shows: str = ''  #: topic of its PoseWithCovarianceStamped
    profile: QoSProfile | int = 10  #: of that topic
    odometry: str = ''  #: topic of its Odometry
    child: str = 'odom'  #: frame that it places in the map by tf; '': no transform
    repeats: bool = True  #: whether it broadcasts before it has a pose


KINDS = {
    'amcl': Kind('amcl', shows='amcl_pose', profile=LATCHED, repeats=False),
    'beluga_amcl': Kind('amcl', shows='pose', repeats=False),
    'slam_toolbox': Kind('slam_toolbox', depth=1, shows='pose'),
    'robot_localization': Kind('ekf_filter_node_map', 'set_pose', 1,
                               odometry='odometry/filtered'),
    'mola': Kind('mola_bridge_ros2', odometry='lidar_odometry/pose'),
    'mola without odometry': Kind('mola_bridge_ros2', odometry='lidar_odometry/pose',
                                  child='base_link')}


class StandIn:
    """One of these localizers, as a node. Its transforms also go to `tell`.

    Without tf2_msgs, `/tf` has another type: only its place on the graph counts.
    """

    def __init__(self, make_node, kind, tell):
        self.kind, self._tell = kind, tell
        self.node = make_node(kind.node, cli_args=[
            '--ros-args', '-r', f'{kind.takes}:=initialpose'])
        #: Whether scans arrive, how far it is from the given pose, and all given poses.
        self.has_scans, self.off_m, self.given = True, 0.0, []
        self._is_new, self._x_m = False, 0.0
        self.node.create_subscription(PoseWithCovarianceStamped, kind.takes, self._take,
                                      kind.depth)
        self._pose = kind.shows and self.node.create_publisher(
            PoseWithCovarianceStamped, kind.shows, kind.profile)
        self._odometry = kind.odometry and self.node.create_publisher(
            Odometry, kind.odometry, 10)
        self._tf = self.node.create_publisher(_tf_type(), '/tf', 100)
        self.node.create_timer(SCAN_S, self._scan)

    def _take(self, pose):
        self.given.append(pose)
        self._is_new = True

    def _scan(self):
        if not self.has_scans:
            return
        if self._is_new:
            self._x_m = self.given[-1].pose.pose.position.x + self.off_m
        if self._is_new and self._pose:
            shown = PoseWithCovarianceStamped(header=self.given[-1].header)
            shown.pose.pose.position.x = self._x_m
            self._pose.publish(shown)
        if self.given or self.kind.repeats:
            placed = TransformStamped(child_frame_id=self.kind.child)
            placed.header.frame_id = 'map'
            placed.transform.translation.x = self._x_m - ODOM_X_M * (self.kind.child == 'odom')
            self._tell(placed, False)
        self._is_new = False


class Buffer:
    """Replaces tf2's buffer: odometry places the robot, who has been at rest since the start."""

    def lookup_transform(self, target, source, stamp, timeout):
        placed = TransformStamped()
        placed.transform.translation.x = ODOM_X_M * (target == 'odom')
        return placed


def _tf_type():
    if not find_spec('tf2_msgs'):
        return TransformStamped
    from tf2_msgs.msg import TFMessage
    return TFMessage
