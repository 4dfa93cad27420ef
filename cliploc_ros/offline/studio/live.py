# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A connection to the running relocalizer: its last answer, and requests.

This is the only module of the studio that imports ROS. The studio also runs without ROS.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.ros import qos
from cliploc_ros.ros.clients import RelocalizerStatus, check_name
from cliploc_ros.ros.conversions import pose_from_msg
from cliploc_ros.ros.node.diagnostics import split_names

# The relocalizer reports once a second, but may be late while it loads libraries. Not measured.
_SILENCE_S = 10.0
# Longest wait for an answer, beyond any sensible timeout_s of the relocalizer.
_PATIENCE_S = 120.0
_POLL_S = 0.1
# Longest wait for a released request when the connection is closed.
_GRACE_S = 2.0
# Answers without a delivered pose that are not failures.
_ANSWERS = ('refused', 'withheld')
_MAX_TEXT = 600


class LiveError(CliplocError):
    """A request to the running relocalizer failed; the message says why."""


class LivePose(NamedTuple):
    """A pose that the relocalizer accepted."""

    #: Pose (4, 4) of the camera, or of the robot if the relocalizer has a base_frame
    map_from_body: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: Covariance (3, 3) of the position [m^2]
    frame_id: str  #: The coordinate frame of the pose
    stamp_s: float  #: Stamp of the image [s]


class LiveState(NamedTuple):
    """The last reports of the running relocalizer."""

    is_heard: bool  #: Whether the last diagnostics are recent
    values: Mapping[str, str]  #: Values of the last diagnostics
    pose: LivePose | None  #: The last accepted pose

    @property
    def verdict(self) -> str:
        """The last answer in one line; '' without an answer."""
        return self.values.get('last verdict', '').removesuffix('none yet')

    @property
    def base_frame(self) -> str:
        """The frame whose pose the relocalizer publishes; '' for the camera."""
        return self.values.get('base frame', '')

    @property
    def missing(self) -> tuple[str, ...]:
        """Landmarks that the watch no longer detects."""
        return split_names(self.values.get('watch missing', ''))

    @property
    def is_current(self) -> bool:
        """Return whether the pose is that of the last answer, and the diagnostics are recent."""
        return self.is_heard and self.verdict.startswith(('accepted', 'withheld'))


