# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Answer requests: localize with frames, publish and deliver, until accepted or time is up."""

import math
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.errors import CliplocError, HandOffError, NoLocalizerError, TimeUpError
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer, CaseRecorder, Verdict, answer_to
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.frame_localizer import FrameLocalizer, Localized, load_localizer
from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, NoFrameError
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps
from cliploc_ros.ros.map_to_odom import MapToOdom
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.node.lifecycle import LOG_PERIOD_S, ManagedNode, NotActiveError
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.visualization import Visualization

# Each frame without odometry adds to the risk of a false accept.
_MAX_UNLINKED = 3
# The current request ends at its own deadline, shortly before that of the waiting requests.
_GRACE_S = 0.2

# The name of each stage in messages, and how to make it faster.
_STAGES = {
    'image': ('waiting for an image with detections',
              'raise the rate of the camera or of the detector'),
    'detection': ('the detector', 'choose a faster profile or a smaller detector'),
    'waiting': ('waiting for earlier work or for /tf', 'retry'),
    'decoding': ('reading the image', 'use smaller images'),
    'CLIP': ('CLIP', 'choose a faster profile or a smaller CLIP'),
    'search': ('the search', 'lower iterations or time_budget_ms'),
    'keyframes': ('matching keyframes', "set keyframes_file to ''")}


class Look(NamedTuple):
    """The result of one frame, which is not published yet."""

    answer: Answer
    localized: Localized
    state: RobotState  #: The robot at the stamp of the frame
    image: Header  #: Of the image of the frame


class Pipeline:
    """Localizes with one frame at a time and publishes the result.

    All methods except `publish` run in the node's worker thread.
    """

    def __init__(self, node: ManagedNode[RelocalizerParameters], robot: RobotStateSource,
                 jumps: TimeJumps, map_to_odom: MapToOdom) -> None:
        self._node, self._robot, self._jumps = node, robot, jumps
        self._map_to_odom = map_to_odom
        self.localizer: FrameLocalizer | None = None
        #: Called in the worker's thread after a map was loaded.
        self.on_map: Callable[[], None] = lambda: None
        self._pose = node.create_publisher(PoseWithCovarianceStamped, '~/pose', qos.POSE)
        self._visualization = Visualization(node)

    def load(self, former: FrameLocalizer | None = None) -> FrameLocalizer:
        """Load map and network, and return them. Keep the network of a former localizer."""
        localizer = load_localizer(self._node, self._node.settings.snapshot(), former)
        self.localizer = localizer
        self._visualization.set_map(localizer.landmark_map, None if localizer.keyframes is None
                                    else localizer.keyframes.localizer.layer)
        self.on_map()
        return localizer

    def reload_map(self) -> FrameLocalizer:
        """Read the map again; return the new localizer."""
        former = self.localizer
        if former is None:
            raise NotActiveError(f'the node is {self._node.state}')
        return self.load(former)

    def unload(self) -> None:
        """Drop map and network."""
        self.localizer = None
        self._visualization.set_map(None)

    def localize(self, frame: Frame, times: StageTimes | None = None,
                 deadline: float = math.inf) -> Look:
        """Localize with a frame; publish nothing, because the request may end meanwhile.

        `times` start when the image arrived by default. No crops are compared after `deadline`
        (monotonic clock) [s].

        Raises
        ------
        TimeJumpError
            Time jumped back since the frame arrived.
        CliplocError
            The frame or the parameters are invalid.
        """
        if times is None:
            times = StageTimes('detection', frame.received_at)
            times.begin('waiting', frame.detected_at)
        parameters = self._node.settings.snapshot()
        self._node.check_active()
        localizer = self.localizer
        assert localizer is not None  # an active node has loaded it
        self._jumps.check(frame.image.header.stamp, frame.received_at)
        known = self._robot.at_instant(frame, parameters, localizer.frame_ids, localizer.map_hash,
                                       deadline)
        localized = localizer.localize(frame, parameters, known, times, deadline)
        stages_ms = times.ms
        self._node.stages.add(stages_ms)
        if faults := '; '.join(fault.text for fault in localizer.instants.faults):
            self._node.get_logger().warning(faults, throttle_duration_sec=LOG_PERIOD_S)
        return Look(answer_to(frame, localized, known.state, parameters, localizer.map_hash,
                              stages_ms), localized, known.state, frame.image.header)

    def publish(self, look: Look, deadline: float = math.inf) -> Answer:
        """Publish the result of a frame; return its answer, withheld if its tf is missing.

        No transform is waited for after `deadline` (monotonic clock) [s].

        TimeJumpError: time jumped back since the frame arrived, or, with publish_tf, odometry
        restarted. Nothing was published.
        """
        answer, localized, state, image = look
        found, pose, header = localized.found, answer.pose, answer.header
        self._node.check_active()
        self._jumps.check(image.stamp, answer.received_at)
        assert header is not None
        parameters, carried = self._node.settings.snapshot(), localized.carried
        try:
            if carried is not None:
                self._map_to_odom.update(
                    header, carried @ state.camera_from_base, replace(
                        parameters, tf_timeout_s=min(parameters.tf_timeout_s, max(
                            0.0, deadline - time.monotonic()))), answer.received_at)
            elif pose is not None:
                self._map_to_odom.pause()
        except NoTransformError as error:
            answer = answer.withheld(f'publish_tf: {error}') if pose is not None else answer
        if pose is not None:
            assert found.map_from_camera is not None and localized.for_filter is not None
            map_from_base = found.map_from_camera @ state.camera_from_base
            self._pose.publish(pose_with_covariance_msg(header, map_from_base, move_covariance(
                localized.for_filter, map_from_base[:3, 3] - found.map_from_camera[:3, 3])))
            self._robot.prior.keep(pose, parameters, answer.map_hash)
        self._visualization.show(header, localized.landmark_map, found, state.camera_from_base)
        if self._visualization.wants_debug_image:  # drawn later, so that it delays no answer
            self._node.worker.submit(partial(
                self._visualization.show_debug_image, image, localized.seen,
                localized.landmark_map, found, answer.message))
        return answer


