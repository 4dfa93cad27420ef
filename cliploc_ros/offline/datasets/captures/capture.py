# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the reader of each layout returns: images in the order of time, with cameras and poses."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import is_rigid, transform_from_pose
from cliploc_ros.errors import CameraError, DatasetError
from cliploc_ros.offline.datasets.frames import DepthFormat, ImageFile
from cliploc_ros.offline.datasets.poses import Poses
from cliploc_ros.offline.datasets.tum import MAX_STAMP_S
from cliploc_ros.units import NS_PER_S

#: Endings of image files.
IMAGES = ('.jpg', '.jpeg', '.png')
# Images without stamps are photos as often as a video: so slow that no pose seems to jump.
_INVENTED_STEP_NS = NS_PER_S
# Files write their rotations with a few digits.
_ROTATION_TOLERANCE = 1e-2
_MOST_M = 1e6
_NO_FORM = DepthFormat()


class Shot(NamedTuple):
    """An image as a layout names it."""

    color: Path
    camera: Camera
    pose: NDArray[np.float64] | None  #: (4, 4) as stored; None or not finite where unknown
    stamp_ns: int | None = None
    depth: Path | None = None
    confidence: Path | None = None
    number: int | None = None  #: In a video


@dataclass(frozen=True)
class Capture:
    """Images in the order of time, and the poses that are stored with them."""

    files: tuple[ImageFile, ...]
    poses: Poses  #: As stored, see axes
    axes: str = 'opencv'  #: What a stored pose is: one of placing.AXES
    depth: DepthFormat = _NO_FORM
    #: Axis of the poses' coordinate frame that points up by the definition of the layout: 'y' or
    #: 'z'; '' where it defines none
    up: str = ''
    is_metric: bool = True  #: Whether the unit is the metre by the definition of the layout
    notes: tuple[str, ...] = ()
    images: int = 0  #: How many there are, where more than the files have no pose


@dataclass(frozen=True)
class StampedPoses:
    """Poses of the images themselves, which need no interpolation."""

    poses: dict[int, NDArray[np.float64]]

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp with a pose [ns]."""
        return (min(self.poses), max(self.poses)) if self.poses else None

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return the pose of the image of a stamp [ns]."""
        return self.poses.get(stamp_ns)


def arrange(shots: Sequence[Shot], where: str) -> tuple[tuple[ImageFile, ...], StampedPoses]:
    """Return images in the order of time, and their poses.

    Without stamps, images are in the order of their names, numbers in them by value. Images whose
    file is missing are left out.

    Raises
    ------
    DatasetError
        No image is there or has a pose, two are one file, or a pose is no rigid transform.
    """
    present = [one for one in shots if beside(one.color) is not None]
    if not present:
        raise DatasetError(f'{where}: none of {len(shots)} images is there' + (
            f', such as {shots[0].color}; give the folder of the images with `images`'
            if shots else ''))
    seen: set[tuple[Path, int | None]] = set()
    for one in present:
        if (one.color, one.number) in seen:
            raise DatasetError(f'{where}: lists the image {one.color.name} twice')
        seen.add((one.color, one.number))
    stamps = {one.stamp_ns for one in present}
    if None in stamps or len(stamps) < len(present):
        present.sort(key=lambda one: re.sub(
            '[0-9]+', lambda number: number[0].zfill(20), str(one.color)))
        times = [place * _INVENTED_STEP_NS for place in range(len(present))]
    else:
        present.sort(key=lambda one: one.stamp_ns or 0)
        times = [one.stamp_ns or 0 for one in present]
        if times[0] < 0 or times[-1] > MAX_STAMP_S * NS_PER_S:
            times = [time - times[0] for time in times]
    if times[-1] > MAX_STAMP_S * NS_PER_S:
        raise DatasetError(f'{where}: its stamps span {times[-1] / NS_PER_S:.3g} s')
    poses = {stamp: pose for stamp, one in zip(times, present, strict=True)
             if (pose := _sound(one.pose, f'{where}: pose of {one.color.name}')) is not None}
    if not poses:
        raise DatasetError(f'{where}: none of {len(present)} images has a pose')
    return tuple(ImageFile(stamp, one.color, one.camera, one.depth, one.confidence, one.number)
                 for stamp, one in zip(times, present, strict=True)), StampedPoses(poses)


