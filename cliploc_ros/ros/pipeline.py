# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From one frame to its answer: robot state, localizer, acceptance, outputs."""

import math
from dataclasses import replace
from functools import partial

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer, Verdict
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.time_jumps import TimeJumps
from cliploc_ros.ros.localizer import Localized, Localizer, load_localizer
from cliploc_ros.ros.node.diagnostics import StageTimes, in_words
from cliploc_ros.ros.node.lifecycle import ManagedNode, NotActiveError
from cliploc_ros.ros.outputs.map_to_odom import MapToOdom
from cliploc_ros.ros.outputs.visualization import Visualization


class Pipeline:
    """Localizes with one frame at a time and publishes the result.

    All methods but open and close run in the node's worker, one after another.

    Parameters
    ----------
    node : ManagedNode
    robot : RobotStateSource
    jumps : TimeJumps
    """

    def __init__(self, node: ManagedNode, robot: RobotStateSource, jumps: TimeJumps) -> None:
        self._node = node
        self._jumps = jumps
        self._robot = robot
        self.localizer: Localizer | None = None
        self._pose = node.create_publisher(PoseWithCovarianceStamped, '~/pose', qos.POSE)
        self._map_to_odom = MapToOdom(node, robot.transforms)
        robot.odometry.on_restart(self._map_to_odom.forget)
        self._visualization = Visualization(node)

    def load(self) -> str:
        """Load map and network; return what was loaded, in one line."""
        return self._use(load_localizer(self._node, self._node.settings.snapshot()))

    def reload_map(self) -> str:
        """Read the map again; return what was loaded, in one line."""
        if self.localizer is None:
            raise NotActiveError(f'the node is {self._node.state}')
        return self._use(self.localizer.reloaded(self._node, self._node.settings.snapshot()))

    def unload(self) -> None:
        """Drop map and network."""
        self.localizer = None
        self._visualization.set_map(None)

    def open(self) -> None:
        """Begin to broadcast map -> odom where that is asked for."""
        if self._node.settings['publish_tf']:
            self._map_to_odom.open()

    def close(self) -> None:
        """Stop broadcasting."""
        self._map_to_odom.close()

    def forget(self) -> None:
        """Drop map -> odom until the next accepted pose: time jumped."""
        self._map_to_odom.forget()

    def localize(self, frame: Frame, times: StageTimes | None = None,
                 deadline: float = math.inf) -> Answer:
        """Localize with one frame and publish what was found.

        Parameters
        ----------
        frame : Frame
        times : StageTimes, optional
            Of this frame; new ones since its image arrived by default.
        deadline : float
            When to stop comparing crops (monotonic clock) [s].

        Raises
        ------
        TimeJumpError
            Time jumped back since the frame arrived, or odometry restarted where its frame is
            broadcast; nothing was published.
        CliplocError
            Names what to fix in the frame or in the parameters.
        """
        if times is None:
            times = StageTimes('detection', frame.received_at)
            times.begin('waiting', frame.detected_at)
        values = self._node.settings.snapshot()
        self._node.check_active()
        localizer = self.localizer
        assert localizer is not None  # an active node has one
        image = frame.image.header
        self._jumps.check(image.stamp, frame.received_at)
        state = self._robot.at(image, values, deadline)
        localized = localizer.localize(frame, values, state, times, deadline)
        stages_ms = times.ms
        self._node.stages.add(stages_ms)
        self._node.check_active()
        self._jumps.check(image.stamp, frame.received_at)
        header = Header(stamp=image.stamp, frame_id=localized.landmark_map.frame_id)
        answer = replace(
            self._answer(header, localized, state, frame.received_at, in_words(stages_ms)),
            is_cut=localized.is_cut, stages_ms=stages_ms, map_hash=localizer.map_hash)
        self._show(image, header, localized, state, answer)
        return answer

    def _use(self, localizer: Localizer) -> str:
        self.localizer = localizer
        self._visualization.set_map(localizer.landmark_map, None if localizer.keyframes is None
                                    else localizer.keyframes.layer)
        return localizer.description

    def _answer(self, header: Header, localized: Localized, state: RobotState,
                received_at: float, times: str) -> Answer:
        """Publish an accepted pose; return the verdict in words."""
        found = localized.found
        summary = f'[{_summary(localized)}; {times}]'
        if not found.accepted:
            return Answer(Verdict.REFUSED, f'{found.reason} {summary}', None, received_at, state,
                          kind=found.refusal_kind)
        assert found.covariance is not None and found.map_from_camera is not None
        assert localized.for_filter is not None
        map_from_base = found.map_from_camera @ state.camera_from_base
        lever = map_from_base[:3, 3] - found.map_from_camera[:3, 3]
        pose, for_filter = (pose_with_covariance_msg(header, map_from_base, move_covariance(
            covariance, lever)) for covariance in (found.covariance, localized.for_filter))
        x, y, z = map_from_base[:3, 3]
        answer = Answer(Verdict.ACCEPTED, f'x {x:.2f} y {y:.2f} z {z:.2f} m in {header.frame_id} '
                                          f'{summary}', pose, received_at, state)
        try:
            self._map_to_odom.update(header, map_from_base, self._node.settings.snapshot(),
                                     received_at)
        except NoTransformError as error:
            answer = replace(answer, verdict=Verdict.WITHHELD, pose=None,
                             detail=f'publish_tf: {error} ({answer.message})')
        self._pose.publish(for_filter)
        return answer

    def _show(self, image: Header, header: Header, localized: Localized, state: RobotState,
              answer: Answer) -> None:
        """Publish hypotheses and matches, and queue the debug image behind the answer."""
        self._visualization.show(header, localized.landmark_map, localized.found,
                                 state.camera_from_base)
        if self._visualization.wants_debug_image:
            self._node.worker.submit(partial(
                self._visualization.show_debug_image, image, localized.seen,
                localized.landmark_map, localized.found, answer.message))


def _summary(localized: Localized) -> str:
    found, seen = localized.found, localized.seen.observation
    crops = '' if seen.similarities is None else \
        f', CLIP of {localized.compared} of {len(seen.detections)} crops'
    keyframes = '' if found.source == 'objects' else f', pose by {found.source}'
    if found.recognized is not None:
        keyframes += f', {found.recognized.inliers} points of keyframes agree'
    return (f'confidence {found.confidence:.3f}, score {found.score:.2f}, '
            f'{len(found.matches)} inliers, {found.tried} hypotheses, '
            f'{100 * found.coverage:.3g} % of the search{crops}{keyframes}')
