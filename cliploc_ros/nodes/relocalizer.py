# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer node: from image and detections to the robot's pose, when asked."""

import re
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NoReturn

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from std_msgs.msg import Header
from std_srvs.srv import Empty, Trigger

from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError
from cliploc_ros.ros.inputs.odometry import CameraPlace, OdometrySource
from cliploc_ros.ros.inputs.odometry_window import NoOdometryError
from cliploc_ros.ros.inputs.time_jumps import TimeJumpError, TimeJumps
from cliploc_ros.ros.inputs.vertical import NoVerticalError, VerticalSource
from cliploc_ros.ros.lingering import Lingering
from cliploc_ros.ros.localizer import Localizer, load_localizer
from cliploc_ros.ros.node.diagnostics import Health, StageTimes
from cliploc_ros.ros.node.lifecycle import ManagedNode, NotActiveError
from cliploc_ros.ros.node.process import run_node
from cliploc_ros.ros.node.requests import MAX_REQUESTS, BoundedCallbackGroup, Flights
from cliploc_ros.ros.node.worker import LatestOnly
from cliploc_ros.ros.outputs.debug_image import SeenImage
from cliploc_ros.ros.outputs.handoff import HandOff, HandOffError, NoLocalizerError
from cliploc_ros.ros.outputs.map_to_odom import MapToOdom
from cliploc_ros.ros.outputs.visualization import Visualization
from cliploc_ros.ros.parameter_tables import RELOCALIZER, relocalizer_options

_LOG_PERIOD_S = 5.0
_VERDICTS = ('accepted', 'refused', 'withheld')
# Each image that odometry does not join to those before is another chance to be wrong.
_MAX_ALONE = 3


@dataclass(frozen=True)
class Answer:
    """What a frame led to: a pose to publish or None, and one line that says why."""

    pose: PoseWithCovarianceStamped | None
    message: str
    #: Whether the next frame may change it, together with those before.
    is_open: bool = False
    #: Whether it comes from any frame.
    has_frame: bool = True
    #: Whether it was refused by one frame alone.
    is_alone: bool = False


