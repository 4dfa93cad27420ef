# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check everything that a request needs, step by step; report failures and their remedies.

The doctor subscribes to the relocalizer's inputs and localizes once. It delivers no pose.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter

from cliploc_ros.core.detector_check import DetectorCheck
from cliploc_ros.core.geometry.camera_faults import fields_of_view
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import CliplocError, misspelt_classes
from cliploc_ros.messages import (
    camera_from_msg,
    detections_from_msg,
    faults_of_camera_info,
    faults_of_headers,
    faults_of_rectified,
    image_from_msg,
    parse_class_map,
)
from cliploc_ros.ros.answer import Verdict, answer_to
from cliploc_ros.ros.conversions import of_camera
from cliploc_ros.ros.frame_localizer import (
    FrameLocalizer,
    keyframes_path,
    load_localizer,
)
from cliploc_ros.ros.handoff import HandOff
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame, FrameSource, NoFrameError
from cliploc_ros.ros.inputs.instants import faults_of_axes, frame_depths, read_frame
from cliploc_ros.ros.inputs.rig import CameraRig
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.stamps import stamp_problem
from cliploc_ros.ros.node.diagnostics import Health, StageTimes, in_words
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.node.threads import NodeExecutor
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters
from cliploc_ros.ros.request import time_is_up
from cliploc_ros.ros.running import NotRunningError, ask, check_name, parameters_of_files

# A greater delay of images after their stamps means that the clocks differ. Not measured.
_MOST_LAG_S = 1.0
_SPIN_S = 0.05


class State(StrEnum):
    """The result of a check."""

    PASS = 'pass'
    FAIL = 'fail'
    NOT_CHECKED = 'not checked'
    REFUSED = 'refused'  #: A request gets no pose here, although nothing is broken


class Finding(NamedTuple):
    """A check, its result, and for a failure the remedy."""

    what: str
    state: State
    text: str


class Report:
    """Collects findings, and calls `tell` with each one immediately."""

    def __init__(self, tell: Callable[[Finding], object]) -> None:
        self._tell = tell
        self.findings: list[Finding] = []

    def add(self, what: str, state: State, text: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(what, state, text))
        self._tell(self.findings[-1])

    def judge(self, what: str, problem: str, text: str) -> None:
        """Add a failure with `problem`, or, if `problem` is empty, a pass with `text`."""
        self.add(what, State.FAIL if problem else State.PASS, problem or text)

    def skip(self, what: str, text: str) -> None:
        """Add a check that was not made, with the reason."""
        self.add(what, State.NOT_CHECKED, text)

    @contextmanager
    def failing(self, what: str) -> Iterator[None]:
        """Report a CliplocError of the body as a failure."""
        try:
            yield
        except CliplocError as error:
            self.add(what, State.FAIL, str(error))


class Doctor(ManagedNode[RelocalizerParameters]):
    """A node with the inputs of a relocalizer, but without its outputs.

    Parameters
    ----------
    given : sequence of Parameter
        Parameters of the relocalizer.
    topics : sequence of str
        Remappings of the relocalizer, NAME:=TOPIC.
    wrong_cameras : str
        Cameras whose mount or calibration the relocalizer has found to be wrong.
    """

    def __init__(self, given: Sequence[Parameter], topics: Sequence[str], wrong_cameras: str = ''
                 ) -> None:
        rules = [word for rule in ('/diagnostics:=~/diagnostics', *topics)
                 for word in ('-r', rule)]
        super().__init__('doctor', RelocalizerParameters, DetectorParameters,
                         parameter_overrides=[parameter for parameter in given
                                              if parameter.name != 'autostart'],
                         cli_args=['--ros-args', *rules])
        parameters, self.wrong_cameras = self.settings.values, wrong_cameras
        self.robot = RobotStateSource(self)
        self.frames = CameraRig(self, parameters, math.inf)
        self.handoff = HandOff(self, self.robot.odometry, self.robot.transforms)

    def load(self) -> str:
        """Load nothing: the inputs are checked even if the map is bad."""
        return 'doctor'

    def unload(self) -> None:
        """Drop nothing."""

    def open(self) -> None:
        """Listen to all inputs."""
        self.handoff.open(self.settings.values.localizer_pose)
        with suppress(NoTransformError):  # tf2 is not installed; the check of tf reports it
            self.robot.open()
        self.frames.open()

    def close(self) -> None:
        """Unsubscribe from all inputs."""
        self.frames.close('the doctor is ending')
        self.robot.close()
        self.handoff.close()

    def examine(self, health: Health) -> None:
        """Report nothing."""


