# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert a TUM RGB-D sequence and recorded detections into a recording with the nodes' topics."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import read_file
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagWriter
from cliploc_ros.offline.datasets.frames import ImageFile, read_color
from cliploc_ros.offline.datasets.parsing import Fields, naming, parse_stamp_ns
from cliploc_ros.offline.datasets.tum import TumSequence, read_tum_accelerometer

#: Wraps an iterable of the stamp [ns] and file of each image, and shows progress.
Progress = Callable[[Iterable[tuple[int, Path]]], Iterable[tuple[int, Path]]]

_NAMESPACE = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?|/?')
_CODECS = {b'\x89PNG': 'png', b'\xff\xd8\xff': 'jpeg'}


@dataclass(frozen=True)
class ConversionOptions:
    """Format, topics and coordinate frames of the recording."""

    storage: str = 'sqlite3'  #: ``sqlite3`` or ``mcap``
    #: ``raw`` for sensor_msgs/Image; ``compressed`` for sensor_msgs/CompressedImage, with the
    #: bytes of the files
    image_format: str = 'raw'
    prefix: str = ''  #: Namespace of all topics: ``camera`` gives ``/camera/image``
    #: Coordinate frame of images, camera_info and detections (optical axes)
    camera_frame: str = 'camera_optical_frame'
    world_frame: str = 'world'  #: Coordinate frame of the ground-truth poses, and of the map
    imu_frame: str = 'imu'  #: Coordinate frame of the accelerometer; TUM does not give its mount

    def topic(self, name: str) -> str:
        """Return the absolute name of a topic.

        DatasetError: the prefix is not a valid ROS namespace.
        """
        if _NAMESPACE.fullmatch(self.prefix) is None:
            raise DatasetError(f'prefix {self.prefix!r} is not a ROS namespace, such as /camera')
        return '/'.join(['', *filter(None, self.prefix.split('/')), name])


@dataclass(frozen=True)
class ConversionResult:
    """Numbers of written messages."""

    images: int  #: Images, each with a camera_info
    poses: int  #: Images with ground truth
    detections: int  #: Images with an entry of recorded detections, which may be empty
    accelerations: int = 0  #: Samples of the accelerometer


