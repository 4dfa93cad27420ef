# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The running relocalizer over ROS: its last answer, and requests to it.

The only module of the studio that imports ROS; the studio runs without it.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_full_topic_name import validate_full_topic_name
from std_srvs.srv import Trigger

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.ros import qos
from cliploc_ros.ros.node.diagnostics import split_names

# The relocalizer reports once a second. While it loads libraries it may be late (a guess).
_SILENCE_S = 10.0
# Beyond any sensible timeout_s of the relocalizer.
_PATIENCE_S = 120.0
_POLL_S = 0.1
# How long closing waits for a request that is released.
_GRACE_S = 2.0
# Answers that are no failure, though no pose was delivered.
_ANSWERS = ('refused', 'withheld')


class LiveError(CliplocError):
    """The running relocalizer does not do what was requested; the message says why."""


class LivePose(NamedTuple):
    """A pose that the relocalizer accepted."""

    #: (4, 4): of the camera, or of the robot if the relocalizer has a base_frame
    map_from_body: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: (3, 3): of the position [m^2]
    frame_id: str  #: The coordinate frame of the pose
    stamp_s: float  #: Of the image [s]


class LiveState(NamedTuple):
    """The last reports of the running relocalizer.

    ``is_heard``: it reported within the last seconds. ``pose``: the last accepted one.
    ``verdict``: its last answer in one line. ``is_busy``: a request of this studio waits for its
    answer. ``watch``: what its watch says; ``missing``: landmarks that this one does not see any
    more. The others are of its diagnostics; '' where they say nothing.
    """

    is_heard: bool = False
    pose: LivePose | None = None
    verdict: str = ''
    lifecycle: str = ''
    map_text: str = ''
    map_file: str = ''
    base_frame: str = ''
    watch: str = ''
    missing: tuple[str, ...] = ()
    is_busy: bool = False

    @property
    def is_current(self) -> bool:
        """Whether the pose is the last answer, and its node still reports."""
        return self.is_heard and self.verdict.startswith(('accepted', 'withheld'))


