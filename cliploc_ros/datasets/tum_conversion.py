# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert a TUM RGB-D sequence into a recording with the nodes' topics."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import Detections
from cliploc_ros.datasets import bag_messages
from cliploc_ros.datasets.bag_writer import BagWriter
from cliploc_ros.datasets.tum import TumSequence
from cliploc_ros.errors import DatasetError

#: Passes on an iterable of stamp [ns] and file of each image, and shows progress.
Progress = Callable[[Iterable[tuple[int, Path]]], Iterable[tuple[int, Path]]]

_NAMESPACE = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?|/?')
_CODECS = {b'\x89PNG': 'png', b'\xff\xd8\xff': 'jpeg'}


@dataclass(frozen=True)
class ConversionOptions:
    """Format, topics and coordinate frames of the recording."""

    storage: str = 'sqlite3'  #: ``sqlite3`` or ``mcap``
    #: ``raw`` for sensor_msgs/Image; ``compressed`` for sensor_msgs/CompressedImage with the
    #: files' own bytes
    image_format: str = 'raw'
    prefix: str = ''  #: Namespace of all topics: ``camera`` gives ``/camera/image``
    #: Coordinate frame of images, camera_info and detections (optical axes)
    camera_frame: str = 'camera_optical_frame'
    world_frame: str = 'world'  #: Coordinate frame of the ground-truth poses: the map's

    def topic(self, name: str) -> str:
        """Return the absolute name of a topic.

        Raises
        ------
        DatasetError
            If the prefix is no valid ROS namespace.
        """
        if _NAMESPACE.fullmatch(self.prefix) is None:
            raise DatasetError(f'prefix {self.prefix!r} is no ROS namespace, such as /camera')
        return '/'.join(['', *filter(None, self.prefix.split('/')), name])


@dataclass(frozen=True)
class ConversionResult:
    """Counts of what was written."""

    images: int  #: Images, each with a camera_info
    poses: int  #: Images with ground truth
    detections: int  #: Images with an entry of recorded detections, which may be empty


def convert_tum(
    sequence: TumSequence,
    camera: Camera,
    output: str | Path,
    options: ConversionOptions,
    detections: Mapping[int, Detections] | None = None,
    progress: Progress = iter,
) -> ConversionResult:
    """Write a sequence as a rosbag2 recording.

    Topics: ``image`` or ``image/compressed``, ``camera_info``, ``ground_truth`` and, if
    given, ``detections``. All headers of a frame have exactly the image's stamp, which is
    also the time of recording.

    Parameters
    ----------
    sequence : TumSequence
        Images and ground truth.
    camera : Camera
        Intrinsics; the images must have its size.
    output : str or Path
        The folder to make.
    options : ConversionOptions
        Format, topics and coordinate frames.
    detections : mapping of int to Detections, optional
        Recorded detections by stamp [ns].
    progress : callable
        Wraps the iterable of images, to show progress.

    Returns
    -------
    ConversionResult

    Raises
    ------
    DatasetError
        If an image is invalid, no image has detections, or the output cannot be written.
        No partial recording remains.
    """
    if detections is not None and not any(stamp in detections for stamp in sequence.stamps_ns):
        raise DatasetError(
            f'{sequence.folder}: the recorded detections have the stamps of none of its images; '
            'are they of another sequence?'
        )
    with BagWriter(output, options.storage) as bag:
        recorder = _FrameRecorder(bag, camera, options, detections)
        for stamp_ns, path in progress(
            list(zip(sequence.stamps_ns, sequence.image_paths, strict=True))
        ):
            recorder.add(stamp_ns, path, sequence.pose_at(stamp_ns))
    return ConversionResult(recorder.images, recorder.poses, recorder.detections)


class _FrameRecorder:
    """Writes the messages of one frame after another."""

    def __init__(
        self,
        bag: BagWriter,
        camera: Camera,
        options: ConversionOptions,
        detections: Mapping[int, Detections] | None,
    ) -> None:
        self.images = self.poses = self.detections = 0
        self._bag, self._camera, self._options = bag, camera, options
        self._recorded: Mapping[int, Detections] = detections or {}
        self._compressed = options.image_format == 'compressed'
        self._image_topic = options.topic('image/compressed' if self._compressed else 'image')
        self._info_topic = options.topic('camera_info')
        self._pose_topic = options.topic('ground_truth')
        self._detections_topic = options.topic('detections')
        image_type = (
            bag_messages.COMPRESSED_IMAGE if self._compressed else bag_messages.IMAGE
        )
        bag.add_topic(self._image_topic, image_type)
        bag.add_topic(self._info_topic, bag_messages.CAMERA_INFO)
        bag.add_topic(self._pose_topic, bag_messages.POSE)
        if detections is not None:
            bag.add_topic(self._detections_topic, bag_messages.DETECTIONS)

    def add(self, stamp_ns: int, path: Path, map_from_camera: NDArray[np.float64] | None) -> None:
        """Write one frame."""
        frame = self._options.camera_frame
        self._write_image(stamp_ns, path)
        info = bag_messages.camera_info_message(stamp_ns, frame, self._camera)
        self._bag.write(self._info_topic, stamp_ns, info)
        if stamp_ns in self._recorded:
            boxes = bag_messages.detections_message(stamp_ns, frame, self._recorded[stamp_ns])
            self._bag.write(self._detections_topic, stamp_ns, boxes)
            self.detections += 1
        if map_from_camera is not None:
            pose = bag_messages.pose_message(stamp_ns, self._options.world_frame, map_from_camera)
            self._bag.write(self._pose_topic, stamp_ns, pose)
            self.poses += 1

    def _write_image(self, stamp_ns: int, path: Path) -> None:
        data = _read_bytes(path)
        pixels_bgr = _decode(data, path)
        height, width = pixels_bgr.shape[:2]
        if (width, height) != (self._camera.width, self._camera.height):
            raise DatasetError(
                f'{path}: has {width}x{height} px, but the intrinsics are for '
                f'{self._camera.width}x{self._camera.height} px'
            )
        frame = self._options.camera_frame
        if self._compressed:
            codec = _codec(data, path)
            message = bag_messages.compressed_image_message(stamp_ns, frame, data, codec)
        else:
            pixels_rgb = np.asarray(cv2.cvtColor(pixels_bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            message = bag_messages.image_message(stamp_ns, frame, pixels_rgb)
        self._bag.write(self._image_topic, stamp_ns, message)
        self.images += 1


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read: {error.strerror}') from error


def _decode(data: bytes, path: Path) -> NDArray[np.uint8]:
    # Compressed images are decoded too: this refuses a damaged file before a node receives it.
    try:
        pixels_bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        pixels_bgr = None  # OpenCV raises for an empty buffer and returns None for a damaged one
    if pixels_bgr is None:
        raise DatasetError(f'{path}: cannot be decoded as an image')
    return np.asarray(pixels_bgr, dtype=np.uint8)


def _codec(data: bytes, path: Path) -> str:
    for magic, codec in _CODECS.items():
        if data.startswith(magic):
            return codec
    raise DatasetError(f'{path}: is neither PNG nor JPEG; write raw images instead (--raw)')
