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

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header

from cliploc_ros.core.acceptance.verdict import RefusalKind, needed_confidence
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.errors import CliplocError, TimeUpError
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer, CaseRecorder, Verdict, deviations
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.frame_localizer import FrameLocalizer, Localized, load_localizer
from cliploc_ros.ros.handoff import HandOff, HandOffError, MapToOdom, NoLocalizerError
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, NoFrameError
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps
from cliploc_ros.ros.node.diagnostics import StageTimes, in_words
from cliploc_ros.ros.node.lifecycle import ManagedNode, NotActiveError
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.visualization import Visualization

_LOG_PERIOD_S = 5.0
# Each frame without odometry adds to the risk of a false accept.
_MAX_UNLINKED = 3
# The current request ends at its own deadline, shortly before that of the waiting requests.
_GRACE_S = 0.2

# Refusals of images without objects of the map.
_WITHOUT_OBJECTS = (RefusalKind.TOO_FEW_OBJECTS, RefusalKind.WRONG_DETECTIONS)

_SMALLER = 'choose a faster profile or a smaller'
# The name of each stage in messages, and how to make it faster.
_STAGES = {'image': 'waiting for an image with detections', 'detection': 'the detector',
           'waiting': 'waiting for earlier work or for /tf', 'decoding': 'reading the image',
           'CLIP': 'CLIP', 'search': 'the search', 'keyframes': 'matching keyframes'}
_REMEDIES = {'image': 'raise the rate of the camera or of the detector',
             'detection': f'{_SMALLER} detector',
             'waiting': 'retry', 'decoding': 'use smaller images', 'CLIP': f'{_SMALLER} CLIP',
             'search': 'lower iterations or time_budget_ms',
             'keyframes': "set keyframes_file to ''"}