def convert_tum(sequence: TumSequence, camera: Camera, output: str | Path,
                options: ConversionOptions, detections: Mapping[int, Detections] | None = None,
                progress: Progress = iter) -> ConversionResult:
    """Write a sequence as a rosbag2 recording.

    Topics: ``image`` or ``image/compressed``, ``camera_info``, ``ground_truth``, ``detections`` if
    given, and ``imu`` if the folder has an accelerometer.txt. All headers of a frame have the
    image's exact stamp, which is also the time of recording. DatasetError: an image is invalid, no
    image has detections, or the output cannot be written. No partial recording remains.

    Parameters
    ----------
    camera : Camera
        Intrinsics; the images must have its size.
    output : str or Path
        The folder to make.
    detections : mapping of int to Detections, optional
        Recorded detections by stamp [ns].
    progress : callable
        Wraps the iterable of images, to show progress.
    """
    recorded = detections or {}
    if detections is not None and not any(stamp in detections for stamp in sequence.stamps_ns):
        raise DatasetError(
            f'{sequence.folder}: no recorded detection has the stamp of an image; are the '
            'detections from another sequence?')
    is_compressed = options.image_format == 'compressed'
    image_topic = options.topic('image/compressed' if is_compressed else 'image')
    info_topic, pose_topic = options.topic('camera_info'), options.topic('ground_truth')
    boxes_topic = options.topic('detections')
    frame, poses, boxes = options.camera_frame, 0, 0
    accelerometer = sequence.folder / 'accelerometer.txt'
    stamps_ns, accelerations = (read_tum_accelerometer(accelerometer) if accelerometer.exists()
                                else ([], np.empty((0, 3))))
    with BagWriter(output, options.storage) as bag:
        bag.add_topic(image_topic, bag_messages.COMPRESSED_IMAGE if is_compressed
                      else bag_messages.IMAGE)
        bag.add_topic(info_topic, bag_messages.CAMERA_INFO)
        bag.add_topic(pose_topic, bag_messages.POSE)
        if detections is not None:
            bag.add_topic(boxes_topic, bag_messages.DETECTIONS)
        for stamp_ns, path in progress(
                list(zip(sequence.stamps_ns, sequence.image_paths, strict=True))):
            # decoded in any case, to refuse a damaged file before a node receives it
            pixels_rgb, _ = read_color(ImageFile(stamp_ns, path, camera))
            if is_compressed:
                with naming(path, OSError, what='cannot be read: '):
                    data = read_file(path)
                codec = next((codec for magic, codec in _CODECS.items()
                              if data.startswith(magic)), None)
                if codec is None:
                    raise DatasetError(f'{path}: is neither PNG nor JPEG; write raw images')
                message = bag_messages.compressed_image_message(stamp_ns, frame, data, codec)
            else:
                message = bag_messages.image_message(stamp_ns, frame, pixels_rgb)
            bag.write(image_topic, stamp_ns, message)
            bag.write(info_topic, stamp_ns,
                      bag_messages.camera_info_message(stamp_ns, frame, camera))
            if stamp_ns in recorded:
                bag.write(boxes_topic, stamp_ns, bag_messages.detections_message(
                    stamp_ns, frame, recorded[stamp_ns]))
                boxes += 1
            if (map_from_camera := sequence.pose_at(stamp_ns)) is not None:
                bag.write(pose_topic, stamp_ns, bag_messages.pose_message(
                    stamp_ns, options.world_frame, map_from_camera))
                poses += 1
        if stamps_ns:
            imu_topic = options.topic('imu')
            bag.add_topic(imu_topic, bag_messages.IMU)
            for stamp_ns, acceleration in zip(stamps_ns, accelerations, strict=True):
                bag.write(imu_topic, stamp_ns, bag_messages.imu_message(
                    stamp_ns, options.imu_frame, acceleration))
    return ConversionResult(len(sequence), poses, boxes, len(stamps_ns))


def read_recorded_detections(path: str | Path, image_size: tuple[int, int] | None = None
                             ) -> dict[int, Detections]:
    """Read recorded detections; return them by exact stamp [ns].

    The format is ``{"image_size": [w, h], "frames": [{"timestamp": "1341847980.722988",
    "detections": [{"class_id": "book", "score": 0.58, "bbox_xyxy": [173, 138, 219, 208]}]}]}``;
    ``image_size`` is optional. A frame without detections has an empty entry.

    `image_size` is the expected width and height of the images [px]. DatasetError: the message
    names file, frame and field.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f'{path}: no such file of recorded detections')
    content = Fields.of_file(path)
    recorded = content.values.get('image_size')
    if None not in (recorded, image_size) and recorded != list(image_size or ()):
        raise DatasetError(
            f'{path}: image_size is {recorded}, but the images are {list(image_size or ())}')
    detections: dict[int, Detections] = {}
    for index, entry in enumerate(content.entries('frames')):
        frame = Fields(entry, f'{path}: frame {index}')
        timestamp = frame.written('timestamp')
        stamp_ns = parse_stamp_ns(timestamp, frame.where)
        if stamp_ns in detections:
            raise DatasetError(f'{frame.where}: timestamp {timestamp} is repeated')
        boxes, class_ids, scores = [], [], []
        for number, detection in enumerate(frame.entries('detections')):
            fields = Fields(detection, f'{frame.where}, detection {number}')
            class_ids.append(fields.text('class_id'))
            scores.append(fields.number('score'))
            boxes.append(fields.numbers('bbox_xyxy', (4,)).tolist())
            if not 0 <= scores[-1] <= 1:
                raise DatasetError(f'{fields.where}: score is {scores[-1]}, outside 0 to 1')
            left, top, right, bottom = boxes[-1]
            if left >= right or top >= bottom:
                raise DatasetError(f'{fields.where}: bbox_xyxy {boxes[-1]} is not left, top, '
                                   'right, bottom')
        detections[stamp_ns] = Detections(
            np.array(boxes, dtype=np.float64).reshape(-1, 4), tuple(class_ids),
            np.array(scores, dtype=np.float64))
    return detections