def diagnose(node: Doctor, patience_s: float, report: Report) -> None:
    """Check what a request needs; wait up to `patience_s` for each input."""
    began_at, parameters = time.monotonic(), None
    with report.failing('parameters'):
        parameters = node.settings.snapshot()
        report.add('parameters', State.PASS, 'valid')
    if parameters is None:
        return report.skip('all other checks', 'correct the parameters first')
    node.bring_up(began_at + patience_s)
    localizer = _check_map(node, parameters, report)
    after, frame, why = time.monotonic(), None, ''
    try:
        frame = node.frames.next_frame(after, after + patience_s)
        while parameters.depth_transport != 'none' and frame.depth is None:
            # discovery of the depth topic may take longer than that of the image
            frame = node.frames.next_frame(time.monotonic(), after + patience_s)
    except NoFrameError as error:
        why = str(error)
    sources = node.frames.sources
    silent = {name: source.unheard(after) if frame is None or name in frame.left_out else {}
              for name, source in sources.items()}
    for name, source in sources.items():
        _check_camera(node, parameters, name, source, silent[name], report)
    name = next(iter(sources)) if frame is None else frame.camera
    image, _ = sources[name].heard.get('image', (None, 0.0))
    if image is not None:
        header = image.header if frame is None else frame.image.header
        _check_place(node, parameters.of_camera(name), header, patience_s, report)
    else:
        report.skip('tf, odometry', 'they need an image')
    if silent[name].keys() & {'image', 'camera_info'}:
        report.skip('detector', 'it needs an image with camera_info')
    else:
        _check_detections(parameters, localizer, frame, silent[name].get('detections', why),
                          report)
    if parameters.require_localizer:
        report.judge('localizer', node.handoff.missing(), 'it subscribes to initialpose, and '
                     f'publishes {parameters.localizer_pose or "nothing that is checked"}')
    else:
        report.skip('localizer', 'require_localizer is false')
    # a running detector would compete for processor time with the request below
    node.frames.close('all frames are checked')
    _check_request(node, parameters, localizer, frame, report)


def _check_map(node: Doctor, parameters: RelocalizerParameters, report: Report
               ) -> FrameLocalizer | None:
    """Load and return map, keyframes and CLIP; None if that fails."""
    began_at = time.monotonic()
    with report.failing('map'):
        localizer = node.worker.run(partial(load_localizer, node, parameters))
        report.add('map', State.PASS, f'{localizer.description}, loaded in '
                                      f'{time.monotonic() - began_at:.1f} s')
        keyframes, file = localizer.keyframes, keyframes_path(parameters)
        if file is None:
            report.skip('keyframes', 'none next to the map: build_map makes them from images')
        else:
            report.judge('keyframes', '' if keyframes is not None else
                         f'{file} is not used, see the error above: rebuild it with build_map',
                         f'{len(keyframes.localizer.layer if keyframes else ())} of {file}')
        return localizer
    return None


def _check_camera(node: Doctor, parameters: RelocalizerParameters, name: str,
                  source: FrameSource, silent: dict[str, str], report: Report) -> None:
    """Check images, calibration and clock of a camera."""
    camera, calibration, clock = (of_camera(name, what) for what in (
        'camera', 'calibration', 'clock'))
    (image, _), (info, _) = (source.heard.get(topic, (None, 0.0)) for topic in (
        'image', 'camera_info'))
    size = None
    if image is None or 'image' in silent:
        report.add(camera, State.FAIL, silent.get('image', 'no image in time'))
        report.skip(clock, 'it needs an image')
    else:
        with report.failing(camera):
            size = image_from_msg(image).shape[1::-1]
            report.add(camera, State.PASS, f'{size[0]} x {size[1]} px, frame '
                                           f"'{image.header.frame_id}'")
        why = stamp_problem(image.header.stamp)
        report.judge(clock, f"the images' stamp {why}: the driver must stamp each image"
                     if why else _clock_fault(node, source.nearest_lag_s),
                     f'images come {1e3 * source.nearest_lag_s:.0f} ms after their stamps')
    if info is None:
        return report.add(calibration, State.FAIL,
                          silent.get('camera_info', 'no camera_info in time'))
    with report.failing(calibration):
        found = camera_from_msg(info, size or (info.width, info.height), parameters.rectified)
        lens = 'rectified' if parameters.rectified else info.distortion_model or 'no distortion'
        faults = [*faults_of_camera_info(info, found, parameters.rectified),
                  *faults_of_headers('' if image is None else image.header.frame_id,
                                     info.header.frame_id),
                  *faults_of_rectified(source.image_topic, parameters.rectified, info)]
        report.judge(calibration, '; '.join(fault.text for fault in faults),
                     f'{fields_of_view(found)[0]:.0f} degrees wide, {lens}')