class LiveRelocalizer:
    """A client of the running relocalizer, whose name has its namespace: '/relocalizer'."""

    def __init__(self, node: Node, name: str):
        self.name, self._node = name, node
        self.state = LiveState()
        self._heard_at = -math.inf
        self._turn, self._lock = threading.Lock(), threading.Lock()
        self._closed = threading.Event()
        self._listeners: list[Callable[[], None]] = []
        self._relocalize = node.create_client(Trigger, f'{name}/relocalize')
        self._reload = node.create_client(Trigger, f'{name}/reload_map')
        node.create_subscription(PoseWithCovarianceStamped, f'{name}/pose', self._on_pose,
                                 qos.POSE)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call a function after each change of the state, in any thread."""
        self._listeners.append(listener)

    def relocalize(self) -> str:
        """Request a relocalization; return the answer.

        LiveError: there is no relocalizer, it fails or ends, or another request waits.
        """
        answer = self._request(self._relocalize)
        self._change(verdict=answer.message)
        if answer.success or answer.message.startswith(_ANSWERS):
            return str(answer.message)
        raise LiveError(f'the relocalizer gave no answer: {answer.message}')

    def reload_map(self) -> str:
        """Let the relocalizer read its map file again; return its report.

        LiveError: as above, or the map is invalid, and the relocalizer keeps its old one.
        """
        answer = self._request(self._reload)
        if answer.success:
            return str(answer.message)
        raise LiveError(f'{answer.message}; the relocalizer keeps its map')

    def check_silence(self) -> None:
        """Notice when the relocalizer has stopped reporting."""
        if self.state.is_heard and time.monotonic() - self._heard_at > _SILENCE_S:
            self._change(is_heard=False)

    def close(self) -> None:
        """Release the request that waits, and return when it is gone."""
        self._closed.set()
        if self._turn.acquire(timeout=_GRACE_S):
            self._turn.release()

    def _request(self, client: Any) -> Any:
        """Call a service and wait for its answer, as long as the relocalizer is alive."""
        if not self._turn.acquire(blocking=False):
            raise LiveError('a request waits for its answer: repeat yours after it')
        try:
            if not client.service_is_ready():
                others = sorted(name.removesuffix('/relocalize') for name, types in
                                self._node.get_service_names_and_types()
                                if name.endswith('/relocalize')
                                and 'std_srvs/srv/Trigger' in types)
                hint = f'; --relocalizer {others[0]} would find another' if others else ''
                raise LiveError(
                    f'no relocalizer found at {self.name}: start it with ros2 run cliploc_ros '
                    'relocalizer --ros-args -p map_file:=MAP, in the ROS domain of the studio'
                    f'{hint}')
            self._change(is_busy=True)
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
            self._change(is_busy=False)
            self._turn.release()

    def _check_alive(self, client: Any, begin: float) -> None:
        now = time.monotonic()
        if self._closed.is_set():
            raise LiveError('the studio ends: the answer is not waited for')
        if not client.service_is_ready():
            raise LiveError(f'{self.name} ended before it answered: start it again')
        if (silence_s := now - max(self._heard_at, begin)) > _SILENCE_S:
            raise LiveError(f'{self.name} has not reported for {silence_s:.0f} s and gave no '
                            'answer: see whether it still runs')
        if now - begin > _PATIENCE_S:
            raise LiveError(f'{self.name} gave no answer within {_PATIENCE_S:.0f} s: see its log')

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        position, quat = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        covariance = np.array(msg.pose.covariance).reshape(6, 6)[:3, :3]
        is_valid = np.isfinite(position).all() and np.isfinite(covariance).all() \
            and abs(np.linalg.norm(quat) - 1.0) < 1e-2
        if not is_valid:
            return  # of another program under this name
        stamp = msg.header.stamp
        self._change(pose=LivePose(
            transform_from_pose(position, quat / np.linalg.norm(quat)), covariance,
            msg.header.frame_id, stamp.sec + 1e-9 * stamp.nanosec))

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name != f'{self.name.lstrip("/")}: status':
                continue
            values = {pair.key: pair.value for pair in status.values}
            verdict = values.get('last verdict', '')
            self._heard_at = time.monotonic()
            self._change(is_heard=True, verdict='' if verdict == 'none yet' else verdict,
                         lifecycle=values.get('state', ''), map_text=values.get('map', ''),
                         map_file=values.get('map file', ''),
                         base_frame=values.get('base frame', ''),
                         watch=values.get('watch reason', ''),
                         missing=split_names(values.get('watch missing', '')))

    def _change(self, **values: Any) -> None:
        with self._lock:
            before = self.state
            self.state = before._replace(**values)
            # a new pose is another tuple, whose arrays have no truth value
            is_equal = self.state.pose is before.pose and self.state == before
        if not is_equal:
            for listener in self._listeners:
                listener()


@contextmanager
def follow_relocalizer(name: str, ros_args: Sequence[str] = ()) -> Iterator[LiveRelocalizer]:
    """Follow the running relocalizer in a thread for as long as the block lasts.

    ``ros_args`` are '--ros-args' and the arguments after it.

    OptionsError: the name is invalid, or ROS does not start.
    """
    name = '/' + name.strip('/')
    context = Context()
    try:
        validate_full_topic_name(name)
        rclpy.init(args=list(ros_args), context=context,
                   signal_handler_options=SignalHandlerOptions.NO)
        node = Node('map_studio', context=context, enable_rosout=False,
                    start_parameter_services=False)
    except Exception as error:  # rcl has its own types, for names, arguments and folders
        raise OptionsError(f'--ros {name}: ROS does not start: {error}') from error
    live = LiveRelocalizer(node, name)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    is_ending = threading.Event()

    def spin() -> None:
        while not is_ending.is_set():
            executor.spin_once(timeout_sec=_POLL_S)
            live.check_silence()

    thread = threading.Thread(target=spin, name='ros', daemon=True)
    thread.start()
    try:
        yield live
    finally:
        live.close()
        is_ending.set()
        thread.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