class LiveRelocalizer:
    """A client of the running relocalizer.

    `name` is the node's name with its namespace, as '/relocalizer'.
    """

    def __init__(self, node: Node, name: str):
        self.name, self._node = name, node
        self.state = LiveState(False, {}, None)
        self._pose: LivePose | None = None
        self._turn, self._closed = threading.Lock(), threading.Event()
        #: Called after each change of the state, in any thread
        self.on_change: Callable[[], None] = lambda: None
        self._status = RelocalizerStatus(node, name)
        self._relocalize = node.create_client(Trigger, f'{name}/relocalize')
        self._reload = node.create_client(Trigger, f'{name}/reload_map')
        node.create_subscription(PoseWithCovarianceStamped, f'{name}/pose', self._on_pose,
                                 qos.POSE)

    def update(self) -> None:
        """Update the state from the received messages."""
        values = self._status.values
        is_heard = bool(values) and self._status.silent_s <= _SILENCE_S
        if self._pose is not self.state.pose or (is_heard, values) != self.state[:2]:
            self.state = LiveState(is_heard, values, self._pose)
            self.on_change()

    def lines(self, document: Document) -> list[str]:
        """Return the state as lines for the page."""
        state, values, pose = self.state, self.state.values, self.state.pose
        file, missing = Path(values.get('map file', '')), ', '.join(state.missing)
        is_other = file.is_absolute() and file.resolve() != document.path.resolve()
        lines = [f'{self.name}: no diagnostics', '', ''] if not state.is_heard else [
            f'{self.name}: {values.get("state", "")}',
            f'map: {values.get("map") or "none loaded"}',
            f'the map file is {file}, not that of this studio' if is_other else '']
        lines += [f'watch: {values["watch reason"]}' if values.get('watch reason') else '',
                  f'missing, red in the map: {missing}' if missing else '',
                  f'last answer: {state.verdict}' if state.verdict else 'no answer yet']
        if pose is not None:
            lines.append(f'{"" if state.is_current else "earlier "}pose of '
                         f'{state.base_frame or "the camera"}, stamp {pose.stamp_s:.2f} s')
            if pose.frame_id != (frame := document.file.frame_id):
                lines.append(f'the pose is in {pose.frame_id}, the map in {frame}: the pose is '
                             'not shown')
        return [line[:_MAX_TEXT] for line in lines if line]

    def relocalize(self) -> str:
        """Request a relocalization; return the answer.

        LiveError: there is no relocalizer, it failed or ended, or another request is waiting.
        """
        answer = self._request(self._relocalize)
        if answer.success or answer.message.startswith(_ANSWERS):
            return str(answer.message)
        raise LiveError(f'the relocalizer failed: {answer.message}')

    def reload_map(self) -> str:
        """Make the relocalizer read its map file again; return its report.

        LiveError: as for relocalize, or the map is invalid and the relocalizer keeps its old map.
        """
        answer = self._request(self._reload)
        if answer.success:
            return str(answer.message)
        raise LiveError(f'{answer.message}; the relocalizer keeps its map')

    def close(self) -> None:
        """Release the waiting request, and wait until it has ended."""
        self._closed.set()
        if self._turn.acquire(timeout=_GRACE_S):
            self._turn.release()

    def _request(self, client: Any) -> Any:
        """Call a service and wait for its answer, as long as the relocalizer is alive."""
        if not self._turn.acquire(blocking=False):
            raise LiveError('another request is waiting for its answer: retry afterwards')
        try:
            if not client.service_is_ready():
                others = sorted(name.removesuffix('/relocalize') for name, types in
                                self._node.get_service_names_and_types()
                                if name.endswith('/relocalize')
                                and 'std_srvs/srv/Trigger' in types)
                hint = f'; for another relocalizer use --relocalizer {others[0]}' if others else ''
                raise LiveError(
                    f'no relocalizer found at {self.name}: start it with ros2 run cliploc_ros '
                    'relocalizer --ros-args -p map_file:=MAP, in the ROS domain of the studio'
                    f'{hint}')
            answered, begin = threading.Event(), time.monotonic()
            future = client.call_async(Trigger.Request())
            future.add_done_callback(lambda _: answered.set())
            try:
                while not answered.wait(_POLL_S):
                    self._check_alive(client, begin)
            finally:
                if not future.done():
                    client.remove_pending_request(future)
            return future.result()
        finally:
            self._turn.release()

    def _check_alive(self, client: Any, begin: float) -> None:
        now = time.monotonic()
        if self._closed.is_set():
            raise LiveError('the studio is ending and does not wait for the answer')
        if not client.service_is_ready():
            raise LiveError(f'{self.name} ended before it answered: start it again')
        if (silence_s := min(self._status.silent_s, now - begin)) > _SILENCE_S:
            raise LiveError(f'{self.name} has not reported for {silence_s:.0f} s and did not '
                            'answer: check that it still runs')
        if now - begin > _PATIENCE_S:
            raise LiveError(f'{self.name} did not answer within {_PATIENCE_S:.0f} s: see its log')

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        pose, stamp = pose_from_msg(msg.pose.pose), msg.header.stamp
        covariance = np.array(msg.pose.covariance).reshape(6, 6)[:3, :3]
        if pose is not None and np.isfinite(covariance).all():  # else it is of another program
            self._pose = LivePose(pose, covariance, msg.header.frame_id,
                                  stamp.sec + 1e-9 * stamp.nanosec)


@contextmanager
def follow_relocalizer(name: str, ros_args: Sequence[str] = ()) -> Iterator[LiveRelocalizer]:
    """Connect to the running relocalizer, in a thread, while the context is open.

    ``ros_args`` are '--ros-args' and the arguments after it.

    OptionsError: the name is invalid, or ROS does not start.
    """
    name, context = '/' + name.strip('/'), Context()
    check_name(name)
    try:
        rclpy.init(args=list(ros_args), context=context,
                   signal_handler_options=SignalHandlerOptions.NO)
        node = Node('map_studio', context=context, enable_rosout=False,
                    start_parameter_services=False)
    except Exception as error:  # rcl raises different types for arguments and folders
        raise OptionsError(f'--ros: ROS does not start: {error}') from error
    live = LiveRelocalizer(node, name)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    node.create_timer(_POLL_S, live.update)
    thread = threading.Thread(target=executor.spin, name='ros', daemon=True)
    thread.start()
    try:
        yield live
    finally:
        live.close()
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.shutdown(context=context)