class Requests:
    """Answers requests one at a time.

    A request that had to wait gets the previous answer if the image of that answer arrived after
    the request. Thus simultaneous requests need one search and reset the localizer once.
    Otherwise it is answered with new frames. Without `handoff`, poses are neither published nor
    delivered.
    """

    def __init__(self, node: ManagedNode[RelocalizerParameters], frames: CameraRig,
                 robot: RobotStateSource, jumps: TimeJumps, pipeline: Pipeline,
                 cases: CaseRecorder, handoff: HandOff | None) -> None:
        self._node, self._frames, self._robot, self._jumps = node, frames, robot, jumps
        self._pipeline, self._cases, self._handoff = pipeline, cases, handoff
        self._turn = threading.Lock()
        self._numbers = count(1)
        self._previous = Answer(Verdict.FAILED, 'no request yet')

    @property
    def is_busy(self) -> bool:
        """Return whether a request is under way."""
        return self._turn.locked()

    def answer(self) -> Answer:
        """Return the answer to a request that arrives now, within timeout_s."""
        arrived_at = time.monotonic()
        deadline = arrived_at + self._node.settings.values.timeout_s
        if not self._turn.acquire(timeout=deadline - arrived_at + _GRACE_S):
            return Answer(Verdict.FAILED, 'earlier requests took all of timeout_s: retry',
                          number=next(self._numbers))
        try:
            if self._previous.received_at <= arrived_at:
                self._previous = self._guarded(arrived_at, deadline)
            return self._previous
        finally:
            self._turn.release()

    def _guarded(self, arrived_at: float, deadline: float) -> Answer:
        """Return an answer, also for errors of any kind, and log it in one line."""
        try:
            # A map or weights that were missing may be available now.
            self._node.bring_up(deadline)
            answer = self._look_until(deadline, arrived_at)
        except CliplocError as error:
            answer = Answer(Verdict.FAILED, str(error))
        except Exception as error:
            self._node.report(traceback.format_exc())
            answer = Answer(Verdict.FAILED,
                            f'internal error: {error} (the traceback is in the log)')
        self._node.get_logger().info(answer.message)
        return replace(answer, number=next(self._numbers))

    def _look_until(self, deadline: float, arrived_at: float) -> Answer:
        """Localize with one frame after another while a further frame can change the answer."""
        last: Answer | None = None
        problem: CliplocError | None = None
        stages_ms: Counter[str] = Counter()
        unlinked, after, may_go_on, is_up = 0, arrived_at, True, False
        while may_go_on and unlinked < _MAX_UNLINKED:
            times = StageTimes('image', after)
            try:
                frame = self._frames.next_frame(after, deadline)
                times.begin('detection', frame.received_at)
                times.begin('waiting', frame.detected_at)
                answer, may_go_on = self._deliver(self._node.worker.run(
                    partial(self._pipeline.localize, frame, times, deadline), deadline), deadline)
            except (TimeJumpError, NoTransformError) as error:  # a newer frame may work
                problem, after = error, time.monotonic()
                if after <= deadline - _GRACE_S:
                    continue
                if last is None:
                    raise
                is_up = True
                break
            except (NoFrameError, TimeUpError) as error:
                if last is not None:
                    is_up = True
                    break
                if problem is not None or isinstance(error, NoFrameError):
                    raise problem or error from error
                return Answer(Verdict.REFUSED, time_is_up(times.ms), kind=RefusalKind.TIME_UP)
            may_go_on = may_go_on and self._robot.is_linked_soon(frame.image.header.stamp,
                                                                 deadline)
            last, is_up, after = answer, answer.is_cut, time.monotonic()
            unlinked += answer.query is None or answer.query.run is None  # by odometry
            stages_ms.update(answer.stages_ms)
        assert last is not None
        # a refusal of another kind needs other remedies
        if is_up and last.verdict is Verdict.REFUSED and (
                last.is_cut or last.kind is RefusalKind.TIME_UP):
            last = replace(last, detail=f'{last.detail}; {time_is_up(stages_ms)}')
        return replace(last, time_s=time.monotonic() - arrived_at)

    def _deliver(self, look: Look, deadline: float) -> tuple[Answer, bool]:
        """Publish a result and hand its pose over; return the answer, and whether to go on.

        It is published here and not by the worker, which goes on after a time-out.
        """
        if self._handoff is None:
            return look.answer, look.answer.pose is None
        answer = self._pipeline.publish(look, deadline)
        self._cases.add(answer)
        if answer.pose is None:
            return answer, True
        try:
            self._handoff.hand_over(answer.pose, self._node.settings.snapshot(), deadline,
                                    answer.received_at, self._jumps,
                                    getattr(self._pipeline.localizer, 'grids', {}))
        except HandOffError as error:
            return answer.withheld(str(error)), not isinstance(error, NoLocalizerError)
        return answer, False


def time_is_up(stages_ms: Mapping[str, float]) -> str:
    """Return a message with the slowest stage of a request and its remedy."""
    stage = max(stages_ms, key=lambda name: stages_ms[name])
    (name, remedy), total_s = _STAGES[stage], sum(stages_ms.values()) / 1e3
    return (f'time is up: {name} took {stages_ms[stage] / 1e3:.1f} of {total_s:.1f} s; '
            f'raise timeout_s, or {remedy}')
