# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch of a running localizer: looks, verdicts and reactions.

A thread of its own waits for frames and transforms; only the look itself runs in the node's
worker, and none begins while a request is under way. So a watch never delays a request.
"""

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Bool, Header, String

from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import SAME_SPOT, invert_transform, is_rigid
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.watch.watch import WatchReport, WatchState
from cliploc_ros.errors import CliplocError, StoppedError, TimeUpError
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer
from cliploc_ros.ros.conversions import pose_from_msg, stamp_ns
from cliploc_ros.ros.handoff import HandOff, HandOffError
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, NoFrameError
from cliploc_ros.ros.inputs.odometry import OdometryPlace
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps, stamp_problem
from cliploc_ros.ros.node.diagnostics import Health, join_names
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.request import Pipeline, Requests
from cliploc_ros.units import NS_PER_S

# Looks follow each other at least this far apart [s], and take this share of a core at most.
_LEAST_S, _DUTY = 1.0, 0.1
# A robot that drove or turned so far since its last look sees something else.
_WAY_M, _TURN_DEG = 1.0, 90.0
_POLL_S = 0.1
# A camera at 1 Hz and a detector of a second complete a frame within this time.
_FRAME_PATIENCE_S = 5.0
# A verdict without a look since says no more than that nothing is known.
_STALE_S = 10.0
# Whether a robot rests shows within this time.
_REST_PATIENCE_S = 3.0
# Between requests of a robot that stays lost; the pause doubles each time.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 160.0
# Without odometry, a shown pose holds for this long (a guess): a robot drives half a metre in it.
_UNLINKED_NS = NS_PER_S // 2
# A localizer that hears scans shows its pose more often than this (AMCL: each .25 m).
_SILENT_WAY_M = 2.0


@dataclass(frozen=True)
class _Known:
    """The current verdict of the watch."""

    state: WatchState = WatchState.UNCERTAIN
    reason: str = 'no look yet'
    report: WatchReport | None = None  #: Report of the last look, while it holds
    looked_at: float = 0.0  #: When that was (monotonic clock) [s]
    problem: str = ''  #: The cause that prevents looks, and what to do


class Watcher:
    """Looks whether the localizer's pose is right, while the node is active and `watch` is on.

    Parameters
    ----------
    frames : CameraRig
        It looks with the first camera.
    relocalize : callable
        Requests a relocalization as a client does, and returns the answer.
    """

    def __init__(self, node: ManagedNode[RelocalizerParameters], frames: CameraRig,
                 robot: RobotStateSource, jumps: TimeJumps, pipeline: Pipeline,
                 requests: Requests, handoff: HandOff, relocalize: Callable[[], Answer]) -> None:
        self._node, self._frames, self._robot, self._jumps = node, frames, robot, jumps
        self._pipeline, self._requests, self._handoff = pipeline, requests, handoff
        self._relocalize = relocalize
        self.is_on = node.settings.values.watch != 'none'
        self._pose = LocalizerPose(node, robot)
        self._lock = threading.Lock()
        self._known = _Known()
        self._stopped = threading.Event()
        self._stopped.set()
        # Looks at a pose from before this number changed do not count.
        self._age = 0
        self._cost_s = 0.0
        # State of a robot that is lost, and whether it stands.
        self._reaction, self._is_at_rest = '', False
        self._rest_stamp: Time | None = None
        # The image of the look that began last, and whether the localizer had a pose at one.
        self._image_stamp, self._had_pose = Time(), False
        self._pause_s, self._next_request_at = _FIRST_PAUSE_S, 0.0
        if self.is_on:
            handoff.on_shown(self._pose.hear)
            pipeline.on_map = lambda: self._drop('a map was loaded')
            robot.odometry.on_restart(lambda _: self._drop('odom restarted'))
            self._localized = node.create_publisher(Bool, '~/localized', qos.LATCHED)
            self._state = node.create_publisher(String, '~/localization_state', qos.LATCHED)

    def open(self) -> None:
        """Begin to watch."""
        if self.is_on:
            self._stopped = threading.Event()
            self._say(_Known())
            threading.Thread(target=self._run, args=(self._stopped,), name='watch',
                             daemon=True).start()

    def close(self) -> None:
        """Watch no longer; a look under way has no effect."""
        if self.is_on and not self._stopped.is_set():
            self.release()
            self._drop('the node was deactivated')
            self._pose.forget()

    def release(self) -> None:
        """End the thread: the process ends."""
        self._stopped.set()

    def forget(self) -> None:
        """Forget all looks and poses: time jumped."""
        if self.is_on:
            self._pose.forget()
            self._drop('time jumped')

    def start_over(self) -> None:
        """Forget all looks: the localizer was given another pose."""
        if self.is_on:
            self._drop('the localizer was given another pose')

    def examine(self, health: Health) -> None:
        """Report the verdict and the cause that prevents looks."""
        if not self.is_on:
            return
        known = self._known
        report = known.report
        health.values |= {
            'watch': str(known.state), 'watch reason': known.reason, 'on lost': self._reaction,
            'lost and at rest': known.state is WatchState.LOST and self._is_at_rest,
            'watch look [ms]': f'{1e3 * self._cost_s:.1f}'}
        if report is not None:
            turned = '' if report.camera_turn is None else \
                f'the camera is {report.camera_turn.in_words()}'
            health.values |= {
                'watch probability': f'{report.probability:.3f}', 'watch looks': report.looks,
                'watch matched': f'{report.matched} of {report.expected} expected',
                'watch missing': join_names(report.missing), 'watch fault': report.fault,
                'watch camera': turned,
                'watch last look [s]': f'{time.monotonic() - known.looked_at:.1f}'}
            for problem in filter(None, (report.fault, turned)):
                health.warn(problem)
        if known.problem or known.state is WatchState.LOST:
            health.warn(f'watch: {known.problem or known.reason}')

    # ---- the thread -----------------------------------------------------------------------------

    def _run(self, stopped: threading.Event) -> None:
        """Look again and again until the event is set."""
        while not stopped.is_set():
            begun_at, stamp = time.monotonic(), None
            try:
                try:
                    stamp = self._look(stopped)
                except PoselessError as error:
                    self._miss(stopped, str(error))
                    self._wake_up(stopped)
                else:
                    self._react(stopped, stamp)
            except StoppedError:
                return
            except (NoFrameError, NoTransformError, LaterError, TimeJumpError, TimeUpError
                    ) as error:  # the next look may do
                self._miss(stopped, str(error), time.monotonic() - _STALE_S)
            except CliplocError as error:
                self._miss(stopped, str(error))
            except Exception as error:
                self._node.report(traceback.format_exc())
                self._miss(stopped, f'internal error: {error} (the traceback is in the log)')
            self._rest(stopped, begun_at, stamp)

    def _rest(self, stopped: threading.Event, begun_at: float, stamp: Time | None) -> None:
        """Wait until the next look is due."""
        earliest = begun_at + max(_LEAST_S, self._cost_s / _DUTY)
        latest = max(earliest, begun_at + self._node.settings.values.watch_period_s)
        while (now := time.monotonic()) < latest and not stopped.wait(min(_POLL_S, latest - now)):
            moved = None if stamp is None or now < earliest else \
                self._robot.odometry.moved_since(stamp, 0.0)
            if moved is not None and (moved[0] >= _WAY_M or moved[1] >= _TURN_DEG):
                return

    def _look(self, stopped: threading.Event) -> Time | None:
        """Compare one frame with the localizer's pose; return its stamp, None without a look."""
        begun_at, age = time.monotonic(), self._age
        frame = self._frames.next_frame(begun_at, begun_at + _FRAME_PATIENCE_S, 0.0,
                                        cameras=1)
        localizer = self._pipeline.localizer
        if localizer is None:
            raise StoppedError('the node was deactivated')
        if self._requests.is_busy:
            return None
        image = frame.image.header
        self._image_stamp = image.stamp
        self._jumps.check(image.stamp, frame.received_at)
        # Odometry tells looks apart, whether or not requests fuse frames by it.
        parameters = replace(self._node.settings.snapshot().of_camera(frame.camera),
                             fuse_frames=MAX_FRAMES)
        state = self._robot.at(image, parameters, depth_frame=frame.depth_frame)
        pose = self._pose.at(image, state, parameters, [
            part.landmark_map.frame_id for part in parts_of(localizer.landmark_map)])
        self._had_pose = True
        report = self._node.worker.run(
            partial(self._score, frame, parameters, state, pose, age), begun_at + _STALE_S)
        if report is not None:
            self._say(_Known(report.state, report.reason, report, time.monotonic()), stopped, age)
        return image.stamp

    def _score(self, frame: Frame, parameters: RelocalizerParameters, state: RobotState,
               pose: tuple[str, NDArray[np.float64]], age: int) -> WatchReport | None:
        """Look, in the worker's thread; None if the pose does not count any more."""
        localizer = self._pipeline.localizer  # that of now: the map may be another one
        if localizer is None or age != self._age:
            return None
        begun_s = time.thread_time()
        try:
            return localizer.look(frame, parameters, state, *pose)
        finally:
            self._cost_s = time.thread_time() - begun_s

    # ---- the verdict ----------------------------------------------------------------------------

    def _say(self, known: _Known, stopped: threading.Event | None = None, age: int | None = None
             ) -> None:
        """Publish a verdict, unless the watch ended or the pose changed meanwhile."""
        with self._lock:
            if (stopped is not None and stopped.is_set()) or age not in (None, self._age):
                return
            before, self._known = self._known, known
            self._localized.publish(Bool(data=known.state is WatchState.LOCALIZED))
            self._state.publish(String(data=str(known.state)))
        if known.state is WatchState.LOCALIZED:
            self._pause_s, self._next_request_at = _FIRST_PAUSE_S, 0.0
        if known.state is not WatchState.LOST:
            self._is_at_rest = False
        if (known.state, known.problem) != (before.state, before.problem):
            text = f'watch: {known.problem or known.reason}'
            if known.state is WatchState.LOST:
                self._node.get_logger().warning(text)
            else:
                self._node.get_logger().info(text)
            self._node.diagnostics.publish()

    def _miss(self, stopped: threading.Event, problem: str, since: float = float('inf')) -> None:
        """Report a problem that prevents looks, unless there was a look after `since`."""
        known = self._known
        if known.report is None or known.looked_at < since:
            self._say(_Known(reason=problem, problem=problem), stopped)

    def _drop(self, why: str) -> None:
        """Forget all looks."""
        with self._lock:
            self._age += 1
        self._say(_Known(reason=f'{why}: no look since'))

        def forget() -> None:
            if (localizer := self._pipeline.localizer) is not None:
                localizer.watch.forget()
        with suppress(StoppedError):
            self._node.worker.submit(forget)

    # ---- what follows ---------------------------------------------------------------------------

    def _react(self, stopped: threading.Event, stamp: Time | None) -> None:
        """Relocalize a lost robot that stands, where that is wanted, and not again and again."""
        if self._known.state is not WatchState.LOST or stamp is None:
            self._rest_stamp = None
            return
        self._relocalize_at_rest(stopped, stamp, 'lost')

    def _wake_up(self, stopped: threading.Event) -> None:
        """Relocalize for a localizer that started again: it has no pose, and had one before."""
        is_wanted = self._node.settings.values.on_lost != 'report' and self._had_pose
        if is_wanted and not self._handoff.missing():
            self._relocalize_at_rest(stopped, self._image_stamp, 'the localizer has no pose')

    def _relocalize_at_rest(self, stopped: threading.Event, stamp: Time, why: str) -> None:
        parameters = self._node.settings.values
        self._reaction = self._why_not_at_rest(parameters, stamp)
        self._is_at_rest = not self._reaction
        if not self._is_at_rest:
            return
        left_s = self._next_request_at - time.monotonic()
        if parameters.on_lost == 'report' or stopped.is_set():
            self._reaction = 'the robot stands'
        elif left_s > 0.0:
            self._reaction = f'the robot stands; next request in {left_s:.0f} s'
        else:
            self._node.get_logger().warning(f'watch: {why}, and at rest: relocalizing')
            answer = self._relocalize()
            self._next_request_at = time.monotonic() + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
            self._reaction = answer.message

    def _why_not_at_rest(self, parameters: RelocalizerParameters, stamp: Time) -> str:
        """Return why the robot may be moving; empty if odometry shows that it stands.

        It stands at two looks, and has not moved between: one that turns round seems to stand for
        a moment.
        """
        since, self._rest_stamp = self._rest_stamp, None
        odometry = self._robot.odometry
        if not odometry.is_published:
            return f'nobody publishes {odometry.topic}: nothing tells whether the robot stands'
        try:
            self._handoff.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s,
                                     time.monotonic() + _REST_PATIENCE_S)
        except HandOffError as error:
            return str(error)
        moved = None if since is None else odometry.moved_since(since, 0.0)
        has_stayed = moved is not None and (moved[0] <= SAME_SPOT.distance_m
                                            and moved[1] <= SAME_SPOT.angle_deg)
        self._rest_stamp = stamp
        return '' if has_stayed else 'the robot has just stopped'


