# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read TUM RGB-D folders (Sturm et al. 2012), and convert them to rosbag2 recordings.

The recordings have the topics of the nodes, with recorded detections if there are any.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import is_rigid, quaternion_from_transform
from cliploc_ros.core.observation import Detections
from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import read_file
from cliploc_ros.offline.datasets import parsing
from cliploc_ros.offline.datasets.frames import ImageFile, read_color
from cliploc_ros.offline.datasets.poses import TimedPoses

_COLUMNS = 'timestamp tx ty tz qx qy qz qw'
_SECONDS = {'s': Decimal(1), 'ms': Decimal('1e-3'), 'us': Decimal('1e-6'), 'µs': Decimal('1e-6'),
            'ns': Decimal('1e-9')}
_METRES = {'mm': 0.001, 'cm': 0.01}
# Files of the dataset have quaternions of four decimals.
_MAX_NORM_ERROR = 0.05
_NAMESPACE = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?|/?')
_IMU_FRAME = 'imu'  # of the accelerometer; TUM does not give its mount
_CODECS = {b'\x89PNG': 'png', b'\xff\xd8\xff': 'jpeg'}


@dataclass(frozen=True)
class TumSequence:
    """A TUM RGB-D folder: colour images with stamps, and the camera's trajectory."""

    folder: Path
    #: Stamp of each image [ns], exact to the last decimal, strictly increasing
    stamps_ns: tuple[int, ...]
    image_paths: tuple[Path, ...]  #: The image file of each stamp; all exist
    #: Ground truth, map_from_camera; empty if the folder has no groundtruth.txt
    trajectory: TimedPoses

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.stamps_ns)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp; None without a sample within 20 ms."""
        return self.trajectory.pose_at(stamp_ns)

    def every(self, step: int) -> 'TumSequence':
        """Return the sequence with only every ``step``-th image, starting with the first."""
        return replace(
            self, stamps_ns=self.stamps_ns[::step], image_paths=self.image_paths[::step])


def read_tum(folder: Path) -> TumSequence:
    """Read a TUM RGB-D folder, except for the pixels of its images.

    It holds ``rgb.txt``, the images listed there, and optionally ``groundtruth.txt``.
    DatasetError: the message names the file and the invalid line.
    """
    truth = folder / 'groundtruth.txt'
    trajectory = (read_tum_trajectory(truth) if truth.exists()
                  else TimedPoses.from_samples([], [], str(folder)))
    return TumSequence(folder, *read_image_list(folder / 'rgb.txt'), trajectory)


def read_tum_trajectory(path: str | Path) -> TimedPoses:
    """Read a trajectory in TUM format, with lines ``timestamp tx ty tz qx qy qz qw``.

    A first line with the names of the columns, as in EuRoC, may define another order and other
    units; columns that are not part of a pose are ignored. Without names, a line may also hold a
    stamp and a matrix of 3 or 4 rows. If a stamp is too large for seconds, all stamps of the file
    are in ms, us or ns. Lines may have any order. Of lines with equal stamps, the first is used.
    ``#`` begins a comment. DatasetError: a line is invalid, or the norm of its quaternion is not
    1; the message names file and line.
    """
    path = Path(path)
    order, stamp_s, metres, header = _named_columns(path)
    table = list(parsing.read_cells(path, 'timestamp ...', header))
    widths = {len(cells) for _, cells in table}
    if order is None and widths == {12}:
        raise DatasetError(f'{path}: has matrices without stamps, like KITTI: put the stamp of '
                           'its image before each matrix')
    if order is None and widths == {7}:
        raise DatasetError(f'{path}: has poses without stamps: expected {_COLUMNS}')
    if stamp_s is None:
        column = 0 if order is None else order[0]
        stamp_s = parsing.unit_of_stamps(cells[column] for _, cells in table
                                         if len(cells) > column)
    matrix = order is None and widths <= {13, 17} and bool(widths)
    stamps_ns, rows = [], []
    for where, cells in table:
        if order is not None and len(cells) > max(order):
            cells = [cells[number] for number in order]
        if len(cells) != 8 and not matrix:
            raise DatasetError(f'{where}: expected {_COLUMNS}, got {len(cells)} fields: '
                               f'{" ".join(cells)[:60]!r}; name other columns in the first line')
        numbers = parsing.parse_all(cells[1:], float, where)
        if not np.all(np.isfinite(numbers)):
            raise DatasetError(f'{where}: {" ".join(cells[1:])!r} is not finite')
        if matrix:  # by rows
            pose = np.array([*numbers[:12], 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
            if numbers[12:] not in ([], [0.0, 0.0, 0.0, 1.0]) or not is_rigid(pose, 1e-2):
                raise DatasetError(f'{where}: {len(numbers)} numbers are not a pose: expected '
                                   f'{_COLUMNS}, or name the columns in the first line')
            numbers = [*pose[:3, 3].tolist(), *quaternion_from_transform(pose).tolist()]
        parsing.unit_quaternion(numbers[3:], where, _MAX_NORM_ERROR)
        stamps_ns.append(parsing.parse_stamp_ns(cells[0], where, stamp_s))
        rows.append([*(metres * number for number in numbers[:3]), *numbers[3:]])
    return TimedPoses.from_samples(stamps_ns, rows, str(path), _MAX_NORM_ERROR)


def _named_columns(path: Path) -> tuple[list[int] | None, Decimal | None, float, int]:
    """Read the header of a table of poses.

    Return the columns of a pose, the unit of stamps [s], the unit of lengths [m], and the number
    of lines to skip. The columns or the unit of stamps are None if the header does not give them.
    """
    for number, line in enumerate(parsing.read_text(path).splitlines()):
        text = line.strip().lstrip('#').strip()
        is_comment = line.strip().startswith('#')
        if not is_comment and text and not text[0].isalpha():
            break
        names = text.split(',') if ',' in text else re.sub(r'\s+([\[(])', r'\1', text).split()
        roles = [_role(name) for name in names]
        if all(role in roles for role in _COLUMNS.split()):
            order = [roles.index(role) for role in _COLUMNS.split()]
            units = [re.search(r'[\[(_](ns|us|µs|ms|s|m|cm|mm)\b', names[column].lower())
                     for column in order[:2]]
            stamp, length = (unit[1] if unit else '' for unit in units)
            return (order, _SECONDS.get(stamp), _METRES.get(length, 1.0),
                    0 if is_comment else number + 1)
    return None, None, 1.0, 0


def _role(name: str) -> str:
    """Return the column of the TUM format that a name stands for; '' if there is none."""
    word = re.sub(r'[\[(].*|_([nuµm]?s|[cm]?m)$', '', name.strip().lower()).strip()
    if word.startswith(('time', 'stamp', '#time')) or word == 't':
        return 'timestamp'
    kind = next((kind for kind, starts in (
        ('q', ('q', 'rot', 'orientation')), ('t', ('t', 'p', 'x', 'y', 'z', 'trans')))
        if word.startswith(starts)), '')
    return f'{kind}{word[-1]}' if kind and word[-1] in 'xyzw' else ''


def read_tum_accelerometer(path: Path) -> list[tuple[int, NDArray[np.float64]]]:
    """Read the stamps [ns] and accelerations (3,) [m/s^2] of an accelerometer.txt.

    DatasetError: a line does not hold four finite numbers; the message names file and line.
    """
    found = []
    for where, (stamp, *cells) in parsing.read_cells(path, 'timestamp ax ay az'):
        acceleration = np.array(parsing.parse_all(cells, float, where))
        if not np.isfinite(acceleration).all():
            raise DatasetError(f'{where}: {" ".join(cells)!r} is not finite')
        found.append((parsing.parse_stamp_ns(stamp, where), acceleration))
    return found


def read_image_list(path: Path) -> tuple[tuple[int, ...], tuple[Path, ...]]:
    """Read the stamps [ns] and image files listed in a file such as rgb.txt.

    DatasetError: the message names the file and the invalid line.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such file; a TUM folder lists its images in rgb.txt')
    stamps_ns: list[int] = []
    image_paths: list[Path] = []
    for where, line in parsing.read_lines(path):
        stamp, *name = line.split(maxsplit=1)
        if not name:
            raise DatasetError(f'{where}: expected timestamp and file name, got {line!r}')
        image_path = path.parent / name[0]
        stamps_ns.append(parsing.parse_stamp_ns(stamp, where))
        if len(stamps_ns) > 1 and stamps_ns[-1] <= stamps_ns[-2]:
            raise DatasetError(f'{where}: timestamp {stamp} is not later than the previous one')
        if not image_path.is_file():
            raise DatasetError(f'{where}: image {image_path} does not exist')
        image_paths.append(image_path)
    if not stamps_ns:
        raise DatasetError(f'{path}: lists no images')
    return tuple(stamps_ns), tuple(image_paths)


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

    def topic(self, name: str) -> str:
        """Return the absolute name of a topic.

        DatasetError: the prefix is not a valid ROS namespace.
        """
        if _NAMESPACE.fullmatch(self.prefix) is None:
            raise DatasetError(f'prefix {self.prefix!r} is not a ROS namespace, such as /camera')
        return '/'.join(['', *filter(None, self.prefix.split('/')), name])


