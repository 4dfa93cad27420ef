# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options and result of the readers of layouts: images in order of time, with their poses."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.frames import NO_STAMP, DepthFormat, ImageFile
from cliploc_ros.offline.datasets.parsing import MAX_STAMP_S
from cliploc_ros.offline.datasets.poses import STAMP_TOLERANCE_NS, TimedPoses
from cliploc_ros.units import NS_PER_S

#: Endings of image files.
IMAGES = ('.jpg', '.jpeg', '.png')
# Step between images without stamps. They may be separate photos: at this step, no motion between
# two of them looks like a jump of the poses.
_INVENTED_STEP_NS = NS_PER_S
# Files store rotations with few digits.
_ROTATION_TOLERANCE = 1e-2
_AS_USUAL = DepthFormat()


@dataclass(frozen=True)
class FolderOptions:
    """Settings for reading a folder that its files do not contain."""

    intrinsics: str | None = None  #: Name of a preset, or a camera.json; None: those of the folder
    trajectory: TimedPoses | None = None  #: Poses to use instead of those of the folder
    max_gap_ns: int = 0  #: Greatest gap between two poses to interpolate over [ns]
    #: (4, 4): mount of the camera on the body of the poses
    body_from_camera: NDArray[np.float64] | None = None
    depth: DepthFormat = _AS_USUAL  #: Differences from the folder's usual format
    layout: str = ''  #: Key of one of LAYOUTS; '': recognized by its files
    images: Path | None = None  #: Folder of the images, for colmap and nerf
    #: Convention of the stored poses, one of AXES; None: that of the layout
    axes: str | None = None
    scale: float | None = None  #: Metres per stored unit
    #: Two images and the distance between their cameras [m], to compute the scale
    known_distance: tuple[str, str, float] | None = None
    any_unit: bool = False  #: Whether to read an unknown unit as metres
    level: bool = False  #: Whether to rotate the map until z is up, by the tilt of the cameras
    #: Greatest difference between the stamps of a TUM RGB-D image and its pose or depth image [ns]
    tolerance_ns: int = STAMP_TOLERANCE_NS


@dataclass(frozen=True)
class Capture:
    """Images in order of time, with their poses as stored."""

    files: tuple[ImageFile, ...]
    axes: str = 'opencv'  #: Convention of the stored poses: one of agreement.AXES
    depth: DepthFormat = _AS_USUAL
    #: Axis of the poses' coordinate frame that the layout defines as up: 'y' or 'z'; '' if it
    #: defines none
    up: str = ''
    is_metric: bool = True  #: Whether the layout defines the metre as its unit
    notes: tuple[str, ...] = ()
    images: int = 0  #: Number of images, if it exceeds that of the files; the others have no pose
    #: The trajectory that the poses were interpolated from, if any. It must overlap the images in
    #: time, even where single images have no pose
    trajectory: TimedPoses | None = None

    @classmethod
    def of(cls, files: Sequence[ImageFile], where: object, axes: str,
           depth: DepthFormat = _AS_USUAL, up: str = '', is_metric: bool = True,
           notes: Sequence[str] = (), images: int = 0) -> 'Capture':
        """Make a capture of listed images, see arrange.

        Its notes count the listed images and depth images that are missing.
        """
        arranged = arrange(files, where)
        missing = [[file.color for file in files if beside(file.color) is None],
                   [file.depth for file in files if file.depth is not None
                    and beside(file.depth) is None]]
        left_out = [f'{len(paths)} of {len(files)} listed {what} are missing, such as {paths[0]}'
                    for what, paths in zip(('images', 'depth images'), missing, strict=True)
                    if paths]
        return cls(tuple(file if file.depth is None else file._replace(depth=beside(file.depth))
                         for file in arranged), axes, depth, up, is_metric,
                   (*notes, *left_out), images)


def arrange(files: Sequence[ImageFile], where: object) -> tuple[ImageFile, ...]:
    """Sort images by time, and make their poses rigid.

    Images without stamps are sorted by name, with numbers in names by value. Images whose file is
    missing are left out.

    Raises
    ------
    DatasetError
        No image exists or has a pose, an image is listed twice, or a pose is not rigid.
    """
    present = [file for file in files if beside(file.color) is not None]
    if not present:
        raise DatasetError(f'{where}: none of {len(files)} images exists' + (
            f', such as {files[0].color}; give the folder of the images with `images`'
            if files else ''))
    counts = Counter((file.color, file.number) for file in present)
    (first, _), count = counts.most_common(1)[0]
    if count > 1:
        raise DatasetError(f'{where}: lists the image {first.name} twice')
    stamps = {file.stamp_ns for file in present}
    if NO_STAMP in stamps or len(stamps) < len(present):
        present.sort(key=lambda file: re.sub(
            '[0-9]+', lambda number: number[0].zfill(20), str(file.color)))
        times = [place * _INVENTED_STEP_NS for place in range(len(present))]
    else:
        present.sort(key=lambda file: file.stamp_ns)
        times = [file.stamp_ns for file in present]
        if times[0] < 0 or times[-1] > MAX_STAMP_S * NS_PER_S:
            times = [time - times[0] for time in times]
    if times[-1] > MAX_STAMP_S * NS_PER_S:
        raise DatasetError(f'{where}: its stamps span {times[-1] / NS_PER_S:.3g} s')
    arranged = tuple(
        file._replace(stamp_ns=time, pose=_sound(file.pose, f'{where}: pose of {file.color.name}'))
        for time, file in zip(times, present, strict=True))
    if all(file.pose is None for file in arranged):
        raise DatasetError(f'{where}: none of {len(present)} images has a pose')
    return arranged


def _sound(pose: NDArray[np.float64] | None, where: str) -> NDArray[np.float64] | None:
    """Return the nearest rigid pose (4, 4); None where tracking was lost."""
    if pose is None or not np.isfinite(pose).all():
        return None
    if not is_rigid(pose, _ROTATION_TOLERANCE):
        is_mirrored = is_rigid(pose @ np.diag([1.0, 1.0, -1.0, 1.0]), _ROTATION_TOLERANCE)
        raise DatasetError(f'{where} is not a rotation and translation' + (
            ': it is a reflection; export with right-handed axes'
            if is_mirrored else ': its axes are not of unit length or not orthogonal'))
    left, _, right = np.linalg.svd(pose[:3, :3])
    sound = pose.copy()
    sound[:3, :3] = left @ right
    return sound


def first_image(folder: Path, stem: str) -> Path | None:
    """Find the image file with a stem and an ending in IMAGES; None if there is none."""
    return next((found for end in IMAGES if (found := beside(folder / f'{stem}{end}'))), None)


def size_of_image(path: Path) -> tuple[int, int] | None:
    """Return width and height of an image file [px]; None if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else (image.shape[1], image.shape[0])


def beside(path: Path) -> Path | None:
    """Return the path of a file if it exists; None if it is missing or not a valid file name."""
    try:
        return path if path.is_file() else None
    except OSError:  # too long
        return None
