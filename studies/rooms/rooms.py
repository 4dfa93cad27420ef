# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of real rooms, with the detections and features of each image, and their splits."""

import hashlib
import pickle
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.command import positive
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes import features
from cliploc_ros.core.keyframes.features import Features
from cliploc_ros.core.keyframes.localization import ImageFeatures, query_features
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.errors import DatasetError, OptionsError
from cliploc_ros.files.storage import make_folder, write_file
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector
from cliploc_ros.offline.datasets.folders import find_layout, read_folder
from cliploc_ros.offline.datasets.frames import (
    DepthFormat,
    FolderOptions,
    Frames,
    ImageFile,
    RawFrame,
    folder_frames,
)
from cliploc_ros.offline.evaluation.trials import with_vertical
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.posed_query import PosedQuery
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions, record_once
from cliploc_ros.units import NS_PER_S
from studies.acceptance.places import observation_of

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Rows = NDArray[np.int64]
#: The split with a map from one camera, and queries from another camera at another height.
ROBOT = 'phone to robot'
# Accelerations within this time of an image are averaged, as in the node [s].
_WINDOW_S = 0.1
# Deviation of the simulated vertical without an accelerometer.
_VERTICAL_DEG = 1.0
# Assumed horizontal field of view of a camera without calibration.
_USUAL_VIEW_DEG = 65.0
# Share of an image that the robot's camera shows, and width of the robot's images.
_ROBOT_SHARE, _ROBOT_PX = 0.8, 424
# Least number of images to map, and to query.
_LEAST_IMAGES = 15


class Looker:
    """Detects boxes and features, and stores the results of each image in a folder."""

    def __init__(self, folder: Path, model: str) -> None:
        self._folder, self._model = folder, model
        self._detector: ObjectDetector | None = None
        self._code = hashlib.sha256(Path(features.__file__).read_bytes()).hexdigest()[:8]

    def detect(self, image_rgb: Image) -> Detections:
        """Return the detections in an image, as an ObjectDetector does."""
        def find() -> Detections:
            self._detector = self._detector or load_detector(
                DetectorOptions(self._model, conf=0.25))
            return self._detector.detect(image_rgb)
        return Detections(*self._kept(image_rgb, Path(self._model).stem, find))

    def features(self, image_rgb: Image, is_thorough: bool) -> Features:
        """Return the features of an image for a pass."""
        return Features(*self._kept(image_rgb, f'{self._code}.{is_thorough:d}',
                                    lambda: query_features(image_rgb, is_thorough=is_thorough)))

    def _kept(self, image_rgb: Image, what: str, find: Callable[[], Any]) -> tuple[Any, ...]:
        digest = hashlib.sha256(image_rgb.tobytes()).hexdigest()[:24]
        path = self._folder / digest[:2] / f'{digest}.{what}.pickle'
        if not path.exists():
            keep(path, tuple(vars(find()).values()))
        return tuple(pickle.loads(path.read_bytes()))


class KeptFeatures(ImageFeatures):
    """The features of an image, stored for later runs."""

    def __init__(self, looker: Looker, raw: RawFrame) -> None:
        super().__init__(lambda: raw.color()[0], raw.color()[1])
        self._looker = looker

    def of_pass(self, is_thorough: bool) -> Features:
        """Return the features of a pass."""
        return self._looker.features(self._read_rgb(), is_thorough)


def keep(path: Path, what: Any) -> None:
    """Write a file for later runs."""
    make_folder(path.parent)
    write_file(path, lambda partial: partial.write_bytes(pickle.dumps(what)))


