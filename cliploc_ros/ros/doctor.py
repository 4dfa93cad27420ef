# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check all that a request needs, one after another: what works, what fails, and what to do.

It listens to what the relocalizer listens to, and localizes once. It hands no pose over.
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
from rcl_interfaces.msg import Parameter as ParameterMsg
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import CameraInfo

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.messages import (
    camera_from_msg,
    detections_from_msg,
    image_from_msg,
    parse_class_map,
)
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.frame_localizer import FrameLocalizer, keyframes_path, load_localizer
from cliploc_ros.ros.inputs.coordinate_frames import NoTransformError
from cliploc_ros.ros.inputs.frame_source import (
    LINGER_S,
    Frame,
    ImageSource,
    NoFrameError,
    TimedImage,
    of_camera,
)
from cliploc_ros.ros.inputs.odometry import NoOdometryError
from cliploc_ros.ros.inputs.rig import frames_of
from cliploc_ros.ros.inputs.robot_state import RobotState, RobotStateSource
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.ros.node.diagnostics import Health, StageTimes, in_words
from cliploc_ros.ros.node.executor import NodeExecutor
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.outputs.handoff import HandOff
from cliploc_ros.ros.parameters import (
    DetectorParameters,
    RelocalizerParameters,
    doubt_of_rectified,
)
from cliploc_ros.ros.request import time_is_up
from cliploc_ros.ros.wake_up import RelocalizerStatus
from cliploc_ros.units import NS_PER_S

# Images that come later after their stamps show clocks that differ (a guess).
_MOST_LAG_S = 1.0
# So many detections, none of a class of the map, are of a detector with other names (a guess).
_FOREIGN = 3
_SPIN_S = 0.05
# A rate is that of so many images, as far as they come within this time.
_RATE_IMAGES, _RATE_S = 10, 2.0


class State(StrEnum):
    """Whether a check passed."""

    PASS = 'pass'
    FAIL = 'fail'
    NOT_CHECKED = 'not checked'


class Finding(NamedTuple):
    """What was checked, and what was found; for a failure also what to do."""

    what: str
    state: State
    text: str


class Report:
    """Collects findings; `tell` gets each at once."""

    def __init__(self, tell: Callable[[Finding], object]) -> None:
        self._tell = tell
        self.findings: list[Finding] = []

    def add(self, what: str, state: State, text: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(what, state, text))
        self._tell(self.findings[-1])

    def judge(self, what: str, problem: str, text: str) -> None:
        """Add a finding that fails with a problem, or passes with a text where there is none."""
        self.add(what, State.FAIL if problem else State.PASS, problem or text)

    def skip(self, what: str, text: str) -> None:
        """Add what was not checked, and why."""
        self.add(what, State.NOT_CHECKED, text)

    @contextmanager
    def failing(self, what: str) -> Iterator[None]:
        """Make a failure of each CliplocError within."""
        try:
            yield
        except CliplocError as error:
            self.add(what, State.FAIL, str(error))


class SeenImages(NamedTuple):
    """What came from one camera."""

    newest: Any  #: Image or CompressedImage
    lag_s: float  #: How long after its stamp the newest one came, by the node's clock
    came_at: tuple[float, ...]  #: When the last ones came (monotonic clock) [s]


class Doctor(ManagedNode[RelocalizerParameters]):
    """Has the inputs of a relocalizer, and none of its outputs.

    Parameters
    ----------
    given : sequence of Parameter
        Of the relocalizer.
    topics : sequence of str
        Its remappings, NAME:=TOPIC.
    """

    def __init__(self, given: Sequence[Parameter], topics: Sequence[str]) -> None:
        rules = [word for rule in ('/diagnostics:=~/diagnostics', *topics)
                 for word in ('-r', rule)]
        super().__init__('doctor', RelocalizerParameters, DetectorParameters,
                         parameter_overrides=[one for one in given if one.name != 'autostart'],
                         cli_args=['--ros-args', *rules])
        parameters = self.settings.values
        self.robot = RobotStateSource(self)
        self.frames = frames_of(self, parameters, LINGER_S)
        self.handoff = HandOff(self, self.robot.odometry)
        self.cameras = parameters.camera_names or ('',)
        self.images: dict[str, SeenImages] = {}
        self.infos: dict[str, CameraInfo] = {}
        self._changed = threading.Condition()
        self._sources = [ImageSource(self, parameters.image_transport, partial(self._take, name),
                                     name) for name in self.cameras]

    def load(self) -> str:
        """Load nothing: a bad map must not keep the inputs from being checked."""
        return 'doctor'

    def unload(self) -> None:
        """Drop nothing."""

    def open(self) -> None:
        """Listen to all inputs."""
        self.handoff.open(self.settings.values.localizer_pose)
        with suppress(NoTransformError):  # tf2 is not installed; the check of tf says so
            self.robot.open()
        self.frames.open()
        for name, source in zip(self.cameras, self._sources, strict=True):
            source.open()
            AdaptiveSubscription(self, CameraInfo, of_camera(name, 'camera_info'),
                                 partial(self.infos.__setitem__, name), qos.CAMERA_INFO)

    def close(self) -> None:
        """Listen to nothing more."""
        self.frames.close('the doctor leaves')
        self.robot.close()
        self.handoff.close()

    def examine(self, health: Health) -> None:
        """Report nothing."""

    def wait_for_rates(self) -> None:
        """Wait a moment until the rate of each camera that has sent an image is known."""
        with self._changed:
            self._changed.wait_for(lambda: all(
                len(one.came_at) == _RATE_IMAGES for one in self.images.values()), _RATE_S)

    def _take(self, camera: str, image: TimedImage) -> None:
        before = self.images[camera].came_at if camera in self.images else ()
        lag_ns = self.get_clock().now().nanoseconds - stamp_ns(image.msg.header.stamp)
        with self._changed:
            self.images[camera] = SeenImages(image.msg, lag_ns / NS_PER_S,
                                             (*before[1 - _RATE_IMAGES:], image.received_at))
            self._changed.notify_all()