def _sound(pose: NDArray[np.float64] | None, where: str) -> NDArray[np.float64] | None:
    """Return a rigid pose (4, 4); None where tracking was lost."""
    if pose is None or not np.isfinite(pose).all():
        return None
    if not is_rigid(pose, _ROTATION_TOLERANCE):
        is_mirrored = is_rigid(pose @ np.diag([1.0, 1.0, -1.0, 1.0]), _ROTATION_TOLERANCE)
        raise DatasetError(f'{where} is no rotation and translation' + (
            ': it is a reflection; export with right-handed axes'
            if is_mirrored else ': its axes have no unit length or are not at right angles'))
    if np.abs(pose[:3, 3]).max() > _MOST_M:
        raise DatasetError(f'{where} is {np.abs(pose[:3, 3]).max():.3g} m from the origin')
    left, _, right = np.linalg.svd(pose[:3, :3])
    sound = pose.copy()
    sound[:3, :3] = left @ right
    return sound


def pose_of(position: Sequence[float], quat_xyzw: Sequence[float], where: str
            ) -> NDArray[np.float64] | None:
    """Return the transform (4, 4) of a position and a quaternion; None where they are not finite.

    DatasetError: the quaternion is far from unit.
    """
    if not np.isfinite([*position, *quat_xyzw]).all():
        return None
    if abs(math.hypot(*quat_xyzw) - 1.0) > _ROTATION_TOLERANCE:
        raise DatasetError(f'{where}: the quaternion {list(quat_xyzw)} has no unit length')
    return transform_from_pose(np.array(position), np.array(quat_xyzw))


def camera_of(where: str, *values: Any) -> Camera:
    """Return a camera; DatasetError: no camera can have these values."""
    try:
        return Camera(*values)
    except CameraError as error:
        raise DatasetError(f'{where}: {error}') from error


def beside(path: Path) -> Path | None:
    """Return a file; None where it is missing, or no name of a file."""
    try:
        return path if path.is_file() else None
    except OSError:  # too long
        return None


def read_text(path: Path) -> str:
    """Return the text of a file; DatasetError: it cannot be read."""
    try:
        return path.read_text(encoding='utf-8')
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from error


def read_rows(path: Path, columns: int, separator: str | None = None, header: int = 0
              ) -> list[list[float]]:
    """Return the rows of numbers of a table; DatasetError: one has too few, or no numbers."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines()[header:], start=header + 1):
        try:
            row = [float(cell) for cell in line.split(separator)] if line.strip() else None
        except ValueError:
            row = []
        if row is not None and len(row) < columns:
            raise DatasetError(f'{path}:{number}: expected {columns} numbers, got {line[:60]!r}')
        if row is not None:
            rows.append(row)
    return rows


class Fields:
    """A JSON mapping whose fields are checked as they are read."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise DatasetError(f'{where}: expected a mapping, got {str(values)[:40]!r}')
        self.values: dict[str, Any] = values
        self.where = where

    @classmethod
    def of_file(cls, path: Path) -> 'Fields':
        """Return the mapping that a file holds."""
        try:
            return cls(json.loads(read_text(path)), str(path))
        except (ValueError, RecursionError) as error:
            raise DatasetError(f'{path}: cannot be read as JSON: {error}') from error

    def __contains__(self, name: str) -> bool:
        """Return whether a field is there."""
        return name in self.values

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number; DatasetError: it is missing without a default, or is none."""
        return float(self.numbers(name, (), default))

    def numbers(self, name: str, shape: tuple[int, ...], default: Any = None
                ) -> NDArray[np.float64]:
        """Return finite numbers; a length of -1 is any. DatasetError: they are others."""
        value = self.values.get(name, default)
        if value is None:
            raise DatasetError(f'{self.where}: field {name!r} is missing')
        try:
            found = np.array(value)
            if found.size and found.dtype.kind not in 'iuf':
                raise ValueError
            found = found.astype(np.float64)
        except (ValueError, OverflowError, TypeError):
            found = np.array([np.nan])
        fits = len(found.shape) == len(shape) and all(
            length in (-1, there) for length, there in zip(shape, found.shape, strict=True))
        if not fits or not np.isfinite(found).all():
            raise DatasetError(f'{self.where}: {name} is {str(value)[:60]}, not ' + (
                f'numbers of shape {shape}' if shape else 'a finite number'))
        return found

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text."""
        value = self.values.get(name, default)
        if not isinstance(value, str):
            raise DatasetError(f'{self.where}: field {name!r} ' + (
                'is missing' if value is None else f'is {str(value)[:40]!r}, not a text'))
        return value

    def size(self, width: str, height: str) -> tuple[int, int]:
        """Return width and height [px]."""
        return round(self.number(width)), round(self.number(height))
