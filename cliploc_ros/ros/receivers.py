# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a pose is handed over to: the running localizer, and Nav2's grid of the pose's floor.

`initialpose` is volatile: the publisher may have discovered a subscription that has not yet
discovered the publisher. DDS also reports a localizer that was killed or hangs as alive. Only the
pose that the localizer shows afterwards proves that it took the given pose.
"""

import importlib
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.node import Node, NodeNameNonExistentError

from cliploc_ros.core.geometry.transforms import TAKEN, pose_error
from cliploc_ros.errors import NoLocalizerError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import matrix_from_msg, pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.parameters import AUTO, RelocalizerParameters

# Localizers broadcast their former transform until the next scan, which comes within this time.
_SCAN_S = 0.5
_POLL_S = 0.02
_SERVICES = (('LoadMap', 'map_server/load_map'), *(
    ('ClearEntireCostmap', f'{name}_costmap/clear_entirely_{name}_costmap')
    for name in ('global', 'local')))


class RunningLocalizer:
    """Gives poses to the localizer on `initialpose`, and receives the poses that it shows.

    With ``localizer_pose: auto``, the localizer is the node that subscribes to `initialpose` and
    publishes a pose. If that node is silent or publishes none, its transform from the map shows
    where it is. `transforms` looks up the rest of the way to the robot.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node, self._transforms = node, transforms
        #: Notified when the localizer shows a pose
        self.changed, self._finding = threading.Condition(), threading.Lock()
        #: Full name of the topic of its pose, empty if it is unknown or in tf alone; and when it
        #: was last heard (monotonic clock) [s]
        self.pose_topic, self.shown_at = '', -math.inf
        #: Called with each pose on its topic; must not block
        self.listeners: list[Callable[[PoseWithCovarianceStamped], None]] = []
        self._name, self._parameters = '', RelocalizerParameters()  # no name while closed
        # The last given pose and when it was given, what the localizer has shown since, and
        # whether its transforms count.
        self._given: PoseWithCovarianceStamped | None = None
        self._shown: PoseWithCovarianceStamped | None = None
        self._transform: TransformStamped | None = None
        self._given_at, self._is_in_tf = -math.inf, False
        self._subscription: qos.AdaptiveSubscription | None = None
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE)
        transforms.listeners.append(self._hear_transform)

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the pose of the localizer, as soon as it is found."""
        self._name, self._parameters = parameters.localizer_pose, parameters
        self.find()

    def close(self) -> None:
        """Unsubscribe, and forget the localizer."""
        self._name, self._given = '', None
        self.find()

    def missing(self) -> str:
        """Return why there is no localizer, and what to do; empty if there is one."""
        if not self._publisher.get_subscription_count():
            return (f'nobody subscribes to {self._publisher.topic_name}: start the localizer '
                    '(AMCL), then retry; without one, set require_localizer: false')
        return self.find()

    def find(self) -> str:
        """Find the localizer's pose, and listen to it; return what is wrong, empty if nothing."""
        tf = str(self._node.resolve_topic_name('/tf'))
        with self._finding:
            found = sorted(self._found(tf))
            if len(found) > 1:
                return (f'several localizers: {", ".join(f"{b} on {a}" for a, b in found)}; '
                        'stop all but one')
            topic = next((topic for topic, _ in found if topic != tf), '')
            if topic != self.pose_topic:
                if self._subscription is not None:
                    self._subscription.destroy()
                # Volatile, so that no earlier pose of the localizer is delivered.
                self._subscription = qos.AdaptiveSubscription(
                    self._node, PoseWithCovarianceStamped, topic, self._hear, qos.POSE
                    ) if topic else None
                self.pose_topic = topic
            return self._open_tf() if found and not topic else '' if topic or not self._name else (
                f"nobody publishes the localizer's pose (localizer_pose: {self._name}): start the "
                'localizer (AMCL); if it has just started, retry; or set localizer_pose')

    def give(self, pose: PoseWithCovarianceStamped) -> None:
        """Publish a pose on `initialpose`, and forget what the localizer has shown before."""
        with self.changed:
            was_silent = self._given is not None and self.shown() is None
            self._is_in_tf = self._name == AUTO and (not self.pose_topic or was_silent)
            self._given, self._shown, self._transform = pose, None, None
            self._given_at = time.monotonic()
        if self._is_in_tf:
            self._open_tf()
        self._publisher.publish(pose)

    def shown(self) -> PoseWithCovarianceStamped | None:
        """Return the newest pose that it has shown since the last given one; None without one.

        A transform is extended by odometry at the stamp of the given pose: there it may be
        compared although the robot has driven off.
        """
        given, transform = self._given, self._transform
        if self._shown is not None or transform is None or given is None:
            return self._shown
        with suppress(NoTransformError):
            odom_from_base = self._transforms.lookup(
                transform.child_frame_id, self._parameters.base_frame, given.header.stamp, 0.0)
            return pose_with_covariance_msg(given.header, matrix_from_msg(
                transform.transform) @ odom_from_base, np.zeros((6, 6)))
        return None

    def silence(self) -> str:
        """Return what to do about a localizer that shows no pose."""
        topic = self._node.resolve_topic_name('map')
        no_map = '' if self._node.count_publishers(topic) else (
            f'nobody publishes {topic}, without which AMCL has no pose: start its map server; ')
        return f'{no_map}check that the localizer is active and receives scans'

    def _nodes(self, kind: str, topic: str) -> set[str]:
        """Return its publishers or subscriptions; after a restart, one is listed twice."""
        return {f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in getattr(
            self._node, f'get_{kind}_info_by_topic')(topic)}

    def _found(self, tf: str) -> set[tuple[str, str]]:
        """Return all topics that show its pose, each with a publisher."""
        node, given_on = self._node, self._publisher.topic_name
        takers = self._nodes('subscriptions', given_on) if self._name == AUTO else set()
        topics = {str(node.resolve_topic_name(name)) for name in {self._name} - {'', AUTO}}
        # a node that is not discovered yet has a namespace without '/'
        for space, _, name in (taker.rpartition('/') for taker in takers if taker[0] == '/'):
            with suppress(NodeNameNonExistentError):  # it has ended, or is not fully discovered
                topics |= {topic for topic, types in node.get_publisher_names_and_types_by_node(
                    name, space or '/') if 'geometry_msgs/msg/PoseWithCovarianceStamped' in types}
        topics -= {given_on, node.resolve_topic_name('~/prior')}
        return {(topic, one) for topic in topics for one in self._nodes('publishers', topic)
                } or {(tf, one) for one in takers & self._nodes('publishers', tf)}

    def _open_tf(self) -> str:
        """Listen to transforms; return why they cannot show the localizer's pose, else ''."""
        try:
            self._transforms.open('the localizer shows its pose in tf alone',
                                  remedy='set localizer_pose to the topic of its pose')
        except NoTransformError as error:
            return str(error)
        return ''

    def _hear(self, shown: PoseWithCovarianceStamped) -> None:
        if self._name == AUTO and shown == self._given:
            return  # a relay, as from initialpose to set_pose, is no localizer
        with self.changed:
            self._shown, self.shown_at = shown, time.monotonic()
            self.changed.notify_all()
        for listener in self.listeners:
            listener(shown)

    def _hear_transform(self, transform: TransformStamped, is_static: bool) -> None:
        if self._is_in_tf and not is_static and not self._parameters.publish_tf and (
                self._given is not None and _same_frame(transform, self._given)
                and time.monotonic() > self._given_at + _SCAN_S):
            with self.changed:
                self._transform = transform
                self.changed.notify_all()


