# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert stored poses to poses in a map: camera axes, unit and vertical.

The images reveal a wrong choice of axes, see agreement.
"""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import move_poses
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.agreement import (
    AXES,
    Reading,
    View,
    check_agreement,
    w_first,
)
from cliploc_ros.offline.datasets.frames import ImageFile, read_color

_Pose = NDArray[np.float64]
#: Rotations into a coordinate frame with z up, by the axis that points up.
UP: Mapping[str, _Pose] = {
    'z': np.eye(3), 'y': np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}

# Greatest coordinate of a pose in a map [m].
_MOST_M = 1e7
# Number of images whose EXIF orientation is checked.
_TRIED = 3


def place_images(files: Sequence[ImageFile], axes: str, scale: float = 1.0,
                 map_from_stored: _Pose = UP['z']) -> tuple[ImageFile, ...]:
    """Replace the stored poses of images by map_from_camera.

    Parameters
    ----------
    axes : str
        One of AXES.
    scale : float
        Metres per stored unit.
    map_from_stored : ndarray (3, 3)

    Raises
    ------
    DatasetError
        A pose is too far from the origin; the message names its image.
    """
    placed = tuple(file if file.pose is None else file._replace(pose=move_poses(
        np.array(AXES[axes](file.pose))[None], scale, map_from_stored)[0]) for file in files)
    for file in placed:
        if file.pose is not None and (far := np.abs(file.pose[:3, 3]).max()) > _MOST_M:
            raise DatasetError(f'pose of {file.color} is {far:.3g} m from the origin')
    return placed


def find_scale(files: Sequence[ImageFile], first: str, second: str, metres: float, where: object
               ) -> float:
    """Compute the metres per unit of the poses from the distance between two cameras [m].

    `first` and `second` are the names of the two images. DatasetError: an image is unknown, or
    both were taken at the same place.
    """
    places = []
    for name in (first, second):
        found = [file.pose[:3, 3] for file in files
                 if file.pose is not None and str(file.color).endswith(f'/{name}')]
        if len(found) != 1:
            posed = [file for file in files if file.pose is not None]
            shown = ', '.join(file.color.name for file in posed[:3])
            raise DatasetError(f'{where}: {len(found) or "no"} images with a pose are named {name}'
                               f'; the first images are {shown}')
        places.append(found[0])
    distance = float(np.linalg.norm(places[1] - places[0]))
    if distance < 1e-6:
        raise DatasetError(f'{where}: {first} and {second} were taken at the same place; name two '
                           'images at a known distance')
    return metres / distance


def check_axes(files: Sequence[ImageFile], axes: str, where: object) -> str:
    """Return a note if images and stored poses do not fit; see check_agreement.

    DatasetError: they fit well under another convention; the message names it.
    """
    readings = {name: Reading(f'give `axes` {name}', AXES[name])
                for name in sorted(AXES, key=lambda name: name != axes)}
    readings['quaternions w x y z'] = Reading(
        'name the columns in the first line, such as `# timestamp tx ty tz qw qx qy qz`',
        lambda pose: AXES[axes](w_first(pose)))
    stored = [file for file in files if file.number is None][::max(1, len(files) // _TRIED)]
    has_orientation = any(not np.array_equal(read_color(file)[0], read_color(file, True)[0])
                          for file in stored)
    if has_orientation:
        readings['turned by EXIF'] = Reading(
            'rotate the pixels, for example with mogrify -auto-orient', AXES[axes], upright=True)
    note = check_agreement([View(file.pose, partial(read_color, file)) for file in files],
                           readings, where)
    return note or ('the EXIF orientation of the images is ignored: poses and intrinsics must '
                    'refer to the stored pixels' if has_orientation else '')