@dataclass(frozen=True)
class RoomOptions:
    """Options of reading rooms."""

    model: str  #: Weights of YOLO
    out: Path  #: Folder for results that later runs reuse
    conf: float = DetectorOptions.conf
    #: Unit of the poses [m], by the names of folders that do not state it
    scales: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Room:
    """A recording; row i of all columns is its i-th image. Without poses it has only queries."""

    name: str
    options: RoomOptions
    frames: Frames
    raws: tuple[RawFrame, ...]
    detections: PosedDetections
    features: tuple[ImageFeatures, ...]
    has_poses: bool
    ups: Floats | None  #: (n, 3): measured verticals in the camera; None: simulate them

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.raws)

    @property
    def has_depth(self) -> bool:
        """Return whether the recording has depth."""
        return self.detections.depths is not None

    @cached_property
    def by_robot(self) -> 'Room':
        """Return the room as seen by another camera: a part of each image at less resolution."""
        return self.changed(_robot_view, 'robot')

    def changed(self, change: Callable[[Image, Camera], tuple[Image, Camera]], name: str,
                keeps_depth: bool = False) -> 'Room':
        """Return the room with changed images; the name is that of the change."""
        raws = tuple(replace(raw, color=partial(_changed, change, raw.color),
                             depth=raw.depth if keeps_depth else None) for raw in self.raws)
        frames = frames_of_raws(self.frames.source, raws)
        return replace(self, frames=frames, raws=raws, **_seen(
            frames, raws, self.options, f'{self.name}.{name}'))

    @cached_property
    def queries(self) -> tuple[PosedQuery, ...]:
        """Return all images as queries, with vertical and depth."""
        plain = [PosedQuery(row, observation_of(self.detections, row, raw.stamp_ns),
                       self.detections.map_from_camera[row])
                 for row, raw in enumerate(self.raws)]
        if self.ups is None:
            return with_vertical(plain, _VERTICAL_DEG)
        return tuple(replace(query, observation=replace(query.observation, up_in_camera=up))
                     for query, up in zip(plain, self.ups, strict=True))

    def parts(self) -> Iterator[tuple[str, str, Rows, Rows]]:
        """Yield a kind of split, the name of a part, and the rows to map and to query.

        Images are split by time (alternately, and into halves), by viewing direction, and by
        height. 'phone to robot' maps one height, and queries the other with another camera, see
        by_robot.
        """
        if not self.has_poses:
            return
        rows, poses = np.arange(len(self)), self.detections.map_from_camera
        forward = poses[:, :2, 2]
        axis = np.linalg.svd(forward - forward.mean(axis=0), full_matrices=False)[2][0]
        along = forward @ axis
        splits = {'in turn': rows % 2 == 0, 'halves': rows < len(rows) // 2,
                  'directions': along < np.median(along),
                  **dict.fromkeys(('heights', ROBOT), poses[:, 2, 3] < np.median(poses[:, 2, 3]))}
        for kind, is_first in splits.items():
            for number, is_mapped in enumerate((is_first, ~is_first)):
                mapped, asked = rows[is_mapped], rows[~is_mapped]
                if min(len(mapped), len(asked)) >= _LEAST_IMAGES:
                    yield kind, f'{kind} {number}', mapped, asked


def read_room(where: str, options: RoomOptions) -> Room:
    """Read a room from a folder of a known layout, or from a folder of images only.

    ``DIR@METRES`` gives the unit of depth.
    """
    folder, frames, has_poses = open_folder(where, options.scales)
    raws = tuple(replace(raw, place=row) for row, raw in enumerate(posed(frames)))
    frames = replace(frames_of_raws(frames.source, raws), digest=frames.digest)
    make_folder(options.out)
    return Room(folder.name, options, frames, raws, has_poses=has_poses,
                ups=_measured_verticals(folder, raws), **_seen(frames, raws, options, folder.name))


def open_folder(where: str, scales: Mapping[str, float] = MappingProxyType({})
                ) -> tuple[Path, Frames, bool]:
    """Return a folder, its frames with z up, and whether they have true poses.

    ``scales`` gives the unit of the poses [m] by the name of a folder.
    ``DIR@METRES`` gives the unit of depth.
    """
    path, _, text = where.partition('@')
    folder = Path(path)
    try:
        unit = positive(text) if text else None
    except (ValueError, ArgumentTypeError):
        raise OptionsError(f'{where}: {text!r} is not a unit of depth in metres') from None
    if find_layout(folder) is None and (folder / 'images').is_dir():
        return folder, _without_poses(folder / 'images'), False
    is_tum = (folder / 'rgb.txt').exists()
    return folder, read_folder(folder, FolderOptions(
        layout='tum' if is_tum and not (folder / 'depth.txt').exists() else '',
        depth=DepthFormat(unit), scale=scales.get(folder.name), level=not is_tum)), True


def posed(frames: Frames) -> tuple[RawFrame, ...]:
    """Return the frames that have a pose, without decoding their images."""
    return tuple(frames.read_raw(lambda place, stamp_ns, pose: pose is not None))


