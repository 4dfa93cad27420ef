# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Localizers and Nav2 as their sources describe them: names, topics, QoS, rates, habits.

nav2_amcl and map_server 1.3.13, beluga_amcl 2.1.1, slam_toolbox (ROS 2, localization),
robot_localization (ROS 2, EKF in the map), mola_bridge_ros2 (2025).
"""

import math
import threading
import time
from importlib import import_module
from pathlib import Path

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Empty

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Odometry places the robot at this x.
ODOM_X_M = 3.0
# Name of the node, topic and depth of the subscription, topic of the pose with its QoS, topic of
# odometry, and the frame that it places in the map.
KINDS = {
    'amcl': ('amcl', 'initialpose', 10, 'amcl_pose', LATCHED, '', 'odom'),
    'beluga_amcl': ('amcl', 'initialpose', 10, 'pose', 10, '', 'odom'),
    'slam_toolbox': ('slam_toolbox', 'initialpose', 1, 'pose', 10, '', 'odom'),
    'robot_localization': ('ekf_filter_node_map', 'set_pose', 1, '', 10, 'odometry/filtered',
                           'odom'),
    'mola': ('mola_bridge_ros2', 'initialpose', 10, '', 10, 'lidar_odometry/pose', 'base_link'),
    'ros2 topic echo': ('echo', 'initialpose', 10, '', 10, '', '')}


class Localizer:
    """One of these localizers. It adopts a pose with its next scan, `off_m` away; NaN: no scans.

    Its transforms go to `tell`. `/tf` has another type, because tf2_msgs may not be installed:
    only its publisher counts.
    """

    def __init__(self, make_node, name, tell=lambda *_: None):
        node, takes, depth, shows, profile, odometry, self._child = KINDS[name]
        self.node = make_node(node, cli_args=['--ros-args', '-r', f'{takes}:=initialpose'])
        self._tell, self._x_m, self._is_new, self.off_m = tell, 0.0, False, 0.0
        self.poses, self.updates, self.may_answer = [], [], threading.Event()
        self.may_answer.set()
        self.node.create_subscription(PoseWithCovarianceStamped, takes, self._take, depth)
        self._pose = shows and self.node.create_publisher(
            PoseWithCovarianceStamped, shows, profile)
        if odometry:
            self.node.create_publisher(Odometry, odometry, 10)
        if self._child:
            self.node.create_publisher(TransformStamped, '/tf', 100)
        if node == 'amcl':
            self.node.create_service(Empty, 'request_nomotion_update', self._update,
                                     callback_group=ReentrantCallbackGroup())
        self.node.create_timer(0.1, self._scan)

    def _take(self, pose):
        self.poses.append(pose)
        self._is_new = True

    def _update(self, _, response):
        self.updates.append(time.monotonic())
        self.may_answer.wait()
        return response

    def _scan(self):
        if not math.isfinite(self.off_m):
            return
        if self._is_new:
            self._is_new, self._x_m = False, self.poses[-1].pose.pose.position.x + self.off_m
            self.show(self._x_m, self.poses[-1].header.stamp)
        placed = TransformStamped(child_frame_id=self._child)
        placed.header.frame_id = 'map'
        placed.transform.translation.x = self._x_m - ODOM_X_M * (self._child == 'odom')
        self._tell(placed, False)

    def show(self, x_m, stamp):
        shown = PoseWithCovarianceStamped()
        shown.header.frame_id, shown.header.stamp, shown.pose.pose.position.x = 'map', stamp, x_m
        if self._pose:
            self._pose.publish(shown)

    def lookup_transform(self, target, *_):
        """Replace tf2's buffer: odometry places a robot that has been at rest."""
        placed = TransformStamped()
        placed.transform.translation.x = ODOM_X_M * (target == 'odom')
        return placed


class Nav2:
    """map_server and the costmaps. `order` has what they and the localizer got.

    `broken` names the part that does not answer; the grid that is not published; or a bad result.
    """

    def __init__(self, node):
        types = import_module('nav2_msgs.srv')
        self._node, self.order, self.broken, self.ended = node, [], '', threading.Event()
        self.grids = node.create_publisher(OccupancyGrid, 'map', LATCHED)
        self.load_map = node.create_service(types.LoadMap, 'map_server/load_map', self._load)
        for name in ('global', 'local'):
            def clear(_, response, name=name):
                self._work(name)
                return response
            node.create_service(types.ClearEntireCostmap,
                                f'{name}_costmap/clear_entirely_{name}_costmap', clear)
        node.create_subscription(
            PoseWithCovarianceStamped, 'initialpose',
            lambda pose: self.order.append(f'pose in {pose.header.frame_id}'), 10)

    def _work(self, name):
        self.order.append(name)
        if name == self.broken:
            self.ended.wait()

    def _load(self, request, response):
        self._work(Path(request.map_url).stem)
        response.result = int(self.broken == 'result')
        response.map.header.frame_id = 'map'
        response.map.info.map_load_time = self._node.get_clock().now().to_msg()
        if self.broken not in ('result', 'grid'):
            self.grids.publish(response.map)
        return response
