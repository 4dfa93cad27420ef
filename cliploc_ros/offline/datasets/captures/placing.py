# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From stored poses to poses in a map: camera axes, unit and vertical.

A wrong choice of axes is found by the images, see agreement.
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
#: Rotations that turn an axis up.
UP: Mapping[str, _Pose] = {
    'z': np.eye(3), 'y': np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}

# A map reaches no further [m].
_MOST_M = 1e7
# Images that are asked for their EXIF orientation.
_TRIED = 3


def place_images(files: Sequence[ImageFile], axes: str, scale: float = 1.0,
                 map_from_stored: _Pose = UP['z']) -> tuple[ImageFile, ...]:
    """Return images with poses map_from_camera in place of the stored poses.

    Parameters
    ----------
    axes : str
        One of AXES.
    scale : float
        Metres of a stored unit.
    map_from_stored : ndarray (3, 3)

    Raises
    ------
    DatasetError
        A pose is too far from the origin; names its image.
    """
    placed = tuple(file if file.pose is None else file._replace(pose=move_poses(
        np.array(AXES[axes](file.pose))[None], scale, map_from_stored)[0]) for file in files)
    for one in placed:
        if one.pose is not None and (far := np.abs(one.pose[:3, 3]).max()) > _MOST_M:
            raise DatasetError(f'pose of {one.color} is {far:.3g} m from the origin')
    return placed


def find_scale(files: Sequence[ImageFile], first: str, second: str, metres: float, where: object
               ) -> float:
    """Return metres of a unit of the poses, by the distance between the cameras of two images [m].

    DatasetError: an image is unknown, or both were taken at one place.
    """
    places = []
    for name in (first, second):
        found = [file.pose[:3, 3] for file in files
                 if file.pose is not None and str(file.color).endswith(f'/{name}')]
        if len(found) != 1:
            posed = [file for file in files if file.pose is not None]
            shown = ', '.join(one.color.name for one in posed[:3])
            raise DatasetError(f'{where}: {len(found) or "no"} images with a pose are named {name}'
                               f'; there are {shown} and so on')
        places.append(found[0])
    distance = float(np.linalg.norm(places[1] - places[0]))
    if distance < 1e-6:
        raise DatasetError(f'{where}: {first} and {second} were taken at one place; name two '
                           'images at a distance that you know')
    return metres / distance


def check_axes(files: Sequence[ImageFile], axes: str, where: object) -> str:
    """Return a note where images and stored poses do not fit; '' if they do, or do not tell.

    DatasetError: they fit well if read in another way; says which.
    """
    readings = {name: Reading(f'give `axes` {name}', AXES[name])
                for name in sorted(AXES, key=lambda name: name != axes)}
    readings['quaternions w x y z'] = Reading(
        'name the columns in the first line, as `# timestamp tx ty tz qw qx qy qz`',
        lambda pose: AXES[axes](w_first(pose)))
    stored = [file for file in files if file.number is None][::max(1, len(files) // _TRIED)]
    ask_to_turn = any(not np.array_equal(read_color(one)[0], read_color(one, True)[0])
                      for one in stored)
    if ask_to_turn:
        readings['turned by EXIF'] = Reading(
            'turn the pixels, as with mogrify -auto-orient', AXES[axes], upright=True)
    note = check_agreement([View(file.pose, partial(read_color, file)) for file in files],
                           readings, where)
    return note or ('images ask by EXIF to be turned, and are read as stored: poses and '
                    'intrinsics must be of stored pixels' if ask_to_turn else '')