class Floors:
    """Loads the grid of the map that an accepted pose is in, and clears both costmaps.

    Only the message on `map` proves which grid is loaded, because other programs may load others:
    unless it equals the grid in the last answer of map_server, the loaded floor is unknown.
    `stopped` ends a wait.
    """

    def __init__(self, node: Node, stopped: threading.Event) -> None:
        self._node, self._stopped = node, stopped
        self._clients: list[Any] = []
        self._grid = OccupancyGrid()
        self._answer: tuple[str, OccupancyGrid | None] = '', None  # the floor and its grid

    @property
    def loaded(self) -> dict[str, str]:
        """Return {coordinate frame of the grid: frame_id of its map}; empty if unknown."""
        floor, grid = self._answer
        return {self._grid.header.frame_id: floor} if grid == self._grid else {}

    def enter(self, floor: str, grids: Mapping[str, str], deadline: float) -> None:
        """Load the grid of a floor, and clear both costmaps.

        Parameters
        ----------
        floor : str
            frame_id of the map.
        grids : mapping
            File of the grid of each floor.
        deadline : float
            When to return at the latest (monotonic clock) [s].

        Raises
        ------
        NoLocalizerError
            A step failed, or time was up; the message names the step.
        """
        if floor not in grids:
            raise NoLocalizerError(f"the map '{floor}' has no nav2_map: name its grid there")
        load, *clears = self._clients = self._clients or self._open()
        self._wait(load.service_is_ready, deadline,
                   f'nobody serves {load.service_name}: activate map_server')
        answer = self._request(floor, grids)
        self._wait(answer.done, deadline, f'{load.service_name} does not answer')
        result = answer.result().result
        self._wait(lambda: bool(self.loaded), -math.inf if result else deadline,
                   f'{load.service_name}: result {result}, and no such grid on map: correct '
                   f'{grids[floor]}, or activate map_server')
        for clear in clears:
            if clear.service_is_ready():  # otherwise there is nothing to clear
                self._wait(clear.call_async(clear.srv_type.Request()).done, deadline,
                           f'{clear.service_name} does not answer')

    def restore(self, before: Mapping[str, str], grids: Mapping[str, str]) -> str:
        """Request the grid that was loaded before, without a wait; return words about it."""
        if self.loaded != before:
            self._answer = '', None  # unknown
            for floor in before.values():
                self._request(floor, grids)
                return f"; the grid of '{floor}' is requested again"
        return ''

    def _open(self) -> list[Any]:
        try:
            types = importlib.import_module('nav2_msgs.srv')
        except ImportError as error:
            raise NoLocalizerError('nav2_map needs nav2_msgs: sudo apt install '
                                   'ros-jazzy-nav2-msgs') from error
        self._node.create_subscription(OccupancyGrid, 'map', self._hear, qos.LATCHED)
        return [self._node.create_client(getattr(types, kind), name) for kind, name in _SERVICES]

    def _hear(self, grid: OccupancyGrid) -> None:
        self._grid = grid

    def _request(self, floor: str, grids: Mapping[str, str]) -> Any:
        self._answer = '', None
        load = self._clients[0]
        future = load.call_async(load.srv_type.Request(map_url=grids[floor]))
        future.add_done_callback(lambda done: self._keep(floor, done.result()))
        return future

    def _keep(self, floor: str, answer: Any) -> None:
        """Keep the answer, also a late one: map_server answers in the order of the requests."""
        if answer is not None and not answer.result:
            self._answer = floor, answer.map

    def _wait(self, condition: Callable[[], bool], until: float, problem: str) -> None:
        while not condition():
            if self._stopped.wait(_POLL_S) or time.monotonic() > until:
                raise NoLocalizerError(problem)


