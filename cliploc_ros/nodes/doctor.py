# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check everything that a request needs, and make a robot ready for requests.

The doctor is a relocalizer that answers one request and delivers no pose. It reports the faults
that the inputs themselves find. To make a robot ready, it loads both nodes as they start, and
answers requests for one picture, without any topic.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from llvmlite.binding import get_host_cpu_name
from numpy.typing import NDArray
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.layer import layer_path
from cliploc_ros.core.map.landmark_embeddings import embeddings_path
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.query import Query
from cliploc_ros.errors import CliplocError, ImageError, OptionsError
from cliploc_ros.files.storage import NOT_KEPT
from cliploc_ros.models.onnx_detector import GREY, is_grey
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.nodes.detector import DetectorNode
from cliploc_ros.nodes.relocalizer import RelocalizerNode
from cliploc_ros.ros.answer import Verdict
from cliploc_ros.ros.clients import NotRunningError, ask, check_name
from cliploc_ros.ros.conversions import of_camera
from cliploc_ros.ros.frame_localizer import FrameLocalizer, layer_paths
from cliploc_ros.ros.inputs.frame_source import NoFrameError
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.node.threads import NodeExecutor
from cliploc_ros.ros.parameters import CommonParameters, RelocalizerParameters, map_files

# A greater delay of images after their stamps means that the clocks differ. Not measured.
_MOST_LAG_S = 1.0
_SPIN_S = 0.05
# A request is measured with this number of boxes, typical of a picture of a furnished room.
_BOXES, _ROWS, _COLUMNS = 12, 3, 4
# Parameters that name the user's files, which are not in the cache.
_FILES = ('model', 'map_file', 'keyframes_file', 'clip_model', 'clip_pretrained',
          'clip_checkpoint_path')


class State(StrEnum):
    """The result of a check."""

    PASS = 'pass'
    FAIL = 'fail'
    NOT_CHECKED = 'not checked'
    REFUSED = 'refused'  #: A request gets no pose here, although nothing is broken


class Report:
    """Collects checks with their results, and tells each one immediately.

    `tell` is called with the name of a check, its result, and for a failure the remedy.
    """

    def __init__(self, tell: Callable[[str, State, str], object]) -> None:
        self._tell = tell
        self.findings: list[tuple[str, State]] = []

    def add(self, what: str, state: State, text: str) -> None:
        """Add a check."""
        self.findings.append((what, state))
        self._tell(what, state, text)

    def judge(self, what: str, problem: str, text: str) -> None:
        """Add a failure with `problem`, or, if `problem` is empty, a pass with `text`."""
        self.add(what, State.FAIL if problem else State.PASS, problem or text)

    @contextmanager
    def failing(self, what: str) -> Iterator[None]:
        """Report a CliplocError of the body as a failure."""
        try:
            yield
        except CliplocError as error:
            self.add(what, State.FAIL, str(error))


