# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch of a running localizer: checks of its pose, verdicts and reactions.

A separate thread waits for frames and transforms. Only the check itself runs in the node's worker,
and no check begins while a request is being answered. Thus the watch never delays a request.
"""

import math
import re
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Bool, Header, String

from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import SAME_SPOT, invert_transform, is_rigid
from cliploc_ros.core.watch.watch import WatchReport, WatchState
from cliploc_ros.errors import CliplocError, HandOffError, StoppedError, TimeUpError
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer
from cliploc_ros.ros.conversions import pose_from_msg, stamp_ns
from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import NoFrameError
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps, stamp_problem
from cliploc_ros.ros.node.diagnostics import Health, join_names
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.receivers import RunningLocalizer
from cliploc_ros.ros.request import Pipeline, Requests
from cliploc_ros.units import NS_PER_S

# Least time between two checks [s], and greatest share of a core that they may use.
_LEAST_S, _DUTY = 1.0, 0.1
# After a move [m] or a turn [deg] of this size the camera sees other objects.
_WAY_M, _TURN_DEG = 1.0, 90.0
_POLL_S = 0.1
# Least time between two log lines of one state, which state different problems.
_SAY_PERIOD_S = 30.0
# A camera at 1 Hz and a detector that takes one second complete a frame within this time.
_FRAME_PATIENCE_S = 5.0
# Without a check for this long, the verdict is no longer valid.
_STALE_S = 10.0
# Longest wait for odometry that shows whether the robot is at rest.
_REST_PATIENCE_S = 3.0
# Pauses between requests of a robot that stays lost. The pause doubles each time.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 160.0
# Without odometry, the localizer's pose is valid for this time, in which a robot drives half a
# metre. Not measured.
_UNLINKED_NS = NS_PER_S // 2
# A localizer that receives scans publishes its pose at shorter distances (AMCL: every 0.25 m).
_SILENT_WAY_M = 2.0


@dataclass(frozen=True)
class _Known:
    """The current verdict of the watch."""

    state: WatchState = WatchState.UNCERTAIN
    reason: str = 'no look yet'
    report: WatchReport | None = None  #: Report of the last check, while it is valid
    looked_at: float = 0.0  #: Time of that check (monotonic clock) [s]
    problem: str = ''  #: Why no check is possible, and what to do


class Watcher:
    """Checks the localizer's pose periodically while the node is active and `watch` is on.

    Parameters
    ----------
    frames : CameraRig
        Only the first camera is used.
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
        self._pose = LocalizerPose(node, robot, handoff.localizer)
        self._lock = threading.Lock()
        self._known = _Known()
        self._stopped = threading.Event()
        self._stopped.set()
        # Checks that began before this number changed are discarded.
        self._age = 0
        self._cost_s = 0.0
        # The state and the problem that were logged last, and when (monotonic clock) [s].
        self._said, self._said_at = (WatchState.UNCERTAIN, ''), -math.inf
        # Reaction to a lost robot, and whether it is at rest.
        self._reaction, self._is_at_rest = '', False
        self._rest_stamp: Time | None = None
        # Stamp of the newest checked image, and whether the localizer ever had a pose.
        self._image_stamp, self._had_pose = Time(), False
        self._pause_s, self._next_request_at = _FIRST_PAUSE_S, 0.0
        if self.is_on:
            handoff.localizer.listeners.append(self._pose.hear)
            pipeline.on_map = lambda: self._drop('a map was loaded')
            robot.odometry.on_restart(lambda _: self._drop('odom restarted'))
            self._localized = node.create_publisher(Bool, '~/localized', qos.LATCHED)
            self._state = node.create_publisher(String, '~/localization_state', qos.LATCHED)

    def open(self) -> None:
        """Start the watch."""
        if self.is_on:
            self._stopped = threading.Event()
            self._say(_Known())
            threading.Thread(target=self._run, args=(self._stopped,), name='watch',
                             daemon=True).start()

    def close(self) -> None:
        """Stop the watch; the result of a running check is discarded."""
        if self.is_on and not self._stopped.is_set():
            self.release()
            self._drop('the node was deactivated')
            self._pose.forget()

    def release(self) -> None:
        """Let the thread end, because the process is ending."""
        self._stopped.set()

    def forget(self) -> None:
        """Forget all checks and poses: time jumped."""
        if self.is_on:
            self._pose.forget()
            self._drop('time jumped')

    def start_over(self) -> None:
        """Forget all checks: the localizer was given another pose."""
        if self.is_on:
            self._drop('the localizer was given another pose')

    def examine(self, health: Health) -> None:
        """Report the verdict, and why checks are not possible."""
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
        """Check periodically until the event is set."""
        while not stopped.is_set():
            begun_at, stamp = time.monotonic(), None
            try:
                try:
                    stamp = self._look(stopped)
                except PoselessError as error:
                    self._miss(stopped, str(error))
                    # the localizer has no pose, but had one before: it was restarted
                    if self._node.settings.values.on_lost != 'report' and self._had_pose \
                            and not self._handoff.localizer.missing():
                        self._relocalize_at_rest(stopped, self._image_stamp,
                                                 'the localizer has no pose')
                else:  # relocalize a lost robot at rest if on_lost asks for it
                    if self._known.state is WatchState.LOST and stamp is not None:
                        self._relocalize_at_rest(stopped, stamp, 'lost')
                    else:
                        self._rest_stamp = None
            except StoppedError:
                return
            except (NoFrameError, NoTransformError, LaterError, TimeJumpError, TimeUpError
                    ) as error:  # the next check may succeed
                self._miss(stopped, str(error), time.monotonic() - _STALE_S)
            except CliplocError as error:
                self._miss(stopped, str(error))
            except Exception as error:
                self._node.report(traceback.format_exc())
                self._miss(stopped, f'internal error: {error} (the traceback is in the log)')
            self._rest(stopped, begun_at, stamp)

    def _rest(self, stopped: threading.Event, begun_at: float, stamp: Time | None) -> None:
        """Wait until the next check is due."""
        earliest = begun_at + max(_LEAST_S, self._cost_s / _DUTY)
        latest = max(earliest, begun_at + self._node.settings.values.watch_period_s)
        while (now := time.monotonic()) < latest and not stopped.wait(min(_POLL_S, latest - now)):
            moved = None if stamp is None or now < earliest else \
                self._robot.odometry.moved_since(stamp, 0.0)
            if moved is not None and (moved[0] >= _WAY_M or moved[1] >= _TURN_DEG):
                return

    def _look(self, stopped: threading.Event) -> Time | None:
        """Check the localizer's pose with one frame; return its stamp, None without a check."""
        begun_at, age = time.monotonic(), self._age
        frame = self._frames.next_frame(begun_at, begun_at + _FRAME_PATIENCE_S, 0.0, cameras=1)
        localizer = self._pipeline.localizer
        if localizer is None:
            raise StoppedError('the node was deactivated')
        if self._requests.is_busy:
            return None
        image = frame.image.header
        self._image_stamp = image.stamp
        self._jumps.check(image.stamp, frame.received_at)
        # The watch needs odometry even if fuse_frames is 1.
        parameters = replace(self._node.settings.snapshot().of_camera(frame.camera),
                             fuse_frames=MAX_FRAMES)
        state = self._robot.at(image, parameters, depth_frame=frame.depth_frame,
                               info=frame.camera_info)
        floors = self._handoff.floors.loaded
        where, pose = self._pose.at(image, state, parameters, [*floors, *localizer.frame_ids])
        self._had_pose = True

        def score() -> WatchReport | None:
            """Check the pose, in the worker's thread; None if it is outdated meanwhile."""
            localizer = self._pipeline.localizer  # a map may have been loaded meanwhile
            if localizer is None or age != self._age:
                return None
            begun_s = time.thread_time()
            try:
                return localizer.look(frame, parameters, state, floors.get(where, where), pose)
            finally:
                self._cost_s = time.thread_time() - begun_s
        report = self._node.worker.run(score, begun_at + _STALE_S)
        if report is not None:
            self._say(_Known(report.state, report.reason, report, time.monotonic()), stopped, age)
        return image.stamp

    # ---- the verdict ----------------------------------------------------------------------------

    def _say(self, known: _Known, stopped: threading.Event | None = None, age: int | None = None
             ) -> None:
        """Publish a verdict, unless the watch was stopped or the pose changed meanwhile."""
        with self._lock:
            if (stopped is not None and stopped.is_set()) or age not in (None, self._age):
                return
            before, self._known = self._known, known
            self._localized.publish(Bool(data=known.state is WatchState.LOCALIZED))
            self._state.publish(String(data=str(known.state)))
        if known.state is WatchState.LOCALIZED:
            self._pause_s, self._next_request_at = _FIRST_PAUSE_S, 0.0
        if known.state is not WatchState.LOST:
            self._reaction, self._is_at_rest = '', False
        # stamps and ages make each problem a new text
        now, said = time.monotonic(), (known.state, re.sub(r'\d[\d.]*', '', known.problem))
        if said != self._said and (known.state is not before.state
                                   or now >= self._said_at + _SAY_PERIOD_S):
            self._said, self._said_at = said, now
            text = f'watch: {known.problem or known.reason}'
            if known.state is WatchState.LOST:
                self._node.get_logger().warning(text)
            else:
                self._node.get_logger().info(text)
            self._node.diagnostics.publish()

    def _miss(self, stopped: threading.Event, problem: str, since: float = float('inf')) -> None:
        """Report why no check is possible, unless there was a check after `since`."""
        known = self._known
        if known.report is None or known.looked_at < since:
            self._say(_Known(reason=problem, problem=problem), stopped)

    def _drop(self, why: str) -> None:
        """Forget all checks."""
        with self._lock:
            self._age += 1
        self._say(_Known(reason=f'{why}: no check since'))

        def forget() -> None:
            if (localizer := self._pipeline.localizer) is not None:
                localizer.watch.forget()
        with suppress(StoppedError):
            self._node.worker.submit(forget)

    # ---- what follows ---------------------------------------------------------------------------

    def _relocalize_at_rest(self, stopped: threading.Event, stamp: Time, why: str) -> None:
        """Relocalize a robot at rest at increasing intervals, unless on_lost is report."""
        parameters = self._node.settings.values
        self._reaction = self._why_not_at_rest(parameters, stamp)
        self._is_at_rest = not self._reaction
        if not self._is_at_rest:
            return
        left_s = self._next_request_at - time.monotonic()
        if parameters.on_lost == 'report' or stopped.is_set():
            self._reaction = 'the robot is at rest'
        elif left_s > 0.0:
            self._reaction = f'the robot is at rest; next request in {left_s:.0f} s'
        else:
            self._node.get_logger().warning(f'watch: {why}, and at rest: relocalizing')
            answer = self._relocalize()
            self._next_request_at = time.monotonic() + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
            self._reaction = answer.message

    def _why_not_at_rest(self, parameters: RelocalizerParameters, stamp: Time) -> str:
        """Return why the robot may be moving; empty if odometry shows that it is at rest.

        It must be at rest at two checks, and not have moved in between: a robot that reverses
        stops for a moment.
        """
        since, self._rest_stamp = self._rest_stamp, None
        odometry = self._robot.odometry
        if not odometry.is_published:
            return (f'nobody publishes {odometry.topic}: it is unknown whether the robot is at '
                    'rest; publish odom')
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
    """The localizer's pose cannot be used for this image; its next pose may be usable."""