def _clock_fault(node: Doctor, lag_s: float) -> str:
    """Return how the clocks of camera and node disagree; empty if they agree."""
    uses_sim_time = node.get_parameter('use_sim_time').value
    if uses_sim_time and not node.get_clock().now().nanoseconds:
        return ('use_sim_time is true, but nobody publishes /clock: start the simulation, play '
                'the bag with --clock, or set use_sim_time to false')
    if abs(lag_s) <= _MOST_LAG_S:
        return ''
    return (f'images come {lag_s:.1f} s after their stamps by '
            f"{'/clock' if uses_sim_time else 'the clock of this machine'} (limit "
            f'{_MOST_LAG_S:g}): synchronize the clocks; play a bag with --clock and use_sim_time')


def _check_place(node: Doctor, parameters: RelocalizerParameters, image: Any, patience_s: float,
                 report: Report) -> None:
    """Check tf, odometry and the vertical at the stamp of an image with the header `image`."""
    robot, mount, base = node.robot, None, parameters.base_frame
    with report.failing('tf'):
        mount = robot.transforms.camera_from_base(
            base, parameters.base_from_camera, image.frame_id, image.stamp, patience_s)
        if parameters.publish_tf:
            robot.transforms.lookup(image.frame_id, parameters.odom_frame, image.stamp,
                                    patience_s, 'correct odom_frame')
        if base:
            base_from_camera = invert_transform(mount)
            up_deg = math.degrees(math.asin(float(np.clip(base_from_camera[2, 2], -1.0, 1.0))))
            report.judge('tf', '; '.join(fault.text for fault in faults_of_axes(
                image.frame_id, mount)), f'the camera is {base_from_camera[2, 3]:.2f} m '
                f"above '{base}' and looks {up_deg:+.0f} degrees up")
        elif parameters.require_localizer:
            report.add('tf', State.FAIL, 'base_frame is empty: initialpose would carry the pose '
                       "of the camera: set it to AMCL's base_frame_id")
        else:
            report.add('tf', State.PASS,
                       'base_frame is empty: the pose of the camera is published')
    odometry = robot.odometry
    if not odometry.is_published:
        report.skip('odometry', f'nobody publishes {odometry.topic}: the robot is assumed to be '
                                'at rest, and frames are not fused')
    else:
        with report.failing('odometry'):
            node.handoff.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s,
                                    time.monotonic() + patience_s)
            body = odometry.pose_at(image.stamp)
            if mount is not None and body.frame not in (image.frame_id, base):
                robot.transforms.lookup(image.frame_id, body.frame, image.stamp,
                                        parameters.tf_timeout_s, 'correct its child_frame_id')
            report.add('odometry', State.PASS,
                       'the robot is at rest, and the poses cover the stamp of the image')
    if parameters.gravity == 'none' or mount is None:
        return report.skip('vertical', 'it needs tf' if mount is None else 'gravity: none')
    with report.failing('vertical'):
        robot.vertical.up_in_camera(parameters, mount, image.frame_id, image.stamp)
        report.add('vertical', State.PASS, f'known from {parameters.gravity}')


def _check_detections(parameters: RelocalizerParameters, localizer: FrameLocalizer | None,
                      frame: Frame | None, why: str, report: Report) -> None:
    """Check that detections arrive with their images and have classes of the map."""
    if frame is None:
        return report.add('detector', State.FAIL, why)
    found = detections_from_msg(frame.detections, parse_class_map(parameters.class_map))
    if not len(found):
        return report.skip('detector', 'it detects no object: turn the camera to objects')
    text = f'{len(found)} boxes, {frame.detected_at - frame.received_at:.2f} s after their image'
    if localizer is not None:
        own = sum(class_id in localizer.landmark_map.class_ids for class_id in found.class_ids)
        text += f', {own} of them with classes of the map'
        check = DetectorCheck(localizer.landmark_map, parameters.matching != 'clip')
        with report.failing('detector'):
            height, width = image_from_msg(frame.image).shape[:2]
            check.add(found, found.usable(width, height, parameters.max_detections))
        faults = [*check.faults, *faults_of_headers(frame.image.header.frame_id, '',
                                                    frame.detections.header.frame_id)]
        if faults:
            return report.add('detector', State.FAIL, '; '.join(fault.text for fault in faults))
        misspelt = misspelt_classes(localizer.landmark_map.class_ids, found.class_ids)
        if names := ', '.join(f"'{name}'{hint}" for name, hint in misspelt.items()):
            text += f'; the map has the class {names}'
    report.add('detector', State.PASS, text)