class Doctor(RelocalizerNode):
    """A relocalizer that answers requests without delivering poses.

    Parameters
    ----------
    given : sequence of Parameter
        Parameters of the relocalizer. Those that make it act without a request are replaced.
    rules : sequence of str
        Remappings of the relocalizer, NAME:=TOPIC.
    """

    def __init__(self, given: Sequence[Parameter], rules: Sequence[str]) -> None:
        passive = {'autostart': True, 'mode': 'on_request', 'watch': 'none', 'record_folder': ''}
        rules = ['/diagnostics:=~/diagnostics', *rules]
        super().__init__('doctor', delivers=False, parameter_overrides=[
            *(one for one in given if one.name not in passive),
            *(Parameter(name, value=value) for name, value in passive.items())],
            cli_args=['--ros-args', *(word for rule in rules for word in ('-r', rule))])
        self._map_error = ''

    def load(self) -> str:
        """Load map and network. After an error, the inputs are checked nevertheless."""
        try:
            return super().load()
        except CliplocError as error:
            self._map_error = str(error)
            return 'no map'

    def diagnose(self, patience_s: float, report: Report) -> None:
        """Check what a request needs; wait up to `patience_s` for each input."""
        parameters = None
        with report.failing('parameters'):
            parameters = self.settings.snapshot()
            report.add('parameters', State.PASS, 'valid')
        if parameters is None:
            return report.add('others', State.NOT_CHECKED, 'correct the parameters first')
        with report.failing('start'):
            self.bring_up()
        if not self.active:
            return None
        localizer = self._pipeline.localizer
        if localizer is None:
            report.add('map', State.FAIL, self._map_error)
        else:
            report.add('map', State.PASS, localizer.description)
            keyframes, file = localizer.keyframes, ', '.join(map(str, layer_paths(parameters)))
            if not file:
                report.add('keyframes', State.NOT_CHECKED,
                           'none next to the map: build_map makes them from images')
            else:
                report.judge('keyframes', '' if keyframes is not None else
                             f'{file} is not used, see the error above: rebuild it with build_map',
                             f'{len(keyframes.localizer.layer if keyframes else ())} of {file}')
        has_frame = self._check_inputs(parameters, patience_s, report)
        if parameters.require_localizer:
            report.judge('localizer', 'base_frame is empty: initialpose would carry the pose of '
                         "the camera: set it to AMCL's base_frame_id" if not parameters.base_frame
                         else self._handoff.localizer.missing(), 'it subscribes to initialpose, '
                         f'and publishes {self._handoff.localizer.pose_topic or "no pose, or tf"}')
        if localizer is None or not has_frame:
            return report.add('pose', State.NOT_CHECKED, 'it needs a map and a frame')
        answer = self._requests.answer()
        faults = [fault.text for fault in localizer.instants.faults]
        report.judge('input', '; '.join([*faults, *localizer.instants.notes,
                                         *self._robot.problems.values()]),
                     'the messages agree with each other, with the map and the parameters')
        is_late = answer.is_cut or answer.kind is RefusalKind.TIME_UP
        return report.add('pose', State.PASS if answer.verdict is Verdict.ACCEPTED else
                          State.REFUSED if answer.kind and not is_late else State.FAIL,
                          answer.message)

    def _check_inputs(self, parameters: RelocalizerParameters, patience_s: float, report: Report
                      ) -> bool:
        """Wait for a frame; check silence, clocks, mount and motion; return whether it came."""
        after, frame, seen = time.monotonic(), None, set[str]()
        with suppress(NoFrameError):  # reported by the sources; discovery may take seconds
            while frame is None or len(seen) < len(self._frames.sources) or (
                    parameters.depth_transport != 'none' and frame.depth is None):
                frame = self._frames.next_frame(time.monotonic(), after + patience_s, math.inf)
                seen |= {one.camera for one in (frame, *frame.beside)}
        for name, source in self._frames.sources.items():
            report.judge(of_camera(name, 'camera'), '' if name in seen else source.why_none(after),
                         f'it publishes {", ".join(source.topics.values())}')
            if math.isfinite(source.nearest_lag_s):
                report.judge(of_camera(name, 'clock'), self._clock_fault(source.nearest_lag_s),
                             f'images come {1e3 * source.nearest_lag_s:.0f} ms after their stamps')
        image = None if frame is None else frame.image.header
        if frame is not None and image is not None and parameters.base_frame:
            with report.failing('tf'):
                base_from_camera = invert_transform(self._robot.at(
                    image, parameters.of_camera(frame.camera), info=frame.camera_info
                    ).camera_from_base)
                if parameters.publish_tf:
                    self._robot.transforms.lookup(image.frame_id, parameters.odom_frame,
                                                  image.stamp, patience_s, 'correct odom_frame')
                up_deg = math.degrees(math.asin(np.clip(base_from_camera[2, 2], -1.0, 1.0)))
                report.add('tf', State.PASS, f'the camera is {base_from_camera[2, 3]:.2f} m above '
                           f"'{parameters.base_frame}' and looks {up_deg:+.0f} degrees up")
        if not self._robot.odometry.is_published:
            report.add('odometry', State.NOT_CHECKED, 'nobody publishes '
                       f'{self._robot.odometry.topic}: the robot is assumed to be at rest, and '
                       'frames are not fused')
        else:
            with report.failing('odometry'):
                self._handoff.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s,
                                         time.monotonic() + patience_s)
                report.add('odometry', State.PASS, 'the robot is at rest')
        return frame is not None

    def _clock_fault(self, lag_s: float) -> str:
        """Return how the clocks of camera and node disagree; empty if they agree."""
        uses_sim_time = self.get_parameter('use_sim_time').value
        if uses_sim_time and not self.get_clock().now().nanoseconds:
            return ('use_sim_time is true, but nobody publishes /clock: start the simulation, '
                    'play the bag with --clock, or set use_sim_time to false')
        return '' if abs(lag_s) <= _MOST_LAG_S else (
            f'images come {lag_s:.1f} s after their stamps by '
            f"{'/clock' if uses_sim_time else 'the clock of this machine'} (limit "
            f'{_MOST_LAG_S:g}): synchronize the clocks; play a bag with --clock and use_sim_time')


