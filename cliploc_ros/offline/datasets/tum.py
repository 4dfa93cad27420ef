# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read TUM RGB-D folders (Sturm et al. 2012): rgb.txt, rgb/, groundtruth.txt."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import parsing
from cliploc_ros.offline.datasets.poses import TimedPoses

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
    stamps_ns, rows = read_stamped(Path(path), 'tx ty tz qx qy qz qw')
    return TimedPoses.from_samples(stamps_ns, rows, str(path), _MAX_NORM_ERROR)


def read_tum_accelerometer(path: str | Path) -> tuple[list[int], NDArray[np.float64]]:
    """Return the stamps [ns] and accelerations (n, 3) [m/s^2] of an accelerometer.txt.

    DatasetError: a line does not hold four numbers; the message names file and line.
    """
    stamps_ns, rows = read_stamped(Path(path), 'ax ay az')
    return stamps_ns, np.array(rows).reshape(-1, 3)


def read_stamped(path: Path, names: str) -> tuple[list[int], list[list[float]]]:
    """Return the stamps [ns] and the named numbers of the lines of a file.

    DatasetError: a line holds others, numbers that are not finite, or a quaternion, as the last
    four of seven, that is far from unit norm; the message names file and line.
    """
    stamps_ns, rows = [], []
    for where, (stamp, *cells) in parsing.read_cells(path, f'timestamp {names}'):
        stamps_ns.append(parsing.parse_stamp_ns(stamp, where))
        rows.append(parsing.parse_all(cells, float, where))
        if not np.all(np.isfinite(rows[-1])):
            raise DatasetError(f'{where}: {" ".join(cells)!r} is not finite')
        if len(cells) == 7:
            parsing.unit_quaternion(rows[-1][3:], where, _MAX_NORM_ERROR)
    return stamps_ns, rows


def read_image_list(path: Path) -> tuple[tuple[int, ...], tuple[Path, ...]]:
    """Return the stamps [ns] and files that a list such as rgb.txt names.

    DatasetError: the message names the file and line that cannot be used.
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
            raise DatasetError(f'{where}: timestamp {stamp} does not exceed the one before')
        if not image_path.is_file():
            raise DatasetError(f'{where}: image {image_path} does not exist')
        image_paths.append(image_path)
    if not stamps_ns:
        raise DatasetError(f'{path}: lists no images')
    return tuple(stamps_ns), tuple(image_paths)