def _check_depth(frame: Frame, state: RobotState, parameters: RelocalizerParameters,
                 report: Report) -> None:
    """Check that depth arrives with an image and belongs to it. Localization works without it."""
    what = of_camera(frame.camera, 'depth')
    if frame.depth is None:
        return report.add(what, State.FAIL, 'no depth within depth_tolerance_s '
                          f'({parameters.depth_tolerance_s:g} s) of the image: remap depth, start '
                          'its publisher, or set depth_transport to none')
    with report.failing(what):
        _, camera, given = read_frame(frame, parameters)
        boxes = given.usable(camera.width, camera.height, parameters.max_detections)
        depths_m = frame_depths(frame, camera, boxes, state)
        assert depths_m is not None
        known_m = depths_m[np.isfinite(depths_m)]
        if not len(known_m):
            return report.skip(what, f'none of the {len(depths_m)} boxes has depth')
        report.add(what, State.PASS, f'known for {len(known_m)} of {len(depths_m)} boxes, '
                                     f'{known_m.min():.1f} to {known_m.max():.1f} m')


def _check_request(node: Doctor, parameters: RelocalizerParameters,
                   localizer: FrameLocalizer | None, frame: Frame | None, report: Report) -> None:
    """Localize with a frame as a request does; report the time of each stage and the verdict."""
    if localizer is None or frame is None:
        return report.skip('time, pose', 'they need a map and an image with detections')
    with report.failing('pose'):
        known = node.robot.at_instant(frame, parameters, localizer.frame_ids, localizer.map_hash,
                                      time.monotonic() + parameters.tf_timeout_s)
        if parameters.depth_transport != 'none':
            for camera_frame, state in ((frame, known.state), *known.beside):
                _check_depth(camera_frame, state, parameters, report)
        now, detection_s = time.monotonic(), frame.detected_at - frame.received_at
        times = StageTimes('detection', now - detection_s)
        times.begin('waiting', now)
        localized = node.worker.run(partial(localizer.localize, frame, parameters, known, times,
                                            now - detection_s + parameters.timeout_s))
        answer = answer_to(frame, localized, known.state, parameters, localizer.map_hash, times.ms)
        is_slow = answer.is_cut or sum(answer.stages_ms.values()) > 1e3 * parameters.timeout_s
        report.judge('time', time_is_up(answer.stages_ms) if is_slow else '',
                     f'{in_words(answer.stages_ms)}; timeout_s {parameters.timeout_s:g}')
        if answer.verdict is Verdict.ACCEPTED and node.wrong_cameras:
            report.add('pose', State.REFUSED, f'the relocalizer refuses it: {node.wrong_cameras}')
        else:
            report.add('pose', State.REFUSED if answer.kind else State.PASS, answer.message)


def doctor(files: Sequence[Path], name: str, patience_s: float, report: Report) -> None:
    """Check the relocalizer that parameter files describe, or without files, a running one.

    CliplocError: a parameter file cannot be read, or the name is invalid.
    """
    check_name(name)
    asking, values = Node('doctor_asks', start_parameter_services=False), dict[str, str]()
    try:
        name = asking.resolve_service_name(name)
        if files:
            given = parameters_of_files(files, name)
        else:
            status, given = ask(asking, name, patience_s)
            values = status.values
            if any(values.get(verdict, '0') != '0' for verdict in (
                    Verdict.ACCEPTED, Verdict.WITHHELD)):  # it no longer uses its last pose
                given = [parameter for parameter in given if parameter.name != 'last_pose_file']
            # missing inputs of an active relocalizer are reported by the checks below
            report.judge('relocalizer', '' if values['state'] == 'active' else status.problem(),
                         f'{name} is active')
    except NotRunningError as error:
        return report.add('relocalizer', State.FAIL, str(error))
    finally:
        asking.destroy_node()
    executor, ended = NodeExecutor(), threading.Event()
    node = Doctor(given, [*values.get('topics', '').split(), f'~/prior:={name}/prior'],
                  values.get('wrong cameras', ''))
    node.get_logger().set_level(LoggingSeverity.ERROR)
    executor.add_node(node)

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(timeout_sec=_SPIN_S)
    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        diagnose(node, patience_s, report)
    finally:
        ended.set()
        thread.join()
        node.worker.stop()
        executor.shutdown(0.0)
        node.destroy_node()
