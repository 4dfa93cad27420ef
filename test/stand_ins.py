# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Localizers and Nav2 as their sources describe them: names, topics, QoS, rates, habits.

nav2_amcl and map_server 1.3.13, beluga_amcl 2.1.1, slam_toolbox (ROS 2, localization),
robot_localization (ROS 2, EKF in the map), mola_bridge_ros2 (2025).
"""

import threading
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
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


class Nav2:
    """map_server and the costmaps. `order` has what they and the localizer got.

    `broken` names the part that fails: load_map ends with a `result`, or a part does not answer.
    """

    def __init__(self, node):
        types, group = import_module('nav2_msgs.srv'), ReentrantCallbackGroup()
        self._node, self.order, self.broken, self.ended = node, [], '', threading.Event()
        self._grids = node.create_publisher(OccupancyGrid, 'map', LATCHED)
        self._load_map = node.create_service(types.LoadMap, 'map_server/load_map', self._load)
        for name in ('global', 'local'):
            def clear(_, response, name=name):
                self._work(name)
                return response
            node.create_service(types.ClearEntireCostmap, callback=clear, callback_group=group,
                                srv_name=f'{name}_costmap/clear_entirely_{name}_costmap')
        node.create_subscription(
            PoseWithCovarianceStamped, 'initialpose',
            lambda pose: self.order.append(f'pose in {pose.header.frame_id}'), 10)

    def _work(self, name):
        self.order.append(name)
        if name in self.broken:
            self.ended.wait()

    def _load(self, request, response):
        self._work(Path(request.map_url).stem)
        response.result = int(self.broken == 'result')
        if not response.result:
            response.map = self.make_grid()
            if self.broken != 'grid':
                self._grids.publish(response.map)
        return response

    def make_grid(self):
        grid = OccupancyGrid(data=[0, 100, -1])
        grid.info.map_load_time = self._node.get_clock().now().to_msg()
        grid.header.frame_id = 'map'
        return grid

    def load_another(self):
        """Publish another grid, as if another program had called load_map."""
        self._grids.publish(self.make_grid())

    def kill_map_server(self):
        self._node.destroy_service(self._load_map)


def _tf_type():
    if not find_spec('tf2_msgs'):
        return TransformStamped
    from tf2_msgs.msg import TFMessage
    return TFMessage