def convert_tum(sequence: TumSequence, camera: Camera, output: str | Path,
                options: ConversionOptions, detections: Mapping[int, Detections] | None = None
                ) -> Counter[str]:
    """Write a sequence as a rosbag2 recording; show a progress bar on a terminal.

    Return the numbers of ``poses`` (images with ground truth), ``detections`` (images with an
    entry of recorded detections, which may be empty) and ``accelerations``.

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
    """
    # only this needs rosbags and tqdm; core tests with few packages read trajectories
    from tqdm import tqdm

    from cliploc_ros.offline.datasets import bag_messages
    from cliploc_ros.offline.datasets.bags import BagWriter

    recorded = detections or {}
    if detections is not None and not any(stamp in detections for stamp in sequence.stamps_ns):
        raise DatasetError(
            f'{sequence.folder}: no recorded detection has the stamp of an image; are the '
            'detections from another sequence?')
    is_compressed = options.image_format == 'compressed'
    image_topic = options.topic('image/compressed' if is_compressed else 'image')
    info_topic, pose_topic = options.topic('camera_info'), options.topic('ground_truth')
    boxes_topic = options.topic('detections')
    frame, written = options.camera_frame, Counter[str]()
    accelerometer = sequence.folder / 'accelerometer.txt'
    accelerations = read_tum_accelerometer(accelerometer) if accelerometer.exists() else []
    with BagWriter(output, options.storage) as bag:
        bag.add_topic(image_topic, bag_messages.COMPRESSED_IMAGE if is_compressed
                      else bag_messages.IMAGE)
        bag.add_topic(info_topic, bag_messages.CAMERA_INFO)
        bag.add_topic(pose_topic, bag_messages.POSE)
        if detections is not None:
            bag.add_topic(boxes_topic, bag_messages.DETECTIONS)
        for stamp_ns, path in zip(sequence.stamps_ns, tqdm(
                sequence.image_paths, unit='image', disable=None), strict=True):
            # decoded in any case, to refuse a damaged file before a node receives it
            pixels_rgb, _ = read_color(ImageFile(stamp_ns, path, camera))
            if is_compressed:
                with parsing.naming(path, OSError, what='cannot be read: '):
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
                written['detections'] += 1
            if (map_from_camera := sequence.pose_at(stamp_ns)) is not None:
                bag.write(pose_topic, stamp_ns, bag_messages.pose_message(
                    stamp_ns, options.world_frame, map_from_camera))
                written['poses'] += 1
        if accelerations:
            imu_topic = options.topic('imu')
            bag.add_topic(imu_topic, bag_messages.IMU)
            for stamp_ns, acceleration in accelerations:
                bag.write(imu_topic, stamp_ns, bag_messages.imu_message(
                    stamp_ns, _IMU_FRAME, acceleration))
                written['accelerations'] += 1
    return written