def frames_of_raws(source: Path, raws: tuple[RawFrame, ...]) -> Frames:
    """Make frames from raw frames in memory."""
    return Frames(source, len(raws), lambda is_wanted: (
        raw for raw in raws if is_wanted(raw.place, raw.stamp_ns, raw.map_from_camera)))


def _seen(frames: Frames, raws: tuple[RawFrame, ...], options: RoomOptions, name: str
          ) -> dict[str, Any]:
    """Return detections and features of all images, from an earlier run if there was one."""
    recorded = record_once(
        frames, RecordingOptions(DetectorOptions(options.model, conf=options.conf), None,
                                 EVERY_FRAME, reading=name), options.out / f'{name}.npz')
    looker = Looker(options.out / 'looks', options.model)
    return {'detections': recorded,
            'features': tuple(KeptFeatures(looker, raw) for raw in raws)}


def _changed(change: Callable[[Image, Camera], tuple[Image, Camera]],
             color: Callable[[], tuple[Image, Camera]]) -> tuple[Image, Camera]:
    return change(*color())


def _robot_view(image_rgb: Image, camera: Camera) -> tuple[Image, Camera]:
    """Return a part of an image, and its camera."""
    columns, rows = round(_ROBOT_SHARE * camera.width), round(_ROBOT_SHARE * camera.height)
    left, top = round(0.7 * (camera.width - columns)), round(0.4 * (camera.height - rows))
    scale = _ROBOT_PX / columns
    small = cv2.resize(image_rgb[top:top + rows, left:left + columns], None, fx=scale, fy=scale,
                       interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), replace(
        camera, width=small.shape[1], height=small.shape[0], fx=camera.fx * scale,
        fy=camera.fy * scale, cx=(camera.cx - left + 0.5) * scale - 0.5,
        cy=(camera.cy - top + 0.5) * scale - 0.5)


def _without_poses(folder: Path) -> Frames:
    """Return the images of a folder, with unknown poses and an assumed camera."""
    paths = sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in ('.jpg', '.png'))
    if not paths:
        raise DatasetError(f'{folder} has no images')
    first = cv2.imread(str(paths[0]))
    if first is None:
        raise DatasetError(f'{paths[0]} cannot be read as an image')
    height, width = first.shape[:2]
    focal = 0.5 * width / np.tan(np.radians(0.5 * _USUAL_VIEW_DEG))
    camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
    files = [ImageFile(row * NS_PER_S, path, camera, np.eye(4)) for row, path in enumerate(paths)]
    return folder_frames(folder, files)


def _measured_verticals(folder: Path, raws: tuple[RawFrame, ...]) -> Floats | None:
    """Return the vertical in the camera (n, 3) from a TUM folder's accelerometer, None if none.

    The mount of the sensor is not published, so one rotation is fitted to all true poses.
    """
    file = folder / 'accelerometer.txt'
    if not file.exists():
        return None
    samples = np.loadtxt(file)
    stamps = np.array([raw.stamp_ns / NS_PER_S for raw in raws])
    near = np.abs(samples[:, 0] - stamps[:, None]) <= _WINDOW_S
    means = near @ samples[:, 1:] / np.maximum(near.sum(axis=1), 1)[:, None]
    lengths = np.linalg.norm(means, axis=1)
    if (lengths == 0.0).any():
        raise DatasetError(f'{file} has gaps: no sample is within {_WINDOW_S} s of some images')
    ups = means / lengths[:, None]
    true = np.array([raw.map_from_camera[2, :3] for raw in raws
                     if raw.map_from_camera is not None])
    mount, _ = Rotation.align_vectors(true, ups)
    return np.asarray(mount.apply(ups))


def without_boxes(observation: Observation) -> Observation:
    """Return an observation without boxes, for keyframes only."""
    return replace(observation, depths=None,
                   detections=Detections(np.empty((0, 4)), (), np.empty(0)))


def known_of(observation: Observation, names: str) -> Observation:
    """Return an observation with only the named input of 'vertical' and 'depth'."""
    return replace(observation,
                   up_in_camera=observation.up_in_camera if 'vertical' in names else None,
                   depths=observation.depths if 'depth' in names else None)