class PoselessError(NoLocalizerPoseError):
    """The localizer publishes no pose, as after its start."""


class _Anchor(NamedTuple):
    """Pose (4, 4) of odometry's coordinate frame in the map, from one pose of the localizer."""

    shown_ns: int
    run: int
    way_m: float
    map_from_odom: NDArray[np.float64]


class LocalizerPose:
    """The localizer's pose at the stamp of an image.

    It comes from tf2, or from the topic localizer_pose and the odometry since.

    All methods except `hear` and `forget` run in one thread.
    """

    def __init__(self, node: Node, robot: RobotStateSource, localizer: RunningLocalizer) -> None:
        self._node, self._robot, self._localizer = node, robot, localizer
        self.forget()

    def forget(self) -> None:
        """Forget all poses: time jumped, or the node is inactive."""
        self._shown: PoseWithCovarianceStamped | None = None
        self._shown_by: bytes | None = None  # GID of the publisher; None: unknown
        self._anchor: _Anchor | None = None

    def hear(self, shown: PoseWithCovarianceStamped) -> None:
        """Store a pose that the localizer published."""
        topic = self._localizer.pose_topic
        publishers = self._node.get_publishers_info_by_topic(topic) if topic else []
        self._shown_by = bytes(publishers[0].endpoint_gid) if len(publishers) == 1 else None
        self._shown = shown

    def at(self, image: Header, state: RobotState, parameters: RelocalizerParameters,
           frame_ids: Sequence[str]) -> tuple[str, NDArray[np.float64]]:
        """Return the frame_id of a map, and the camera's pose (4, 4) in it, for an image.

        `state` is the robot's state at the image's stamp, `frame_ids` are those of the maps.

        NoLocalizerPoseError: there is no pose, or it is invalid. LaterError: it is too old.
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
        if problem := self._localizer.find():
            raise NoLocalizerPoseError(problem)
        topic = self._localizer.pose_topic
        publishers = self._node.get_publishers_info_by_topic(topic) if topic else []
        if not publishers:
            raise NoLocalizerPoseError('the localizer publishes no pose: set watch: tf')
        publisher = bytes(publishers[0].endpoint_gid)
        self._shown_by = self._shown_by or publisher
        if self._shown_by != publisher:
            self.forget()  # the localizer was restarted and has not published a pose yet
        shown = self._shown
        if shown is None:
            raise PoselessError(f'no pose on {topic} yet: AMCL publishes one when the robot '
                                'drives; with watch: tf it is not needed')
        if why := stamp_problem(shown.header.stamp):
            raise NoLocalizerPoseError(f'the stamp of {topic} {why}: the localizer must stamp its '
                                       'pose')
        pose, place = pose_from_msg(shown.pose.pose), state.place
        if pose is None:
            raise NoLocalizerPoseError(f'the pose on {topic} has NaN or a quaternion that is not '
                                       "of unit length: see the localizer's log")
        shown_ns, frame_id = stamp_ns(shown.header.stamp), shown.header.frame_id.lstrip('/')
        if place is None:
            since_ns = stamp_ns(image.stamp) - shown_ns
            if abs(since_ns) > _UNLINKED_NS:
                raise NoLocalizerPoseError(
                    f'{topic} is {since_ns / NS_PER_S:.1f} s older than the image, and odom does '
                    'not cover the time since: publish odom')
            return frame_id, pose @ invert_transform(state.camera_from_base)
        anchor = self._anchor
        if anchor is None or (anchor.shown_ns, anchor.run) != (shown_ns, place.run):
            then = self._robot.at(Header(stamp=shown.header.stamp, frame_id=image.frame_id),
                                  parameters)
            if then.place is None or then.place.run != place.run:
                raise LaterError(f'odom does not cover the time since {topic} was published: wait '
                                 'for the next pose')
            # the pose of odometry's frame in the map, by the localizer's newest pose
            anchor = self._anchor = _Anchor(
                shown_ns, place.run, then.place.way_m, pose @ invert_transform(
                    then.place.odom_from_frame @ then.camera_from_base))
        if place.way_m - anchor.way_m > _SILENT_WAY_M:
            raise NoLocalizerPoseError(
                f'no message on {topic} for {place.way_m - anchor.way_m:.1f} m of driving: '
                f'{self._localizer.silence()}')
        return frame_id, anchor.map_from_odom @ place.odom_from_frame