class RelocalizerNode(ManagedNode):
    """Answers where the robot is, when asked or with every frame."""

    def __init__(self) -> None:
        super().__init__('relocalizer', RELOCALIZER, relocalizer_options)
        self._localizer: Localizer | None = None
        self._transforms = CoordinateFrames(self)
        self._vertical = VerticalSource(self, self._transforms)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, '~/pose', qos.POSE)
        self._map_to_odom = MapToOdom(self, self._transforms)
        self._odometry = OdometrySource(self, self._transforms)
        self._handoff = HandOff(self, self._odometry)
        self._visualization = Visualization(self)
        self._continuous = LatestOnly(self.worker, self._localize_and_log)
        self._frames: FrameSource | None = None
        self._listening = ExitStack()
        self._lingering = Lingering(self)
        self._jumps = TimeJumps(self, self._forget)
        self._verdict = 'none yet'
        self._verdicts = dict.fromkeys((*_VERDICTS, 'failed'), 0)
        self._flights: Flights[Answer] = Flights(self._wake_up)
        requests = BoundedCallbackGroup(MAX_REQUESTS)
        self.create_service(Trigger, '~/relocalize', self._on_relocalize,
                            qos_profile=qos.SERVICE, callback_group=requests)
        self.create_service(Trigger, '~/reload_map', self._on_reload_map,
                            qos_profile=qos.SERVICE, callback_group=requests)
        self.create_service(Empty, 'reinitialize_global_localization', self._on_reinitialize,
                            qos_profile=qos.SERVICE, callback_group=requests)

    def load(self) -> str:
        """Load map and network."""
        self._localizer = load_localizer(self, self.settings.snapshot())
        self._visualization.set_map(self._localizer.landmark_map)
        return self._localizer.description

    def unload(self) -> None:
        """Let go map and network."""
        self._localizer = None
        self._visualization.set_map(None)

    def open(self) -> None:
        """Be ready for requests; in continuous mode listen to frames."""
        self._handoff.open()
        self._lingering.open()
        if self.settings['publish_tf'] or (self.settings['base_frame']
                                           and not any(self.settings['base_from_camera'])):
            self.worker.run(self._transforms.open)
        if self.settings['publish_tf']:
            self._map_to_odom.open()
        self._vertical.open(self.settings['gravity'])
        self._frames = FrameSource(self, self.settings['image_transport'], self._on_frame)
        if (re.search('[/_]rect', self._frames.image_topic)
                and not self.settings['rectified']):
            self.get_logger().warning(
                f'{self._frames.image_topic} sounds rectified, but the parameter rectified is '
                'false: poses would be wrong by as much as the lens distorts')
        if self.settings['mode'] == 'continuous':
            self._listen(self._listening, self._frames)

    def close(self) -> None:
        """Let go the request that waits for frames, and stop to listen."""
        self._handoff.stop()
        self._map_to_odom.close()
        self._vertical.close()
        if self._frames is not None:
            self._frames.stop('the node was deactivated')
        self._listening.close()
        self._lingering.close()
        self.worker.submit(self._transforms.close)  # after a search that may be under way

    def _forget(self) -> None:
        """Forget all input: time jumped."""
        for part in (self._frames, self._transforms, self._odometry, self._vertical,
                     self._map_to_odom, self._handoff):
            if part is not None:
                part.forget()

    def release(self) -> None:
        """Let go the request that waits for frames: the process ends."""
        self._handoff.stop()
        if self._frames is not None:
            self._frames.stop('the node is shutting down')

    def _on_reload_map(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Read the map anew; in the worker's thread, and so never in the middle of a search."""
        try:
            response.message = f'loaded: {self.worker.run(self._reload_map)}'
            response.success = True
        except CliplocError as error:
            response.message = f'not loaded: {error}'
        self.get_logger().info(f'map {response.message}')
        return response

    def _reload_map(self) -> str:
        if self._localizer is None:
            raise NotActiveError(f'the node is {self.state}')
        self._localizer = self._localizer.reloaded(self, self.settings.snapshot())
        self._visualization.set_map(self._localizer.landmark_map)
        return self._localizer.description

    def _on_relocalize(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answer = self._request()
        response.success = answer.pose is not None
        response.message = answer.message
        return response

    def _on_reinitialize(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        self._request()
        return response

    def _request(self) -> Answer:
        """Answer from the next fresh frame; while odometry joins them, from those after, too."""
        start, timeout_s = time.monotonic(), self.settings['timeout_s']
        with ExitStack() as listening:
            if self.active and self._frames is not None:
                self._listen(listening, self._frames)
            answer, frames = self._flights.board(timeout_s), 1
            alone = int(answer.is_alone)
            while (answer.is_open and alone < _MAX_ALONE) or not answer.has_frame:
                left_s = start + timeout_s - time.monotonic()
                if left_s <= 0.0:
                    break
                later = self._flights.board(left_s)
                if later.has_frame:
                    answer, frames = later, frames + 1
                    alone += later.is_alone
            self._lingering.keep(listening.pop_all())
        if frames > 1:
            answer = replace(answer, message=f'{answer.message} [{frames} frames in '
                                             f'{time.monotonic() - start:.1f} s]')
            self.get_logger().info(answer.message)
        return answer

    def _listen(self, listening: ExitStack, frames: FrameSource) -> None:
        """Listen to all that an answer is made from; frames are the last to begin."""
        listening.enter_context(self._odometry.listening())
        listening.enter_context(frames.listening())

    def _wake_up(self, depart: Callable[[], None], timeout_s: float) -> Answer:
        """Localize from the next fresh frame, and tell a running localizer of success.

        Called once for all requests that wait at the same time: those that come after depart
        ask for a frame newer than this one.
        """
        deadline = time.monotonic() + timeout_s
        try:
            # A map or weights that were missing may have been mended since.
            self.bring_up()
            assert self._frames is not None  # an active node has them
            with ExitStack() as listening:
                self._listen(listening, self._frames)
                frame = self._frames.wait_for_fresh(timeout_s)
                depart()
                answer = self._handed_over(self.worker.run(lambda: self._localize(frame)),
                                           deadline)
                if answer.is_open:
                    answer = replace(answer, is_open=self._odometry.follows(
                        frame.image.header.stamp))
        except (NoFrameError, TimeJumpError) as error:
            answer = Answer(None, str(error), has_frame=False)
        except NoTransformError as error:
            answer = Answer(None, str(error), has_frame=not self._jumps.is_settling)
        except CliplocError as error:
            answer = Answer(None, str(error))
        except Exception as error:
            self._report(traceback.format_exc())
            answer = Answer(None, f'internal error: {error} (the traceback is in the log)')
        if not answer.has_frame and timeout_s < self.settings['timeout_s']:
            return answer  # who waits had an answer before
        self._conclude(answer.message)
        if not answer.is_open:
            self.get_logger().info(answer.message)
        return answer

    def _handed_over(self, answer: Answer, deadline: float) -> Answer:
        """Tell a running localizer of an accepted pose; who waits learns if that cannot be."""
        if answer.pose is None:
            return answer
        try:
            self._handoff.hand_over(answer.pose, self.settings.snapshot(), deadline)
        except HandOffError as error:
            return Answer(None, f'withheld: {error} ({answer.message})',
                          is_open=(self.settings['fuse_frames'] > 1
                                   and not isinstance(error, NoLocalizerError)))
        return answer

    def _conclude(self, verdict: str) -> None:
        """Keep the verdict for the diagnostics, and publish these."""
        self._verdict = verdict
        self._verdicts[verdict.split(':')[0] if verdict.startswith(_VERDICTS) else 'failed'] += 1
        self.diagnostics.publish()

    def examine(self, health: Health) -> None:
        """Say whether the input comes, what was found last, and where."""
        if self._frames is not None:
            self._frames.examine(health, self.settings['stale_after_s'])
        health.values |= {'frames skipped while busy': self._continuous.dropped,
                          'last verdict': self._verdict, **self._verdicts}
        if self._localizer is not None:
            health.values |= {'map': self._localizer.description,
                              'device': self._localizer.device}

    def _on_frame(self, frame: Frame) -> None:
        if self.settings['mode'] == 'continuous':
            self._continuous.offer(frame)

    def _localize_and_log(self, frame: Frame) -> None:
        try:
            message = self._localize(frame).message
        except CliplocError as error:
            message = str(error)
        self._conclude(message)
        self.get_logger().info(message, throttle_duration_sec=_LOG_PERIOD_S)

    def _localize(self, frame: Frame) -> Answer:
        """Localize from one frame and publish what was found; in the worker's thread."""
        values: Mapping[str, Any] = self.settings.snapshot()
        self.check_active()
        self._jumps.check(frame.image.header.stamp, frame.received_at)
        localizer = self._localizer
        assert localizer is not None  # an active node has one
        header = Header(stamp=frame.image.header.stamp, frame_id=localizer.map_frame)
        camera_from_base = self._transforms.camera_from_base(
            values['base_frame'], values['base_from_camera'], frame.image.header.frame_id,
            header.stamp, values['tf_timeout_s'])
        views: list[SeenImage] | None = [] if self._visualization.wants_debug_image else None
        place = self._place(frame, values, camera_from_base)
        found, times = localizer.localize(
            frame, values, self._up_in_camera(frame, values, camera_from_base), views, place)
        self.stages.add(times.ms)
        self.check_active()
        self._jumps.check(frame.image.header.stamp, frame.received_at)
        self._visualization.show(header, localizer.landmark_map, found, camera_from_base)
        answer = replace(self._answer(header, found, times, camera_from_base,
                                      frame.received_at),
                         is_alone=place is None and not found.accepted)
        for view in views or []:  # who waits for the answer does not wait for its picture
            self.worker.submit(partial(
                self._visualization.show_debug_image, frame.image.header, view,
                localizer.landmark_map, found, answer.message))
        return answer

    def _answer(self, header: Header, found: Relocalization, times: StageTimes,
                camera_from_base: NDArray[np.float64], received_at: float) -> Answer:
        """Publish what was found if it is accepted, and say it in a line."""
        if not found.accepted:
            return Answer(None, f'refused: {found.reason} [{_summary(found)}; {times}]',
                          is_open=self.settings['fuse_frames'] > 1)
        assert found.covariance is not None  # what is accepted has one
        map_from_camera = found.hypotheses[0].map_from_camera
        map_from_base = map_from_camera @ camera_from_base
        pose = pose_with_covariance_msg(header, map_from_base, move_covariance(
            found.covariance, map_from_base[:3, 3] - map_from_camera[:3, 3]))
        self._pose.publish(pose)
        try:
            self._map_to_odom.update(header, map_from_base, self.settings.snapshot(),
                                     received_at)
        except NoTransformError as error:
            self.get_logger().warning(f'publish_tf: {error}', throttle_duration_sec=_LOG_PERIOD_S)
        x, y, z = map_from_base[:3, 3]
        return Answer(pose, f'accepted: x {x:.2f} y {y:.2f} z {z:.2f} m in {header.frame_id} '
                            f'[{_summary(found)}; {times}]')

    def _up_in_camera(self, frame: Frame, values: Mapping[str, Any],
                      camera_from_base: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the vertical; without one the search goes on as if nobody had asked for it."""
        header = frame.image.header
        try:
            return self._vertical.up_in_camera(values, camera_from_base, header.frame_id,
                                               header.stamp)
        except (NoVerticalError, NoTransformError) as error:
            self.get_logger().warning(f'localizing without a vertical: {error}',
                                      throttle_duration_sec=_LOG_PERIOD_S)
            return None

    def _place(self, frame: Frame, values: Mapping[str, Any],
               camera_from_base: NDArray[np.float64]) -> CameraPlace | None:
        """Return where odometry has the camera; without that the frame is asked about alone."""
        if values['fuse_frames'] == 1:
            return None
        header = frame.image.header
        try:
            return self._odometry.camera_place(values, camera_from_base, header.frame_id,
                                               header.stamp)
        except NoOdometryError as error:
            self.get_logger().debug(f'one frame alone: {error}')
        except NoTransformError as error:
            self.get_logger().warning(f'one frame alone: {error}',
                                      throttle_duration_sec=_LOG_PERIOD_S)
        return None


def _summary(found: Relocalization) -> str:
    return (f'confidence {found.confidence:.3f}, score {found.score:.2f}, '
            f'{len(found.matches)} inliers, {found.tried} hypotheses, '
            f'{100 * found.coverage:.3g} % of the search')


def main() -> NoReturn:
    """Run the node until it is told to stop."""
    run_node(RelocalizerNode)


if __name__ == '__main__':
    main()