class NoLocalizerPoseError(CliplocError):
    """The localizer has no valid pose for an image; the message says what to do."""


class LaterError(NoLocalizerPoseError):
    """The next pose of the localizer may do."""


class PoselessError(NoLocalizerPoseError):
    """The localizer shows no pose, as one that has just started."""


class _Anchor(NamedTuple):
    """Odometry's coordinate frame in the map (4, 4), by the pose that was shown at a stamp."""

    shown_ns: int
    run: int
    way_m: float
    map_from_odom: NDArray[np.float64]


class LocalizerPose:
    """Knows the localizer's pose by tf2, or by the topic localizer_pose and odometry since.

    All methods but `hear` and `forget` run in one thread.
    """

    def __init__(self, node: Node, robot: RobotStateSource) -> None:
        self._node = node
        self._robot = robot
        self._topic = ''
        self.forget()

    def forget(self) -> None:
        """Forget what was heard: time jumped, or the node is inactive."""
        self._shown: PoseWithCovarianceStamped | None = None
        self._shown_by: bytes | None = None  # what identifies the publisher; None: until a look
        self._anchor: _Anchor | None = None

    def hear(self, shown: PoseWithCovarianceStamped) -> None:
        """Take in a pose that the localizer shows."""
        publishers = self._node.get_publishers_info_by_topic(self._topic) if self._topic else []
        self._shown_by = bytes(publishers[0].endpoint_gid) if len(publishers) == 1 else None
        self._shown = shown

    def at(self, image: Header, state: RobotState, parameters: RelocalizerParameters,
           frame_ids: Sequence[str]) -> tuple[str, NDArray[np.float64]]:
        """Return the camera's pose (4, 4) at the stamp of an image, and the map it is in.

        `state` is the robot's at that stamp, `frame_ids` are those of the maps.

        NoLocalizerPoseError: there is none, or it is invalid. LaterError: it is too old.
        """
        frame_id, pose = self._by_tf(image, state, parameters, frame_ids) \
            if parameters.watch == 'tf' else self._by_topic(image, state, parameters)
        if frame_id not in frame_ids:
            raise NoLocalizerPoseError(f"the localizer's pose is in frame '{frame_id}', the map "
                                       f"in '{', '.join(frame_ids)}': correct the map's frame_id")
        return frame_id, pose

    def _by_tf(self, image: Header, state: RobotState, parameters: RelocalizerParameters,
               frame_ids: Sequence[str]) -> tuple[str, NDArray[np.float64]]:
        problem: NoTransformError | None = None
        for frame_id in frame_ids:
            try:
                map_from_base = self._robot.transforms.lookup(
                    frame_id, parameters.base_frame or image.frame_id, image.stamp,
                    parameters.tf_timeout_s, 'start the localizer (AMCL)')
            except NoTransformError as error:
                problem = problem or error
                continue
            if not is_rigid(map_from_base):
                raise NoLocalizerPoseError(f"the transform from '{parameters.base_frame}' to "
                                           f"'{frame_id}' is not a pose: see the localizer's log")
            return frame_id, map_from_base @ invert_transform(state.camera_from_base)
        raise PoselessError(str(problem)) from problem

    def _by_topic(self, image: Header, state: RobotState, parameters: RelocalizerParameters
                  ) -> tuple[str, NDArray[np.float64]]:
        topic = self._topic = self._node.resolve_topic_name(parameters.localizer_pose)
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            raise NoLocalizerPoseError(f'nobody publishes {topic}: start the localizer (AMCL), or '
                                       'name the topic of its pose by localizer_pose')
        if len(publishers) > 1:
            names = ', '.join(sorted(one.node_name for one in publishers))
            raise NoLocalizerPoseError(f'{len(publishers)} publishers of {topic} ({names}): stop '
                                       'all but one')
        publisher = bytes(publishers[0].endpoint_gid)
        self._shown_by = self._shown_by or publisher
        if self._shown_by != publisher:
            self.forget()  # another process showed it; this one has no pose until it shows one
        shown = self._shown
        if shown is None:
            raise PoselessError(f'no pose heard on {topic} yet: AMCL shows one once the robot '
                                'drives; watch: tf need not wait')
        pose, place = _pose_of(shown, topic), state.place
        shown_ns, frame_id = stamp_ns(shown.header.stamp), shown.header.frame_id.lstrip('/')
        if place is None:
            since_ns = stamp_ns(image.stamp) - shown_ns
            if abs(since_ns) > _UNLINKED_NS:
                raise NoLocalizerPoseError(
                    f'{topic} is {since_ns / NS_PER_S:.1f} s older than the image, and odom does '
                    'not tell the way since: publish odom')
            return frame_id, pose @ invert_transform(state.camera_from_base)
        anchor = self._anchored(shown, pose, image, place, parameters, topic)
        if place.way_m - anchor.way_m > _SILENT_WAY_M:
            raise NoLocalizerPoseError(
                f'{topic} is silent for {place.way_m - anchor.way_m:.1f} m of way: see whether '
                'the localizer is active and hears scans')
        return frame_id, anchor.map_from_odom @ place.odom_from_frame

    def _anchored(self, shown: PoseWithCovarianceStamped, pose: NDArray[np.float64],
                  image: Header, place: OdometryPlace, parameters: RelocalizerParameters,
                  topic: str) -> _Anchor:
        """Return odometry's coordinate frame in the map, by the newest pose that was shown."""
        shown_ns, anchor = stamp_ns(shown.header.stamp), self._anchor
        if anchor is None or (anchor.shown_ns, anchor.run) != (shown_ns, place.run):
            then = self._robot.at(Header(stamp=shown.header.stamp, frame_id=image.frame_id),
                                  parameters)
            if then.place is None or then.place.run != place.run:
                raise LaterError(f'odom does not tell the way since {topic} was published: wait '
                                 'for the next pose')
            map_from_camera = pose @ invert_transform(then.camera_from_base)
            anchor = self._anchor = _Anchor(
                shown_ns, place.run, then.place.way_m,
                map_from_camera @ invert_transform(then.place.odom_from_frame))
        return anchor


def _pose_of(shown: PoseWithCovarianceStamped, topic: str) -> NDArray[np.float64]:
    """Return a shown pose (4, 4). NoLocalizerPoseError: it is invalid."""
    if why := stamp_problem(shown.header.stamp):
        raise NoLocalizerPoseError(f'the stamp of {topic} {why}: the localizer '
                                   'must stamp its pose')
    pose = pose_from_msg(shown.pose.pose)
    if pose is None:
        raise NoLocalizerPoseError(f'{topic} shows a pose with NaN or a quaternion that is not '
                                   "of length 1: see the localizer's log")
    return pose
