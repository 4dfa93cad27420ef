# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Load both nodes as on the robot, measure a request, and list the files to copy to the robot."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from llvmlite.binding import get_host_cpu_name
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import layer_path
from cliploc_ros.core.map.landmark_embeddings import embeddings_path
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.query import Query
from cliploc_ros.errors import ImageError, OptionsError
from cliploc_ros.files.storage import NOT_KEPT
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.nodes.detector import DetectorNode
from cliploc_ros.nodes.relocalizer import RelocalizerNode
from cliploc_ros.ros.frame_localizer import FrameLocalizer, load_localizer
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import CommonParameters, RelocalizerParameters, map_files

# A request is measured with this number of boxes, typical of a picture of a furnished room.
_BOXES = 12
_ROWS, _COLUMNS = 3, 4
_REQUESTS = 3
# Parameters that name the user's files, which are not in the cache.
_FILES = ('model', 'map_file', 'keyframes_file', 'clip_model', 'clip_pretrained',
          'clip_checkpoint_path')


@dataclass(frozen=True)
class Request:
    """The cost of one request."""

    stage_ms: dict[str, float]  #: Stage to its time [ms]
    #: Number of boxes that the detector found, and that the search used
    detected: int
    boxes: int
    reason: str  #: The verdict in words


def prepare_nodes(picture: Path | None, cache_dir: Path | None, has_detector: bool) -> None:
    """Prepare both nodes, with the parameters given to rclpy; print progress and cost.

    CliplocError: the message names the file, parameter or download to correct.

    Parameters
    ----------
    picture : Path or None
        Picture for the request; None: a drawn one.
    cache_dir : Path or None
        The folder to copy to the robot; None: as the parameters say.
    has_detector : bool
        Whether the robot runs this package's detector.
    """
    image_rgb = read_picture(picture)
    used: list[CommonParameters] = []
    detector = None
    if has_detector:
        with _step('detector: weights and network'), _node(DetectorNode(), cache_dir) as node:
            used.append(node.settings.snapshot())
            node.load()
            detector = node.detector
    with (_step('relocalizer: map, weights, labels, network, kernels'),
          _node(RelocalizerNode(), cache_dir) as node):
        parameters = node.settings.snapshot()
        used.append(parameters)
        localizer = load_localizer(node, parameters)
    with _step(f'{_REQUESTS} requests for {picture or "a drawn picture"}'):
        requests = [answer(image_rgb, detector, localizer, parameters) for _ in range(_REQUESTS)]
    print(cost_table(requests), flush=True)
    if NOT_KEPT:
        raise OptionsError(f'not ready: {NOT_KEPT[0]}')
    print('ready: with these parameters, start and requests need neither network nor compiler')
    if cache_dir is not None:
        print('\n'.join(carrying(cache_dir, used)))


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


def answer(image_rgb: NDArray[np.uint8], detector: ObjectDetector | None,
           localizer: FrameLocalizer, parameters: RelocalizerParameters) -> Request:
    """Answer a request for a picture as the nodes do, and measure it."""
    start = time.monotonic()
    found = _NOTHING if detector is None else detector.detect(image_rgb)
    detection_ms = (time.monotonic() - start) * 1e3
    height, width = image_rgb.shape[:2]
    boxes = with_drawn_boxes(found, localizer.landmark_map, (width, height))
    # The time does not depend on the field of view: 53 degrees.
    camera = Camera(width, height, width, width, width / 2, height / 2)
    times = StageTimes('waiting', time.monotonic())
    # the options of the most expensive request
    answered = localizer.answer(Query((Observation(camera, boxes),), (image_rgb,), None),
                                replace(parameters.options(), crops='all'), times)
    stage_ms = {'detection': detection_ms} if detector is not None else {}
    return Request(stage_ms | times.ms, len(found), len(boxes), answered.reason or 'accepted')


def with_drawn_boxes(found: Detections, landmark_map: LandmarkMap, size: tuple[int, int]
                     ) -> Detections:
    """Add drawn boxes to detections, up to the number of boxes in a typical picture."""
    missing = range(len(found), _BOXES)
    cell = np.array(size) / (_COLUMNS, _ROWS)
    corners = np.array([divmod(number, _COLUMNS)[::-1] for number in missing]).reshape(-1, 2)
    drawn = np.concatenate([(corners + 0.25) * cell, (corners + 0.75) * cell], axis=1)
    classes = landmark_map.class_ids or ('object',)
    return Detections(np.concatenate([found.bboxes_xyxy.reshape(-1, 4), drawn]),
                      (*found.class_ids, *(classes[number % len(classes)] for number in missing)),
                      np.concatenate([found.scores, np.full(len(missing), 0.5)]))


def cost_table(requests: list[Request]) -> str:
    """Return a table of the cost of the requests, by stage."""
    first, last = requests[0], requests[-1]
    drawn = last.boxes - last.detected
    lines = [f'cost of a request on this machine, with {last.boxes} boxes'
             + (f' ({drawn} of them drawn for the measurement)' if drawn else ''),
             f'{"stage":<12} {"first ms":>9} {"later ms":>9}']
    rows = [(stage, first.stage_ms[stage],
             float(np.median([request.stage_ms[stage] for request in requests[1:]])))
            for stage in last.stage_ms if stage != 'waiting']
    rows.append(('in all', sum(row[1] for row in rows), sum(row[2] for row in rows)))
    lines += [f'{stage:<12} {once:>9.0f} {later:>9.0f}' for stage, once, later in rows]
    lines.append(f'the verdict on this picture: {last.reason}')
    return '\n'.join(lines)


def carrying(cache_dir: Path, used: list[CommonParameters]) -> list[str]:
    """Return instructions for copying a folder to the robot, in lines."""
    size = sum(file.stat().st_size for file in cache_dir.rglob('*') if file.is_file()
               and not file.is_symlink())
    lines = [f'copy {cache_dir} ({size / 1e6:.0f} MB) to the robot, and set cache_dir to its '
             'path there',
             f"its kernels are for processors like this one ('{get_host_cpu_name()}'); another "
             'one compiles them at its first start']
    names = {getattr(parameters, name, '') for parameters in used for name in _FILES} - {''}
    maps = {name for parameters in used if isinstance(parameters, RelocalizerParameters)
            for name in map_files(parameters)}
    names |= maps | {str(beside(name)) for name in maps
                     for beside in (embeddings_path, layer_path)}
    files = sorted({Path(name).expanduser().absolute() for name in names})
    return lines + [f'copy this file, too, as a parameter names it: {file}' for file in files
                    if file.exists()]


@contextmanager
def _step(what: str) -> Iterator[None]:
    """Print the name of a step, and its duration."""
    start = time.monotonic()
    print(f'==> {what}', flush=True)
    yield
    print(f'    done after {time.monotonic() - start:.1f} s', flush=True)


@contextmanager
def _node[Node: ManagedNode[Any]](node: Node, cache_dir: Path | None) -> Iterator[Node]:
    """Yield a node whose parameter cache_dir has the expected value; destroy it afterwards."""
    try:
        own = node.settings.values.cache_dir
        if cache_dir is not None and own != str(cache_dir):
            raise OptionsError(f'the parameter file sets cache_dir of the {node.get_name()} to '
                               f"'{own}': remove it there, or leave --cache-dir out")
        yield node
    finally:
        node.worker.stop()
        node.destroy_node()


_NOTHING = Detections(np.empty((0, 4)), (), np.empty(0))
