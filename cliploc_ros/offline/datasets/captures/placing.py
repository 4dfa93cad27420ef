# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From stored poses to poses in a map: camera axes, unit and vertical.

A wrong choice of axes is found by the images: what two of them both show lies on epipolar lines.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    move_poses,
    rotation_angle_deg,
)
from cliploc_ros.core.keyframes.features import Features, extract, match, unit_rows
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.frames import ImageFile, read_color

_Pose = NDArray[np.float64]
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: What a stored pose may be, and map_from_camera of OpenCV's axes from it.
AXES: Mapping[str, Callable[[_Pose], _Pose]] = {
    'opencv': lambda pose: pose,
    'opengl': lambda pose: pose @ _FLIP,
    'opencv-inverse': invert_transform,
    'opengl-inverse': lambda pose: invert_transform(pose) @ _FLIP}
#: Rotations that turn an axis up.
UP: Mapping[str, _Pose] = {
    'z': np.eye(3), 'y': np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}

# A map reaches no further [m].
_MOST_M = 1e7
# Pairs of images that tell the axes: with this much of a turn, which an error of axes turns round.
_PAIRS, _TRIED, _REACH = 4, 12, 20
_TURN_DEG = (4.0, 30.0)
_FEATURES, _LONGEST_PX = 500, 480
_LEAST_MATCHES = 25
# Median epipolar errors at an image _LONGEST_PX wide [px]: a true choice has 0.3 to 2 of them.
_GOOD_PX, _WRONG_PX, _BETTER = 3.0, 4.0, 0.35


def place_images(files: Sequence[ImageFile], axes: str, scale: float = 1.0,
                 map_from_stored: _Pose = UP['z']) -> tuple[ImageFile, ...]:
    """Return images with poses map_from_camera instead of stored ones.

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
    for one in files:
        if one.pose is not None and (far := np.abs(one.pose[:3, 3]).max()) > _MOST_M:
            raise DatasetError(f'pose of {one.color} is {far:.3g} m from the origin')
    return tuple(one if one.pose is None else one._replace(pose=move_poses(
        np.array(AXES[axes](one.pose))[None], scale, map_from_stored)[0]) for one in files)


def find_scale(files: Sequence[ImageFile], first: str, second: str, metres: float, where: object
               ) -> float:
    """Return metres of a unit of the poses, by the distance between the cameras of two images [m].

    DatasetError: an image is unknown, or both were taken at one place.
    """
    places = []
    for name in (first, second):
        found = [one.pose[:3, 3] for one in files
                 if one.pose is not None and str(one.color).endswith(f'/{name}')]
        if len(found) != 1:
            posed = [one for one in files if one.pose is not None]
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
    """Return a note where images and stored poses do not fit; '' where they do, or do not tell.

    DatasetError: they fit well with other axes; says which.
    """
    found: dict[str, list[float]] = {name: [] for name in AXES}
    for first, second in _pairs([one for one in files if one.pose is not None], axes):
        for name, error_px in _epipolar_errors(first, second).items():
            found[name].append(error_px)
        if len(found[axes]) == _PAIRS:
            break
    if len(found[axes]) < _PAIRS // 2:
        return ''
    errors = {name: float(np.median(values)) for name, values in found.items()}
    best = min(errors, key=lambda name: errors[name])
    if errors[axes] < _WRONG_PX:
        return ''
    if errors[best] < min(_GOOD_PX, _BETTER * errors[axes]):
        raise DatasetError(f'{where}: the images do not fit the poses as {axes} (median epipolar '
                           f'error {errors[axes]:.1f} px), but do as {best} ({errors[best]:.1f} '
                           f'px): give `axes` {best}')
    return (f'the images do not fit the poses: median epipolar error {errors[axes]:.1f} px, '
            f'{errors[best]:.1f} px at best ({best})')


def _pairs(files: Sequence[ImageFile], axes: str) -> Iterator[tuple[ImageFile, ImageFile]]:
    """Yield pairs of images with poses that are near each other in order, and turned."""
    turns = [np.array(AXES[axes](one.pose))[:3, :3] for one in files if one.pose is not None]
    last = len(files) - 1
    for start in np.unique(np.linspace(0, max(0, last - 1), _TRIED).astype(int)).tolist():
        angles = [rotation_angle_deg(turns[start].T @ turn)
                  for turn in turns[start + 1:start + 1 + _REACH]]
        fit = [place for place, angle in enumerate(angles)
               if _TURN_DEG[0] < angle < _TURN_DEG[1]]
        if fit:
            yield files[start], files[start + 1 + fit[0]]


def _epipolar_errors(first: ImageFile, second: ImageFile) -> dict[str, float]:
    """Return the median epipolar error of two images by the name of the axes [px].

    Empty where too few features match.
    """
    looks = []
    for file in (first, second):
        image, camera = read_color(file)
        features: Features = extract(image, _FEATURES, _LONGEST_PX)
        looks.append((camera.normalize_points(features.pixels), unit_rows(features.descriptors)))
    rows, _ = match(looks[0][1], looks[1][1])
    points = [np.column_stack([look[0][rows[:, side]], np.ones(len(rows))])
              for side, look in enumerate(looks)]
    known = np.isfinite(points[0]).all(axis=1) & np.isfinite(points[1]).all(axis=1)
    if known.sum() < _LEAST_MATCHES:
        return {}
    ours, theirs = points[0][known], points[1][known]
    assert first.pose is not None and second.pose is not None
    focal_px = first.camera.fx * _LONGEST_PX / max(first.camera.width, first.camera.height)
    errors = {}
    for name, convert in AXES.items():
        step = invert_transform(convert(second.pose)) @ convert(first.pose)
        x, y, z = step[:3, 3] / max(float(np.linalg.norm(step[:3, 3])), 1e-12)
        essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ step[:3, :3]
        lines, back = ours @ essential.T, theirs @ essential
        with np.errstate(divide='ignore', invalid='ignore'):
            sampson = np.abs(np.sum(theirs * lines, axis=1)) / np.sqrt(
                lines[:, 0]**2 + lines[:, 1]**2 + back[:, 0]**2 + back[:, 1]**2)
        errors[name] = focal_px * float(np.median(np.nan_to_num(sampson, nan=0.0)))
    return errors