def read_recorded_detections(path: Path, image_size: tuple[int, int] | None = None
                             ) -> dict[int, Detections]:
    """Read recorded detections; return them by exact stamp [ns].

    The format is ``{"image_size": [w, h], "frames": [{"timestamp": "1341847980.722988",
    "detections": [{"class_id": "book", "score": 0.58, "bbox_xyxy": [173, 138, 219, 208]}]}]}``;
    ``image_size`` is optional. A frame without detections has an empty entry.

    `image_size` is the expected width and height of the images [px]. DatasetError: the message
    names file, frame and field.
    """
    content = parsing.Fields.of_file(path)
    recorded = content.values.get('image_size')
    if None not in (recorded, image_size) and recorded != list(image_size or ()):
        raise DatasetError(
            f'{path}: image_size is {recorded}, but the images are {list(image_size or ())}')
    detections: dict[int, Detections] = {}
    for index, entry in enumerate(content.entries('frames')):
        frame = parsing.Fields(entry, f'{path}: frame {index}')
        timestamp = frame.written('timestamp')
        stamp_ns = parsing.parse_stamp_ns(timestamp, frame.where)
        if stamp_ns in detections:
            raise DatasetError(f'{frame.where}: timestamp {timestamp} is repeated')
        boxes, class_ids, scores = [], [], []
        for number, detection in enumerate(frame.entries('detections')):
            fields = parsing.Fields(detection, f'{frame.where}, detection {number}')
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
