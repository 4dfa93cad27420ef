# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read TUM RGB-D folders (Sturm et al. 2012): rgb.txt, rgb/, groundtruth.txt."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.poses import TimedPoses
from cliploc_ros.units import NS_PER_S

#: builtin_interfaces/Time holds seconds in an int32.
MAX_STAMP_S = 2**31 - 1
# Files of the dataset round their quaternions to four decimals.
_MAX_NORM_ERROR = 0.05


@dataclass(frozen=True)
class TumSequence:
    """A TUM RGB-D folder: colour images with stamps, and the camera's trajectory."""

    folder: Path
    #: Stamp of each image [ns], exact to the last decimal, strictly increasing
    stamps_ns: tuple[int, ...]
    image_paths: tuple[Path, ...]  #: The existing image file of each stamp
    #: Ground truth, map from camera; empty if the folder has no groundtruth.txt
    trajectory: TimedPoses

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.stamps_ns)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp; None without a sample within 20 ms."""
        return self.trajectory.pose_at(stamp_ns)

    def every(self, step: int) -> 'TumSequence':
        """Return the sequence with every ``step``-th image only, beginning with the first.

        DatasetError: the step is less than 1.
        """
        if step < 1:
            raise DatasetError(f'every {step}th image is no selection: give 1 or more')
        return replace(
            self, stamps_ns=self.stamps_ns[::step], image_paths=self.image_paths[::step])


def read_tum(folder: str | Path) -> TumSequence:
    """Read a TUM RGB-D folder, except for the pixels of its images.

    It holds ``rgb.txt``, the images that this lists, and optionally ``groundtruth.txt``.
    DatasetError: the message names the file and the line that is invalid.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f'{folder}: no such folder')
    truth = folder / 'groundtruth.txt'
    trajectory = (read_tum_trajectory(truth) if truth.exists()
                  else TimedPoses.from_samples([], [], str(folder)))
    return TumSequence(folder, *read_image_list(folder / 'rgb.txt'), trajectory)


def read_tum_trajectory(path: str | Path) -> TimedPoses:
    """Read a trajectory in TUM format: ``timestamp tx ty tz qx qy qz qw`` a line.

    Lines may have any order; of equal stamps the first counts. ``#`` begins a comment.
    DatasetError: a line does not hold eight numbers, or its quaternion is far from unit norm; the
    message names file and line.
    """
    samples: dict[int, list[float]] = {}
    for where, stamp_ns, values in _stamped_numbers(Path(path), 'tx ty tz qx qy qz qw'):
        norm = math.hypot(*values[3:])
        if abs(norm - 1) > _MAX_NORM_ERROR:
            raise DatasetError(f'{where}: quaternion qx qy qz qw has norm {norm:.3f}, not 1')
        samples.setdefault(stamp_ns, values)
    stamps = sorted(samples)
    rows = np.array([samples[stamp] for stamp in stamps]).reshape(-1, 7)
    quats_xyzw = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return TimedPoses(np.array(stamps, dtype=np.int64), rows[:, :3], quats_xyzw)


def read_tum_accelerometer(path: str | Path) -> tuple[list[int], NDArray[np.float64]]:
    """Return the stamps [ns] and accelerations (n, 3) [m/s^2] of an accelerometer.txt.

    DatasetError: a line does not hold four numbers; the message names file and line.
    """
    samples = [(stamp_ns, values) for _, stamp_ns, values in _stamped_numbers(
        Path(path), 'ax ay az')]
    return ([stamp_ns for stamp_ns, _ in samples],
            np.array([values for _, values in samples]).reshape(-1, 3))


def _stamped_numbers(path: Path, names: str) -> Iterator[tuple[str, int, list[float]]]:
    """Yield 'file:line', the stamp [ns] and the named numbers of each line."""
    count = 1 + len(names.split())
    for where, line in _data_lines(path):
        fields = line.replace(',', ' ').split()
        if len(fields) != count:
            raise DatasetError(f'{where}: expected timestamp {names}, got {len(fields)} fields')
        shown = f'{" ".join(fields[1:])!r}'
        try:
            values = [float(field) for field in fields[1:]]
        except ValueError:
            raise DatasetError(f'{where}: {shown} is not {names}') from None
        if not np.all(np.isfinite(values)):
            raise DatasetError(f'{where}: {shown} is not finite')
        yield where, parse_stamp_ns(fields[0], where), values


def parse_stamp_ns(text: str, where: str) -> int:
    """Convert decimal seconds to nanoseconds exactly, without a float.

    DatasetError: the text is no number, or outside the range of a ROS time.

    Parameters
    ----------
    text : str
        Seconds, as ``1341847980.722988`` or ``1.341847980722988e9``.
    where : str
        File and line, for the message.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DatasetError(f'{where}: {text!r} is no timestamp in seconds') from None
    if not seconds.is_finite() or not 0 <= seconds <= MAX_STAMP_S:
        raise DatasetError(f'{where}: timestamp {text} is outside 0 to {MAX_STAMP_S} s')
    return int((seconds * NS_PER_S).to_integral_value())


def read_image_list(path: Path) -> tuple[tuple[int, ...], tuple[Path, ...]]:
    """Return the stamps [ns] and files that a list such as rgb.txt names.

    DatasetError: the message names the file and line that cannot be used.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such file; a TUM folder lists its images in rgb.txt')
    stamps_ns: list[int] = []
    image_paths: list[Path] = []
    for where, line in _data_lines(path):
        fields = line.split(maxsplit=1)
        if len(fields) != 2:
            raise DatasetError(f'{where}: expected timestamp and file name, got {line!r}')
        stamp_ns = parse_stamp_ns(fields[0], where)
        if stamps_ns and stamp_ns <= stamps_ns[-1]:
            raise DatasetError(f'{where}: timestamp {fields[0]} does not exceed the one before')
        image_path = path.parent / fields[1]
        if not image_path.is_file():
            raise DatasetError(f'{where}: image {image_path} does not exist')
        stamps_ns.append(stamp_ns)
        image_paths.append(image_path)
    if not stamps_ns:
        raise DatasetError(f'{path}: lists no images')
    return tuple(stamps_ns), tuple(image_paths)


def _data_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield 'file:line' and the text of each line that is neither blank nor a comment."""
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from error
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith('#'):
            yield f'{path}:{number}', stripped