class Pipeline:
    """Localizes with one frame at a time and publishes the result.

    All methods run in the node's worker thread.
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

    def load(self) -> str:
        """Load map and network; return a description of them in one line."""
        return self._use(load_localizer(self._node, self._node.settings.snapshot())).description

    def reload_map(self) -> FrameLocalizer:
        """Read the map again; return the new localizer."""
        former = self.localizer
        if former is None:
            raise NotActiveError(f'the node is {self._node.state}')
        return self._use(load_localizer(self._node, self._node.settings.snapshot(), former))

    def unload(self) -> None:
        """Drop map and network."""
        self.localizer = None
        self._visualization.set_map(None)

    def localize(self, frame: Frame, times: StageTimes | None = None,
                 deadline: float = math.inf) -> Answer:
        """Localize with one frame and publish the result.

        `times` start when the image arrived by default. No crops are compared after `deadline`
        (monotonic clock) [s].

        Raises
        ------
        TimeJumpError
            Time jumped back since the frame arrived, or, with publish_tf, odometry restarted.
            Nothing was published.
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
        image = frame.image.header
        self._jumps.check(image.stamp, frame.received_at)
        known = self._robot.at_instant(frame, parameters, localizer.frame_ids, localizer.map_hash,
                                       deadline)
        localized = localizer.localize(frame, parameters, known, times, deadline)
        state = known.state
        stages_ms = times.ms
        self._node.stages.add(stages_ms)
        if faults := '; '.join(fault.text for fault in localizer.instants.faults):
            self._node.get_logger().warning(faults, throttle_duration_sec=_LOG_PERIOD_S)
        self._node.check_active()
        self._jumps.check(image.stamp, frame.received_at)
        header = Header(stamp=image.stamp, frame_id=localized.landmark_map.frame_id)
        found = localized.found
        answer = Answer(Verdict.REFUSED, f'{found.reason} {_summary(localized, stages_ms)}',
                        None, frame.received_at, localized.query, localized.is_cut, stages_ms,
                        localizer.map_hash, found.refusal_kind, header,
                        _figures(localized, parameters))
        if found.accepted:
            answer = self._publish(header, localized, state, replace(
                answer, verdict=Verdict.ACCEPTED, detail=_summary(localized, stages_ms)))
        self._visualization.show(header, localized.landmark_map, found, state.camera_from_base)
        if self._visualization.wants_debug_image:  # drawn later, so that it delays no answer
            self._node.worker.submit(partial(
                self._visualization.show_debug_image, image, localized.seen,
                localized.landmark_map, found, answer.message))
        return answer

    def _use(self, localizer: FrameLocalizer) -> FrameLocalizer:
        self.localizer = localizer
        self._visualization.set_map(localizer.landmark_map, None if localizer.keyframes is None
                                    else localizer.keyframes.localizer.layer)
        self.on_map()
        return localizer

    def _publish(self, header: Header, localized: Localized, state: RobotState,
                 answer: Answer) -> Answer:
        """Publish an accepted pose; return the answer with it, withheld if its tf is missing."""
        found = localized.found
        assert found.covariance is not None and found.map_from_camera is not None
        assert localized.for_filter is not None
        map_from_base = found.map_from_camera @ state.camera_from_base
        lever = map_from_base[:3, 3] - found.map_from_camera[:3, 3]
        pose, for_filter = (pose_with_covariance_msg(header, map_from_base, move_covariance(
            covariance, lever)) for covariance in (found.covariance, localized.for_filter))
        parameters = self._node.settings.snapshot()
        x, y, z = map_from_base[:3, 3]
        # the heading of a robot is its x axis, that of a camera its viewing direction (z axis)
        ahead = map_from_base[:2, 0 if parameters.base_frame else 2]
        heading_deg = math.degrees(math.atan2(ahead[1], ahead[0]))
        position_m, turn_deg = deviations(np.reshape(pose.pose.covariance, (6, 6)))
        answer = replace(answer, pose=pose, detail=(
            f'x {x:.2f} y {y:.2f} z {z:.2f} m in {header.frame_id}, heading {heading_deg:.0f} '
            f'deg, deviation {position_m:.2f} m and {turn_deg:.1f} deg {answer.detail}'),
            heading_deg=heading_deg)
        try:
            self._map_to_odom.update(header, map_from_base, parameters, answer.received_at)
        except NoTransformError as error:
            answer = replace(answer, verdict=Verdict.WITHHELD, pose=None,
                             detail=f'publish_tf: {error} (accepted: {answer.detail})')
        self._pose.publish(for_filter)
        self._robot.prior.keep(pose, parameters, answer.map_hash)
        return answer


class Requests:
    """Answers requests one at a time.

    A request that had to wait gets the previous answer if the image of that answer arrived after
    the request. Thus simultaneous requests need one search and reset the localizer once.
    Otherwise it is answered with new frames.
    """

    def __init__(self, node: ManagedNode[RelocalizerParameters], frames: CameraRig,
                 robot: RobotStateSource, jumps: TimeJumps, pipeline: Pipeline,
                 cases: CaseRecorder, handoff: HandOff) -> None:
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
        looks, unlinked, after, may_go_on, is_up = 0, 0, arrived_at, True, False
        while may_go_on and unlinked < _MAX_UNLINKED:
            times = StageTimes('image', after)
            try:
                frame = self._frames.next_frame(after, deadline)
                times.begin('detection', frame.received_at)
                times.begin('waiting', frame.detected_at)
                answer = self._node.worker.run(
                    partial(self._look, frame, times, deadline), deadline)
                answer, may_go_on = self._hand_over(answer, deadline)
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
            looks += 1
            unlinked += not answer.is_linked
            stages_ms.update(answer.stages_ms)
        assert last is not None
        # further images do not help if no objects of the map are visible
        if is_up and last.verdict is Verdict.REFUSED and (
                last.is_cut or last.kind not in _WITHOUT_OBJECTS):
            last = replace(last, detail=f'{last.detail}; {time_is_up(stages_ms)}')
        if looks == 1:
            return last
        return replace(last, detail=f'{last.detail} [{looks} frames in '
                                    f'{time.monotonic() - arrived_at:.1f} s]')

    def _look(self, frame: Frame, times: StageTimes, deadline: float) -> Answer:
        """Localize with a frame and record it; runs in the worker's thread."""
        answer = self._pipeline.localize(frame, times, deadline)
        self._cases.add(answer)
        return answer

    def _hand_over(self, answer: Answer, deadline: float) -> tuple[Answer, bool]:
        """Deliver an accepted pose; return the answer, and whether another frame may help."""
        if answer.pose is None:
            return answer, True
        try:
            self._handoff.hand_over(answer.pose, self._node.settings.snapshot(), deadline,
                                    answer.received_at, self._jumps)
        except HandOffError as error:
            return (replace(answer, verdict=Verdict.WITHHELD, pose=None,
                            detail=f'{error} ({answer.message})'),
                    not isinstance(error, NoLocalizerError))
        return answer, False