def doctor(files: Sequence[Path], name: str, patience_s: float, report: Report) -> None:
    """Check the relocalizer that parameter files describe, or without files, a running one.

    CliplocError: a parameter file cannot be read, or the name is invalid.
    """
    check_name(name)
    for file in files:
        read_parameter_file(file)  # its messages name the line
    # ROS gives the parameters of the files to a node of the same name
    namespace, _, base = name.rpartition('/')
    asking = Node(base if files else 'doctor_asks', namespace=namespace if files else None,
                  start_parameter_services=False, cli_args=['--ros-args', *(
                      word for file in files for word in ('--params-file', str(file)))],
                  automatically_declare_parameters_from_overrides=True)
    values = dict[str, str]()
    try:
        name = asking.resolve_service_name(name)
        if files:
            given = [parameter for parameter in asking.get_parameters_by_prefix('').values()
                     if parameter.name != 'start_type_description_service']
            if {parameter.name for parameter in given} == {'use_sim_time'}:
                raise OptionsError(f'{", ".join(map(str, files))}: no parameters of {name}; name '
                                   'the node with --relocalizer')
        else:
            status, given = ask(asking, name, patience_s)
            values = status.values
            if any(values.get(verdict, '0') != '0' for verdict in (
                    Verdict.ACCEPTED, Verdict.WITHHELD)):  # it no longer uses its last pose
                given = [parameter for parameter in given if parameter.name != 'last_pose_file']
            # missing inputs of an active relocalizer are reported by the checks below
            report.judge('relocalizer', '; '.join(filter(None, (
                values.get('wrong cameras'), values.get('rival of publish_tf'))))
                         if values['state'] == 'active' else status.problem(), f'{name} is active')
    except NotRunningError as error:
        return report.add('relocalizer', State.FAIL, str(error))
    finally:
        asking.destroy_node()
    node = Doctor(given, [*values.get('topics', '').split(), f'~/prior:={name}/prior'])
    node.get_logger().set_level(LoggingSeverity.ERROR)
    executor, ended = NodeExecutor(), threading.Event()
    executor.add_node(node)

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(timeout_sec=_SPIN_S)
    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        node.diagnose(patience_s, report)
    finally:
        ended.set()
        thread.join()
        node.worker.stop()
        executor.shutdown(0.0)
        node.destroy_node()
    return None


def make_ready(picture: Path | None, cache_dir: Path | None, has_detector: bool, report: Report
               ) -> list[str]:
    """Load both nodes with the parameters given to rclpy, and answer requests for a picture.

    Return instructions for copying the cache to a robot, in lines.

    Parameters
    ----------
    picture : Path or None
        Picture for the requests; None: a drawn one.
    cache_dir : Path or None
        The folder to copy to the robot; None: as the parameters say.
    has_detector : bool
        Whether the robot runs this package's detector.

    Raises
    ------
    ImageError
        The picture cannot be read.
    """
    image_rgb, used = read_picture(picture), list[CommonParameters]()
    detector, localizer = None, None
    for kind in (DetectorNode, RelocalizerNode)[not has_detector:]:
        node = kind()
        try:
            with report.failing(node.get_name()):
                used.append(node.settings.snapshot())
                if cache_dir is not None and used[-1].cache_dir != str(cache_dir):
                    raise OptionsError('the parameter file sets cache_dir to '
                                       f"'{used[-1].cache_dir}': remove it there, or leave "
                                       '--cache-dir out')
                start, text = time.monotonic(), node.load()
                report.add(node.get_name(), State.PASS,
                           f'{text}; loaded in {time.monotonic() - start:.1f} s')
                if isinstance(node, DetectorNode):
                    detector = node.detector
                else:
                    localizer = node.localizer
        finally:
            node.worker.stop()
            node.destroy_node()
    if localizer is not None and isinstance(parameters := used[-1], RelocalizerParameters):
        with report.failing('request'):
            first, _, later = (time_request(image_rgb, detector, localizer, parameters)
                               for _ in range(3))
            report.add('request', State.PASS, f'{picture or "a drawn picture"}: first {first}; '
                                              f'later {later}'
                                              f'{"; " + GREY if is_grey(image_rgb) else ""}')
    if any(state is State.FAIL for _, state in report.findings):
        report.add('cache', State.NOT_CHECKED, 'correct the failures first')
        return []
    report.judge('cache', f'not ready: {NOT_KEPT[0]}' if NOT_KEPT else '',
                 'with these parameters, start and requests need neither network nor compiler')
    return [] if cache_dir is None or NOT_KEPT else carrying(cache_dir, used)