def difference(given: PoseWithCovarianceStamped, shown: PoseWithCovarianceStamped) -> str:
    """Return how the localizer's pose `shown` differs from the given one; empty if they agree."""
    if not _same_frame(given, shown):
        return (f"is in frame '{shown.header.frame_id}', the pose in '{given.header.frame_id}': "
                "correct the map's frame_id")
    covariance = np.array(given.pose.covariance).reshape(6, 6)
    deviation_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    near = TAKEN.wider(3.0 * deviation_m, math.degrees(3.0 * math.sqrt(covariance[5, 5])))
    if near.agree(_planar(given), _planar(shown)):
        return ''
    if not np.isfinite(_planar(shown)).all():
        return 'has NaN'
    distance_m, angle_deg = pose_error(_planar(given), _planar(shown))
    return (f'differs from it by {distance_m:.2f} m and {angle_deg:.0f} degrees (limits '
            f'{near.distance_m:.2f} and {near.angle_deg:.0f})')


def _same_frame(one: PoseWithCovarianceStamped | TransformStamped,
                other: PoseWithCovarianceStamped) -> bool:
    return bool(one.header.frame_id.lstrip('/') == other.header.frame_id.lstrip('/'))


def _planar(msg: PoseWithCovarianceStamped) -> NDArray[np.float64]:
    """Return the part of a pose that AMCL uses, x, y and yaw, as a transform (4, 4)."""
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, p.x], [s, c, 0, p.y], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