def _summary(localized: Localized, stages_ms: Mapping[str, float]) -> str:
    found, seen = localized.found, localized.seen.observation
    crops = '' if seen.similarities is None else \
        f', CLIP of {localized.compared} of {len(seen.detections)} crops'
    keyframes = '' if found.source == 'objects' else f', pose by {found.source}'
    if found.recognized is not None:
        keyframes += f', {found.recognized.inliers} points of keyframes agree'
    if found.keyframe_search == 'thorough':
        keyframes += ', thorough search of keyframes'
    count = len(localized.query.frames)
    cameras = f', {count} cameras' if count > 1 else ''
    if localized.left_out:
        cameras += f', no image of {", ".join(localized.left_out)}'
    depth = ''
    if found.depth is not None:
        depth = f', depth of {found.depth.objects} objects' if found.depth.is_passed \
            else ', depth contradicts the boxes'
    prior = ''
    if found.evidence is not None and found.evidence.prior:
        prior = f', prior {found.evidence.prior:.1f}'
    # do not repeat, with other rounding, a confidence that the reason of a refusal already states
    confidence = '' if 'confidence' in found.reason else f'confidence {found.confidence:.3f}, '
    frames = f' in {len(found.frame_matches)} frames' if len(found.frame_matches) > 1 else ''
    return (f'[{confidence}score {found.score:.2f}, '
            f'{0 if found.evidence is None else found.evidence.inliers} landmarks{frames}, '
            f'{found.tried} hypotheses, '
            f'{100 * found.coverage:.3g} % of the search{crops}{keyframes}{depth}{cameras}'
            f'{prior}; '
            f'{in_words(stages_ms)}]')


def _figures(localized: Localized, parameters: RelocalizerParameters) -> dict[str, object]:
    """Return the values that decided the answer to a frame, for its diagnostic message."""
    found = localized.found
    evidence, points = found.evidence, found.recognized
    needed = parameters.min_confidence if evidence is None else needed_confidence(
        evidence, parameters.options())
    return {'source': found.source if found.solved else '', 'frames': len(found.frame_matches),
            'cameras': len(localized.query.frames), 'confidence': f'{found.confidence:.6f}',
            'confidence needed': f'{needed:g}',
            'landmarks': 0 if evidence is None else evidence.inliers,
            'keyframe points': 0 if points is None else points.inliers,
            'keyframe search': found.keyframe_search}


def time_is_up(stages_ms: Mapping[str, float]) -> str:
    """Return a message with the slowest stage of a request and its remedy."""
    stage = max(stages_ms, key=lambda name: stages_ms[name])
    total_s = sum(stages_ms.values()) / 1e3
    return (f'time is up: {_STAGES[stage]} took {stages_ms[stage] / 1e3:.1f} of {total_s:.1f} s; '
            f'{_REMEDIES[stage]}, or raise timeout_s')
