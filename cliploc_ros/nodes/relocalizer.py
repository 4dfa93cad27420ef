# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Localizes the robot in a map of objects, on request or with every image.

  in         image, image/compressed, camera_info, detections; optional: odom, imu, depth
  out        ~/pose, initialpose, ~/hypotheses, ~/landmarks, ~/matches, ~/debug_image, ~/answer,
             /diagnostics
  services   ~/relocalize, ~/relocalize_fields, ~/record, ~/reload_map,
             reinitialize_global_localization

It needs a map: -p map_file:=MAP.yaml, which build_map writes.
"""

import importlib
import math
import os
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, NoReturn

from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import SelfTest
from rclpy.parameter import Parameter
from std_srvs.srv import Empty, Trigger

from cliploc_ros.errors import CliplocError, MapError
from cliploc_ros.ros import qos
from cliploc_ros.ros.answer import Answer, CaseRecorder, RequestCounters, Verdict, answer_msg
from cliploc_ros.ros.frame_localizer import FrameLocalizer
from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotStateSource
from cliploc_ros.ros.inputs.stamps import TimeJumps
from cliploc_ros.ros.map_to_odom import MapToOdom
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.lifecycle import LOG_PERIOD_S, ManagedNode, run_node
from cliploc_ros.ros.node.threads import MAX_REQUESTS, BoundedCallbackGroup, LatestOnly
from cliploc_ros.ros.parameters import AUTO, DetectorParameters, RelocalizerParameters, path_of
from cliploc_ros.ros.request import Pipeline, Requests
from cliploc_ros.ros.watch import Watcher

# Topics, besides those of its cameras, that the diagnostics list for the doctor.
_OTHER_TOPICS = ('odom', 'imu', 'initialpose', '/tf', '/tf_static')


class RelocalizerNode(ManagedNode[RelocalizerParameters]):
    """Localizes the robot on request, or with every frame.

    Parameters
    ----------
    delivers : bool
        Whether it publishes poses, hands them over, and serves requests of other nodes.
    options
        Further arguments of rclpy's Node.
    """

    def __init__(self, name: str = 'relocalizer', delivers: bool = True, **options: Any) -> None:
        super().__init__(name, RelocalizerParameters, DetectorParameters, **options)
        parameters = self.settings.values
        self._robot = RobotStateSource(self)
        self._jumps = TimeJumps(self, self._forget)
        self._map_to_odom = MapToOdom(self, self._robot.transforms)
        self._robot.odometry.on_restart(self._map_to_odom.forget)
        self._pipeline = Pipeline(self, self._robot, self._jumps, self._map_to_odom)
        self._newest = LatestOnly(self.worker, self._localize_and_log)
        self._frames = CameraRig(self, parameters) if parameters.mode == 'on_request' else \
            CameraRig(self, parameters, math.inf, self._newest.offer)
        sources = self._frames.sources.values()
        with suppress(CliplocError):  # with a bad name, the node cannot be configured anyway
            self.settings.snapshot()
            self.facts['topics'] = ' '.join(
                f'{name}:={qos.resolved(self, name)}' for name in (
                    *(topic for source in sources for topic in source.topics.values()),
                    *_OTHER_TOPICS, parameters.localizer_pose) if name not in ('', AUTO))
        self._handoff = HandOff(self, self._robot.odometry, self._robot.transforms)
        self._handoff.localizer.listeners.append(self._robot.prior.follow)
        self._cases = CaseRecorder(bool(parameters.record_folder))
        self._requests = Requests(self, self._frames, self._robot, self._jumps, self._pipeline,
                                  self._cases, self._handoff if delivers else None)
        self._watcher = Watcher(self, self._frames, self._robot, self._jumps, self._pipeline,
                                self._requests, self._handoff, self._answer)
        self._counters = RequestCounters()
        self._answers = self.create_publisher(DiagnosticArray, '~/answer', qos.LATCHED)
        self._last_verdict = 'none yet'
        self._verdicts: dict[str, int] = dict.fromkeys(Verdict, 0)
        # Locked from the change of the map parameters until the map is loaded.
        self._map_lock = threading.Lock()
        services: list[tuple[Any, str, Callable[[Any, Any], Any]]] = [
            (Trigger, '~/relocalize', self._on_relocalize),
            (SelfTest, '~/relocalize_fields', self._on_relocalize_fields),
            (Trigger, '~/record', self._on_record),
            (Trigger, '~/reload_map', self._on_reload_map),
            (Empty, 'reinitialize_global_localization', self._on_reinitialize)]
        with suppress(ImportError):  # without nav2_msgs, map_file and reload_map do the same
            load_map = importlib.import_module('nav2_msgs.srv').LoadMap
            services.append((load_map, '~/load_map', self._on_load_map))
        group = BoundedCallbackGroup(MAX_REQUESTS)
        for service_type, name, callback in services if delivers else ():
            self.create_service(service_type, name, callback, qos_profile=qos.SERVICE,
                                callback_group=group)

    @property
    def localizer(self) -> FrameLocalizer | None:
        """Return the map and its networks, None unless they are loaded."""
        return self._pipeline.localizer

    def load(self) -> str:
        """Load map and network."""
        return self._pipeline.load().description

    def unload(self) -> None:
        """Drop map and network."""
        self._pipeline.unload()

    def open(self) -> None:
        """Accept requests; in continuous mode subscribe to frames."""
        parameters = self.settings.values
        self._handoff.open(parameters)
        self._robot.open()
        if parameters.publish_tf:
            self._map_to_odom.open()
        self._frames.open()
        self._watcher.open()

    def close(self) -> None:
        """Release the request that waits for frames, and unsubscribe."""
        self._watcher.close()
        self._handoff.close()
        self._frames.close('the node was deactivated')
        self._map_to_odom.close()
        self._robot.close()

    def release(self) -> None:
        """Release the request that waits for frames, because the process is ending."""
        self._watcher.release()
        self._handoff.stop()
        self._frames.close('the node is shutting down')

    def _forget(self) -> None:
        """Forget all input: time jumped."""
        for part in (self._frames, self._robot, self._map_to_odom, self._cases, self._watcher):
            part.forget()

    def examine(self, health: Health) -> None:
        """Report the inputs and the last verdict."""
        parameters = self.settings.values
        missing = [line for source in self._frames.sources.values() for line in source.missing()]
        if (no_localizer := self._handoff.localizer.missing()) and parameters.require_localizer:
            missing.append(no_localizer)
        self._frames.examine(health, parameters.stale_after_s)
        self._robot.examine(health)
        rival = self._map_to_odom.rival(parameters.odom_frame) if parameters.publish_tf else ''
        if rival:
            health.warn(rival)
        health.values |= {'frames skipped while busy': self._newest.dropped,
                          'last verdict': self._last_verdict, **self._verdicts,
                          **self._counters.values(),
                          'map file': ', '.join(filter(None, [
                              parameters.map_file, *parameters.map_files])),
                          'base frame': parameters.base_frame,
                          'time limit [s]': parameters.timeout_s,
                          'missing': '; '.join(missing), 'rival of publish_tf': rival}
        self._watcher.examine(health)
        localizer = self._pipeline.localizer  # read once, because a cleanup may drop it
        if localizer is not None:
            for fault in localizer.instants.faults:
                (health.fail if fault.is_certain else health.warn)(fault.text)
            keyframes = localizer.keyframes
            if keyframes is not None:
                health.values |= {'keyframes': len(keyframes.localizer.layer),
                                  'keyframes file': keyframes.file,
                                  'keyframes hash': keyframes.file_hash}
            cameras, depth_scale = localizer.localizer.cameras, localizer.localizer.depth_scale
            health.values |= cameras.values | {'wrong cameras': '; '.join(cameras.faults)}
            for wrong in cameras.faults:
                health.fail(f'{wrong}: check camera_info, and the pixels and corners of the boxes')
            if parameters.depth_transport != 'none':
                health.values['depth scale'] = f'{depth_scale.ratio:.2f}'
            health.values |= {'map': localizer.description, 'map hash': localizer.map_hash}

    def _on_relocalize(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answer = self._answer()
        response.success = answer.verdict is Verdict.ACCEPTED
        response.message = answer.message
        return response

    def _on_relocalize_fields(self, _: SelfTest.Request, response: SelfTest.Response
                              ) -> SelfTest.Response:
        """Answer as ~/relocalize does, but as separate fields."""
        answer = self._answer()
        response.id = str(answer.number)
        response.passed = bytes([answer.verdict is Verdict.ACCEPTED])
        response.status = answer_msg(answer, self.get_fully_qualified_name()).status
        return response

    def _on_reinitialize(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        self._answer()
        return response

    def _on_record(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Store the last request. Localization continues meanwhile."""
        try:
            response.message = self._cases.store(self.settings.snapshot())
            response.success = True
        except CliplocError as error:
            response.message = f'not recorded: {error}'
        except Exception as error:  # otherwise rclpy would never answer
            self.get_logger().error(traceback.format_exc())
            response.message = f'not recorded: internal error: {error}'
        self.get_logger().info(f'record: {response.message}')
        return response

    def _on_reload_map(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Read the map again in the worker's thread, and so never during a search."""
        try:
            with self._map_lock:
                read = self.worker.run(self._pipeline.reload_map)
            response.message = f'loaded: {read.description}; map {read.map_hash}'
            response.success = True
        except Exception as error:  # otherwise rclpy would never answer
            response.message = f'not loaded: {str(error) or repr(error)}'
        self.get_logger().info(f'map {response.message}')
        return response

    def _on_load_map(self, request: Any, response: Any) -> Any:
        """Load another map. After a failure, parameters and maps are unchanged."""
        with self._map_lock:
            values = self.settings.values
            before = {'map_file': values.map_file, 'map_files': values.map_files}
            try:
                self._set(map_file=request.map_url, map_files=[''])
                read = self.worker.run(self._pipeline.reload_map)
                self.get_logger().info(f'map loaded: {read.description}')
                response.result = response.RESULT_SUCCESS
            except Exception as error:  # as above
                self._set(**before)
                self.get_logger().error(f'map not loaded: {str(error) or repr(error)}')
                response.result = response.RESULT_MAP_DOES_NOT_EXIST
                with suppress(MapError):
                    if os.path.exists(path_of(request.map_url)):  # noqa: PTH110 - never raises
                        response.result = response.RESULT_INVALID_MAP_DATA
        return response

    def _set(self, **values: Any) -> None:
        self.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()])

    def _answer(self) -> Answer:
        answer = self._requests.answer()
        localizer = self._pipeline.localizer
        if not answer.map_hash and localizer is not None:
            answer = replace(answer, map_hash=localizer.map_hash)
        self._counters.add(answer)
        self._cases.end(answer)
        if answer.verdict is Verdict.ACCEPTED:
            self._watcher.start_over()
        self._record(answer)
        return answer

    def _localize_and_log(self, frame: Frame) -> None:
        """Localize with a frame of continuous mode, in the worker's thread."""
        try:
            answer = self._pipeline.publish(self._pipeline.localize(frame))
        except CliplocError as error:
            answer = Answer(Verdict.FAILED, str(error))
        self._record(answer)
        self.get_logger().info(answer.message, throttle_duration_sec=LOG_PERIOD_S)

    def _record(self, answer: Answer) -> None:
        """Publish the answer, and the diagnostics with its verdict."""
        self._answers.publish(answer_msg(answer, self.get_fully_qualified_name()))
        self._last_verdict = answer.message
        self._verdicts[answer.verdict] += 1
        self.diagnostics.publish()


def main() -> NoReturn:
    """Run the node until SIGINT or SIGTERM."""
    run_node('relocalizer', RelocalizerNode, __doc__)


if __name__ == '__main__':
    main()