def parameters_of_files(files: Sequence[Path], name: str) -> list[Parameter]:
    """Return the relocalizer's parameters in files; the later ones count more.

    CliplocError: names the file and what is wrong with it.
    """
    found: dict[str, Any] = {}
    base = name.rpartition('/')[2]
    for file in files:
        for node, content in read_parameter_file(file).items():
            if node.rpartition('/')[2] in ('**', '*', base) and isinstance(content, dict):
                found |= _flat(content.get('ros__parameters') or {})
    if not found:
        raise OptionsError(f'{", ".join(map(str, files))}: no parameters of {base} or /**; name '
                           'the node with --relocalizer')
    return [Parameter(name, value=value) for name, value in found.items() if value is not None]


def _flat(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _flat(value, f'{prefix}{name}.') if isinstance(value, dict) else {
            f'{prefix}{name}': value}
    return found


def parameters_of_running(name: str, patience_s: float, report: Report
                          ) -> tuple[list[Parameter], list[str]] | None:
    """Return the parameters and remappings of a running relocalizer; None if it does not answer.

    Reports whether it can take a request.
    """
    node = Node('doctor_asks', start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    full_name = node.resolve_service_name(name)
    status, client = RelocalizerStatus(node, full_name), AsyncParameterClient(node, full_name)
    deadline = time.monotonic() + patience_s
    try:
        while not status.values or not client.services_are_ready():
            if time.monotonic() > deadline:
                report.add('relocalizer', State.FAIL, f'{full_name} is not running: start it, '
                           'name it with --relocalizer, or give its --params-file')
                return None
            executor.spin_once(timeout_sec=_SPIN_S)
        listed = client.list_parameters()
        executor.spin_until_future_complete(listed, patience_s)
        names = listed.result().result.names if listed.done() else []
        got = client.get_parameters(names)
        executor.spin_until_future_complete(got, patience_s)
        if not names or not got.done():
            report.add('relocalizer', State.FAIL, f'{full_name} does not answer: restart it')
            return None
        # what an active one misses has lines of its own
        report.judge('relocalizer', '' if status.values['state'] == 'active' else
                     status.problem(), f'{full_name} is active')
        given = [Parameter.from_parameter_msg(ParameterMsg(name=one, value=value))
                 for one, value in zip(names, got.result().values, strict=True)]
        return given, status.values.get('topics', '').split()
    finally:
        node.destroy_node()


def diagnose(node: Doctor, patience_s: float, report: Report) -> None:
    """Check what a request needs; inputs may take `patience_s` to come."""
    began_at, parameters = time.monotonic(), None
    with report.failing('parameters'):
        parameters = node.settings.snapshot()
        report.add('parameters', State.PASS, 'valid')
    if parameters is None:
        return report.skip('all others', 'correct the parameters first')
    node.bring_up(began_at + patience_s)
    localizer = _check_map(node, parameters, report)
    after, frame, why = time.monotonic(), None, ''
    try:
        frame = node.frames.next_frame(after, after + patience_s)
    except NoFrameError as error:
        why = str(error)
    node.wait_for_rates()
    silent = {name: text for name, text in node.frames.unheard(after).items()
              if frame is None or name.rpartition('/')[0] in frame.left_out}
    for name in node.cameras:
        _check_camera(node, parameters, name, silent, report)
    name = node.cameras[0] if frame is None else frame.camera
    if name in node.images:
        _check_place(node, parameters.of_camera(name), node.images[name].newest.header, patience_s,
                     report)
    else:
        for what in ('tf', 'odometry', 'vertical'):
            report.skip(what, 'needs an image')
    if of_camera(name, 'image') in silent:
        report.skip('detector', 'needs an image')
    else:
        _check_detections(parameters, localizer, frame,
                          silent.get(of_camera(name, 'detections'), why), report)
    if parameters.require_localizer:
        report.judge('localizer', node.handoff.missing(), 'it subscribes to initialpose'
                     + f' and publishes {parameters.localizer_pose}' * bool(
                         parameters.localizer_pose))
    else:
        report.skip('localizer', 'require_localizer is false')
    _check_request(node, parameters, localizer, frame, report)


def _check_map(node: Doctor, parameters: RelocalizerParameters, report: Report
               ) -> FrameLocalizer | None:
    """Load map, keyframes and CLIP; return them, None where that fails."""
    began_at = time.monotonic()
    with report.failing('map'):
        localizer = node.worker.run(partial(load_localizer, node, parameters))
        report.add('map', State.PASS, f'{localizer.description}, on {localizer.device}, loaded in '
                                      f'{time.monotonic() - began_at:.1f} s')
        keyframes, file = localizer.keyframes, keyframes_path(parameters)
        if file is None:
            report.skip('keyframes', 'none next to the map: build_map makes them from images')
        else:
            report.judge('keyframes', '' if keyframes is not None else
                         f'{file} is not used, see the error above: make it again with build_map',
                         f'{len(keyframes or ())} of {file}')
        return localizer
    return None


def _check_camera(node: Doctor, parameters: RelocalizerParameters, name: str,
                  silent: dict[str, str], report: Report) -> None:
    """Check images, calibration and clock of a camera."""
    camera, calibration, clock = (of_camera(name, what) for what in (
        'camera', 'calibration', 'clock'))
    images, info = node.images.get(name), node.infos.get(name)
    if images is None:
        report.add(camera, State.FAIL, silent.get(of_camera(name, 'image'), 'no image in time'))
        report.skip(clock, 'needs an image')
        size = None
    else:
        with report.failing(camera):
            size = image_from_msg(images.newest).shape[1::-1]
            count, seconds = len(images.came_at), images.came_at[-1] - images.came_at[0]
            rate = f', {(count - 1) / seconds:.1f} Hz' if count > 1 else ''
            report.add(camera, State.PASS, f'{size[0]} x {size[1]} px{rate}, '
                                           f"frame '{images.newest.header.frame_id}'")
        report.judge(clock, _doubt_of_clock(node, images),
                     f'images come {1e3 * images.lag_s:.0f} ms after their stamps')
    if info is None:
        return report.add(calibration, State.FAIL,
                          silent.get(of_camera(name, 'camera_info'), 'no camera_info in time'))
    with report.failing(calibration):
        found = camera_from_msg(info, size or (info.width, info.height), parameters.rectified)
        width_deg = math.degrees(2.0 * math.atan(found.width / 2.0 / found.fx))
        lens = 'rectified' if parameters.rectified else info.distortion_model or 'no distortion'
        report.judge(calibration, doubt_of_rectified(node.resolve_topic_name(of_camera(
            name, 'image')), parameters), f'{width_deg:.0f} degrees wide, {lens}')


def _doubt_of_clock(node: Doctor, images: SeenImages) -> str:
    """Return what is wrong with the clocks of camera and node; empty if nothing is."""
    uses_sim_time = node.get_parameter('use_sim_time').value
    if uses_sim_time and not node.get_clock().now().nanoseconds:
        return ('use_sim_time is true, but nobody publishes /clock: start the simulation, play '
                'the bag with --clock, or set it to false')
    if abs(images.lag_s) <= _MOST_LAG_S:
        return ''
    return (f'images come {images.lag_s:.1f} s after their stamps by '
            f"{'/clock' if uses_sim_time else 'the clock of this machine'} (limit "
            f'{_MOST_LAG_S:g}): synchronize the clocks; play a bag with --clock and use_sim_time')


def _check_place(node: Doctor, parameters: RelocalizerParameters, image: Any, patience_s: float,
                 report: Report) -> None:
    """Check tf, odometry and the vertical at the stamp of an image, given its header."""
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
            report.add('tf', State.PASS, f"the camera is {base_from_camera[2, 3]:.2f} m above "
                                         f"'{base}' and looks {up_deg:+.0f} degrees up")
        else:
            report.judge('tf', 'base_frame is empty, so initialpose would carry the pose of the '
                         "camera: set it to AMCL's base_frame_id" * parameters.require_localizer,
                         'base_frame is empty: the pose is that of the camera')
    odometry = robot.odometry
    if not odometry.is_published:
        report.skip('odometry', f'nobody publishes {odometry.topic}: the robot is taken to rest, '
                                'and images are not joined')
    else:
        with report.failing('odometry'):
            node.handoff.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s,
                                    time.monotonic() + patience_s)
            report.judge('odometry', _doubt_of_odometry(node, image, mount, parameters),
                         'the robot rests, and poses cover the image')
    if parameters.gravity == 'none' or mount is None:
        return report.skip('vertical', 'needs tf' if mount is None else 'gravity: none')
    with report.failing('vertical'):
        robot.vertical.up_in_camera(parameters, mount, image.frame_id, image.stamp)
        report.add('vertical', State.PASS, f'known by {parameters.gravity}')


def _doubt_of_odometry(node: Doctor, image: Any, mount: Any, parameters: RelocalizerParameters
                       ) -> str:
    """Return why odometry cannot join images; empty if it can."""
    try:
        body = node.robot.odometry.pose_at(image.stamp)
        if mount is not None and body.body_frame not in (image.frame_id, parameters.base_frame):
            node.robot.transforms.lookup(image.frame_id, body.body_frame, image.stamp,
                                         parameters.tf_timeout_s, 'correct its child_frame_id')
    except NoOdometryError as error:
        return f'{error}: stamp images and {node.robot.odometry.topic} by one clock'
    except NoTransformError as error:
        return str(error)
    return ''


def _check_detections(parameters: RelocalizerParameters, localizer: FrameLocalizer | None,
                      frame: Frame | None, why: str, report: Report) -> None:
    """Check that detections come with their images and have classes of the map."""
    if frame is None:
        return report.add('detector', State.FAIL, why)
    found = detections_from_msg(frame.detections, parse_class_map(parameters.class_map))
    if not len(found):
        return report.skip('detector', 'it sees no object: turn the camera to some')
    text = f'{len(found)} boxes, {frame.detected_at - frame.received_at:.2f} s after their image'
    if localizer is not None:
        own = sum(one in localizer.landmark_map.class_ids for one in found.class_ids)
        text += f', {own} of them of the classes of the map'
        if not own and len(found) >= _FOREIGN and parameters.matching != 'clip':
            names = ', '.join(sorted(set(found.class_ids))[:5])
            return report.add('detector', State.FAIL, f'no class of the map is among its {names}: '
                              'use the detector of the map, or class_map')
    report.add('detector', State.PASS, text)


def _check_request(node: Doctor, parameters: RelocalizerParameters,
                   localizer: FrameLocalizer | None, frame: Frame | None, report: Report) -> None:
    """Localize with a frame as a request does: how long each stage takes, and the verdict."""
    if localizer is None or frame is None:
        report.skip('time', 'needs a map and an image with detections')
        return report.skip('pose', 'needs a map and an image with detections')
    with report.failing('pose'):
        states: list[tuple[Frame, RobotState]] = []
        for one in (frame, *frame.beside):
            with suppress(NoTransformError) if states else report.failing('time'):
                states.append((one, node.robot.at(
                    one.image.header, parameters.of_camera(one.camera),
                    time.monotonic() + parameters.tf_timeout_s, one.depth_frame)))
        if not states:
            return report.skip('pose', 'needs tf')
        times = StageTimes('waiting', time.monotonic())
        localized = node.worker.run(partial(
            localizer.localize, frame, parameters, states[0][1], times, math.inf, states[1:]))
        stages_ms = {'detection': 1e3 * (frame.detected_at - frame.received_at), **times.ms}
        is_slow = sum(stages_ms.values()) > 1e3 * parameters.timeout_s
        report.judge('time', time_is_up(stages_ms) * is_slow, f'{in_words(stages_ms)}; timeout_s '
                                                              f'{parameters.timeout_s:g}')
        found = localized.found
        if found.accepted:
            return report.add('pose', State.PASS,
                              f'accepted with confidence {found.confidence:.3f}; not handed over')
        report.skip('pose', f'refused here: {found.reason}')


def doctor(files: Sequence[Path], name: str, patience_s: float, report: Report) -> None:
    """Check the relocalizer of parameter files, or without any, the running one of a name.

    CliplocError: a parameter file cannot be read.
    """
    found = parameters_of_running(name, patience_s, report) if not files else (
        parameters_of_files(files, name), [])
    if found is None:
        return
    executor, ended = NodeExecutor(), threading.Event()
    node = Doctor(*found)
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