def read_picture(picture: Path | None) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) in RGB; without one, a drawn one of 640 x 480.

    ImageError: the picture cannot be read.
    """
    if picture is None:
        # Edges everywhere, so that keyframes find as many features as they keep.
        tiles = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        return tiles.repeat(10, axis=0).repeat(10, axis=1)
    image_bgr = cv2.imread(str(picture), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image_bgr is None:
        raise ImageError(f'{picture} cannot be read as a picture: name a JPEG or PNG file')
    return np.ascontiguousarray(image_bgr[:, :, ::-1], dtype=np.uint8)


def time_request(image_rgb: NDArray[np.uint8], detector: ObjectDetector | None,
                 localizer: FrameLocalizer, parameters: RelocalizerParameters) -> str:
    """Answer a request for a picture as the nodes do; return the time of each stage in words.

    Boxes are drawn up to the number of boxes in a typical picture.
    """
    times = StageTimes('detection', time.monotonic())
    found = Detections(np.empty((0, 4)), (), np.empty(0)) if detector is None else \
        detector.detect(image_rgb)
    height, width = image_rgb.shape[:2]
    drawn = range(len(found), _BOXES)
    corners = np.array([divmod(number, _COLUMNS)[::-1] for number in drawn]).reshape(-1, 2)
    cell, classes = np.array((width / _COLUMNS, height / _ROWS)), \
        localizer.landmark_map.class_ids or ('object',)
    boxes = Detections(
        np.concatenate([found.bboxes_xyxy.reshape(-1, 4), np.concatenate(
            [(corners + 0.25) * cell, (corners + 0.75) * cell], axis=1)]),
        (*found.class_ids, *(classes[number % len(classes)] for number in drawn)),
        np.concatenate([found.scores, np.full(len(drawn), 0.5)]))
    # The time does not depend on the field of view: 53 degrees.
    camera = Camera(width, height, width, width, width / 2, height / 2)
    if localizer.keyframes is not None:  # it warns of another field of view
        own = localizer.keyframes.localizer.layer.cameras[0]
        camera = replace(camera, fx=own.fx * width / own.width, fy=own.fy * width / own.width)
    # the options of the most expensive request
    localizer.answer(Query((Observation(camera, boxes),), (image_rgb,), None),
                     replace(parameters.options(), crops='all'), times)
    stages = ', '.join(f'{stage} {ms:.0f} ms' for stage, ms in times.ms.items())
    return f'{stages} with {len(boxes)} boxes, {len(drawn)} of them drawn'


def carrying(cache_dir: Path, used: Sequence[CommonParameters]) -> list[str]:
    """Return instructions for copying a folder to the robot, in lines."""
    size = sum(file.stat().st_size for file in cache_dir.rglob('*') if file.is_file()
               and not file.is_symlink())
    names = {getattr(parameters, name, '') for parameters in used for name in _FILES} - {''}
    maps = {name for parameters in used if isinstance(parameters, RelocalizerParameters)
            for name in map_files(parameters)}
    files = {Path(name).expanduser().absolute(): 'a parameter names it' for name in names | maps}
    for beside in (embeddings_path, layer_path):
        files = {Path(beside(name)).expanduser().absolute(): f'the map {name} needs it'
                 for name in maps} | files
    return [f'copy {cache_dir} ({size / 1e6:.0f} MB) to the robot, and set cache_dir to its path '
            f"there; its kernels are for processors like this one ('{get_host_cpu_name()}'), "
            'another one compiles them at its first start',
            *(f'copy this file, too, as {why}: {file}' for file, why in sorted(files.items())
              if file.exists())]
