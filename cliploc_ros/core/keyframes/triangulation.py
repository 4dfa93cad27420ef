# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points from posed images without depth: where the rays of the same feature meet."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.keyframes.features import match, unit_rows

# Rays that cross at a smaller angle place a point too roughly.
_LEAST_PARALLAX = np.radians(1.5)
# A ray misses its point by no more than 2 px at f = 525 px.
_MOST_ERROR = 2.0 / 525.0
# Images that each one is compared with: the nearest ones that look the same way.
_NEIGHBOURS = 8
_LEAST_M, _MOST_M, _MOST_COS = 0.05, 2.0, np.cos(np.radians(40.0))
#: The points of a room or hall are this far [m].
_DEPTHS_M = (0.2, 40.0)


class PosedFeatures(NamedTuple):
    """The n features of a posed image."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    bearings: NDArray[np.float64]  #: (n, 2): on the plane z = 1
    descriptors: NDArray[np.uint8]  #: (n, 128)


def triangulate(images: Sequence[PosedFeatures], row: int) -> NDArray[np.float64]:
    """Return the points (n, 3) of an image's features in its own coordinate frame [m].

    Each feature is matched in the neighbouring images. Each match gives a point. The point
    with which most matches agree is kept, or that with the widest angle. NaN: no point.
    """
    ours = images[row]
    poses = np.array([one.map_from_camera for one in images])
    distances = np.linalg.norm(poses[:, :3, 3] - poses[row, :3, 3], axis=1)
    cosines = 0.5 * (np.einsum('kij,ij->k', poses[:, :3, :3], poses[row, :3, :3]) - 1.0)
    fit = (distances > _LEAST_M) & (distances < _MOST_M) & (cosines > _MOST_COS)
    order = np.argsort(distances, kind='stable')
    neighbours = [int(one) for one in order[fit[order]][:_NEIGHBOURS]]
    count = len(ours.bearings)
    seen = np.full((len(neighbours), count, 2), np.nan)
    cameras = np.array([invert_transform(images[one].map_from_camera) @ ours.map_from_camera
                        for one in neighbours]).reshape(-1, 4, 4)
    descriptors = unit_rows(ours.descriptors)
    for number, one in enumerate(neighbours):
        pairs = match(descriptors, unit_rows(images[one].descriptors))
        seen[number, pairs[:, 0]] = images[one].bearings[pairs[:, 1]]
    best = np.full((count, 3), np.nan)
    scores = np.zeros(count)
    for number in range(len(neighbours)):
        points, angles = _crossings(ours.bearings, seen[number], cameras[number])
        agreed = np.sum([_agrees(points, other, camera)
                         for other, camera in zip(seen, cameras, strict=True)], axis=0)
        sound = (_agrees(points, seen[number], cameras[number])
                 & _agrees(points, ours.bearings, np.eye(4)) & (angles >= _LEAST_PARALLAX)
                 & (points[:, 2] > _DEPTHS_M[0]) & (points[:, 2] < _DEPTHS_M[1]))
        score = np.where(sound, agreed + angles, 0.0)
        best[score > scores] = points[score > scores]
        scores = np.maximum(scores, score)
    return best


def _crossings(ours: NDArray[np.float64], theirs: NDArray[np.float64],
               theirs_from_ours: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where pairs of rays are nearest, in our coordinate frame, and their angles [rad]."""
    back = invert_transform(theirs_from_ours)
    first = _unit(np.column_stack([ours, np.ones(len(ours))]))
    second = _unit(np.column_stack([theirs, np.ones(len(theirs))])) @ back[:3, :3].T
    place = back[:3, 3]
    cosines = np.sum(first * second, axis=1)
    along, other = first @ place, second @ place
    with np.errstate(divide='ignore', invalid='ignore'):
        reach = (along - cosines * other) / (1.0 - cosines**2)
        theirs_reach = (cosines * along - other) / (1.0 - cosines**2)
        points = 0.5 * (first * reach[:, None] + place + second * theirs_reach[:, None])
        return points, np.arccos(np.clip(cosines, -1.0, 1.0))


def _agrees(points: NDArray[np.float64], bearings: NDArray[np.float64],
            camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (n, 3) a camera sees at its bearings (n, 2)."""
    inside = points @ camera[:3, :3].T + camera[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - bearings, axis=1)
        return np.asarray((inside[:, 2] > 0.0) & (errors < _MOST_ERROR))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
