# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Input and result of a reader of a layout: images in the order of time, with their poses."""

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
# Images without stamps are photos as often as a video: so slow that no pose seems to jump.
_INVENTED_STEP_NS = NS_PER_S
# Files write their rotations with a few digits.
_ROTATION_TOLERANCE = 1e-2
_AS_USUAL = DepthFormat()


@dataclass(frozen=True)
class FolderOptions:
    """Settings that a folder does not hold itself."""

    intrinsics: str | None = None  #: Name of a preset, or a camera.json; None: the folder's own
    trajectory: TimedPoses | None = None  #: Poses instead of the folder's own
    max_gap_ns: int = 0  #: Greatest gap between two poses to interpolate over [ns]
    #: (4, 4): mount of the camera on the body of the poses
    body_from_camera: NDArray[np.float64] | None = None
    depth: DepthFormat = _AS_USUAL  #: Differences from the folder's usual format
    layout: str = ''  #: Key of one of LAYOUTS; '': recognized by its files
    images: Path | None = None  #: Folder of the images of colmap and nerf
    axes: str | None = None  #: Convention of the stored poses, one of AXES; None: by the layout
    scale: float | None = None  #: Metres of a stored unit
    #: Two images, and the distance between their cameras [m]: another way to give the scale
    known_distance: tuple[str, str, float] | None = None
    any_unit: bool = False  #: Accept an unknown unit as the metre
    level: bool = False  #: Turn the map so that z is up, by the tilt of the cameras
    #: A pose or depth image of TUM RGB-D belongs to an image at most this far away [ns]
    tolerance_ns: int = STAMP_TOLERANCE_NS


@dataclass(frozen=True)
class Capture:
    """Images in the order of time, with the poses that are stored for them."""

    files: tuple[ImageFile, ...]
    axes: str = 'opencv'  #: Convention of the stored poses: one of placing.AXES
    depth: DepthFormat = _AS_USUAL
    #: Axis of the poses' coordinate frame that points up by the definition of the layout: 'y' or
    #: 'z'; '' if it defines none
    up: str = ''
    is_metric: bool = True  #: Whether the unit is the metre by the definition of the layout
    notes: tuple[str, ...] = ()
    images: int = 0  #: How many there are, where more than the files have no pose
    #: What the poses were looked up in: it must have some, of the time of the images. Images
    #: alone may do without
    trajectory: TimedPoses | None = None

    @classmethod
    def of(cls, files: Sequence[ImageFile], where: object, axes: str,
           depth: DepthFormat = _AS_USUAL, up: str = '', is_metric: bool = True,
           notes: Sequence[str] = (), images: int = 0) -> 'Capture':
        """Return the capture of the images that a list names, see arrange.

        Notes say which of them and of their depth images are missing.
        """
        arranged = arrange(files, where)
        missing = [[file.color for file in files if beside(file.color) is None],
                   [file.depth for file in files if file.depth is not None
                    and beside(file.depth) is None]]
        left_out = [f'{len(paths)} of {len(files)} {what} that are listed are missing, such as '
                    f'{paths[0]}' for what, paths in zip(('images', 'depth images'), missing,
                                                         strict=True) if paths]
        return cls(tuple(one if one.depth is None else one._replace(depth=beside(one.depth))
                         for one in arranged), axes, depth, up, is_metric,
                   (*notes, *left_out), images)


def arrange(files: Sequence[ImageFile], where: object) -> tuple[ImageFile, ...]:
    """Return images in the order of time, with rigid poses.

    Without stamps, images are in the order of their names, numbers in them by value. Images whose
    file is missing are left out.

    Raises
    ------
    DatasetError
        No image is there or has a pose, two are one file, or a pose is not a rigid transform.
    """
    present = [file for file in files if beside(file.color) is not None]
    if not present:
        raise DatasetError(f'{where}: none of {len(files)} images is there' + (
            f', such as {files[0].color}; give the folder of the images with `images`'
            if files else ''))
    counts = Counter((one.color, one.number) for one in present)
    (first, _), count = counts.most_common(1)[0]
    if count > 1:
        raise DatasetError(f'{where}: lists the image {first.name} twice')
    stamps = {one.stamp_ns for one in present}
    if NO_STAMP in stamps or len(stamps) < len(present):
        present.sort(key=lambda one: re.sub(
            '[0-9]+', lambda number: number[0].zfill(20), str(one.color)))
        times = [place * _INVENTED_STEP_NS for place in range(len(present))]
    else:
        present.sort(key=lambda one: one.stamp_ns)
        times = [one.stamp_ns for one in present]
        if times[0] < 0 or times[-1] > MAX_STAMP_S * NS_PER_S:
            times = [time - times[0] for time in times]
    if times[-1] > MAX_STAMP_S * NS_PER_S:
        raise DatasetError(f'{where}: its stamps span {times[-1] / NS_PER_S:.3g} s')
    arranged = tuple(
        one._replace(stamp_ns=time, pose=_sound(one.pose, f'{where}: pose of {one.color.name}'))
        for time, one in zip(times, present, strict=True))
    if all(one.pose is None for one in arranged):
        raise DatasetError(f'{where}: none of {len(present)} images has a pose')
    return arranged


def _sound(pose: NDArray[np.float64] | None, where: str) -> NDArray[np.float64] | None:
    """Return a rigid pose (4, 4); None where tracking was lost."""
    if pose is None or not np.isfinite(pose).all():
        return None
    if not is_rigid(pose, _ROTATION_TOLERANCE):
        is_mirrored = is_rigid(pose @ np.diag([1.0, 1.0, -1.0, 1.0]), _ROTATION_TOLERANCE)
        raise DatasetError(f'{where} is not a rotation and translation' + (
            ': it is a reflection; export with right-handed axes'
            if is_mirrored else ': its axes have no unit length or are not at right angles'))
    left, _, right = np.linalg.svd(pose[:3, :3])
    sound = pose.copy()
    sound[:3, :3] = left @ right
    return sound


def first_image(folder: Path, stem: str) -> Path | None:
    """Return the image of a name without its ending; None if there is none."""
    return next((found for end in IMAGES if (found := beside(folder / f'{stem}{end}'))), None)


def size_of_image(path: Path) -> tuple[int, int] | None:
    """Return width and height of an image [px]; None if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else (image.shape[1], image.shape[0])


def beside(path: Path) -> Path | None:
    """Return a file; None if it is missing, or no name of a file."""
    try:
        return path if path.is_file() else None
    except OSError:  # too long
        return None
