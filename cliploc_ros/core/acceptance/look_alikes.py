# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that look alike, such as two rooms with the same furniture.

Two poses at places that look alike explain the same detections. Which of them matches one object
more, or fits better, then says little: maps lack objects, and objects move. Labels tell the
places apart, and where there are none, the number of objects does to some degree. A conditional
logit of its own, with these two terms only, weighs such poses.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.landmark_map import LandmarkMap

# All constants are chosen on simulated worlds, see cliploc_ros.evaluation.worlds: kinds room,
# office, shop, corridor, hall and two rooms, seeds 0 to 59.
# Landmarks nearer than this belong to a place; the nearest of them are compared.
_PLACE_M, _MOST_LANDMARKS = 4.0, 200
# Landmarks of one class correspond if they are nearer than this after one place is moved onto
# the other.
_SAME_M = 0.3
_LEAST_SHARE, _LEAST_LANDMARKS = 0.4, 4
_LEAST_MATCHED = 0.5
# Both places are upright: one is moved onto the other by a turn about the vertical.
_MOST_TILT = np.cos(np.radians(20.0))
# Landmarks near a spot that are searched for one of the right class.
_NEIGHBOURS = 6
# Log odds of a unit of likeness, and of an object that was matched by class alone.
_LIKENESS, _UNLABELLED = 0.44, 0.5


def look_alike(landmark_map: LandmarkMap, map_from_camera: NDArray[np.float64],
               matched: NDArray[np.int64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the place of a pose looks like the places of other poses.

    Parameters
    ----------
    landmark_map : LandmarkMap
        L landmarks.
    map_from_camera : ndarray (4, 4)
    matched : ndarray (n,) of int
        Landmarks that the pose explains detections with.
    others : ndarray (m, 4, 4)
        Poses at other places, from which a camera would see the same.

    Returns
    -------
    ndarray (m,) of bool
        A place looks like another one if at least four landmarks, two fifths of those around it,
        and half of those matched have one of their class at the same spot there.
    """
    rows = _landmarks_around(landmark_map, map_from_camera[:3, 3])
    moves = others @ invert_transform(map_from_camera)
    found = np.zeros(len(others), dtype=np.bool_)
    if len(rows) < _LEAST_LANDMARKS or not len(matched):
        return found
    for number in np.nonzero(moves[:, 2, 2] > _MOST_TILT)[0]:
        around = _have_twins(landmark_map, rows, moves[number])
        found[number] = (around.sum() >= max(_LEAST_LANDMARKS, _LEAST_SHARE * len(rows))
                         and _have_twins(landmark_map, matched, moves[number]).mean()
                         >= _LEAST_MATCHED)
    return found


def chance_distinct(its: Support, twins: Sequence[Support]) -> float:
    """Return the probability that a pose is not mistaken for one at a place that looks alike.

    Parameters
    ----------
    its : Support
        Of the pose.
    twins : sequence of Support
        Of the poses at places that look like its own.
    """
    leads = [_LIKENESS * (its.likeness - one.likeness)
             + _UNLABELLED * (its.unlabelled - one.unlabelled) for one in twins]
    return float(1.0 / (1.0 + np.exp(-np.clip(leads, -50.0, 50.0)).sum()))


def _landmarks_around(landmark_map: LandmarkMap, position: NDArray[np.float64]
                      ) -> NDArray[np.int64]:
    """Return the landmarks around a position, the nearest first."""
    count = min(_MOST_LANDMARKS, len(landmark_map))
    distances, rows = landmark_map.tree.query(position, [*range(1, count + 1)],
                                              distance_upper_bound=_PLACE_M)
    return np.asarray(rows[np.isfinite(distances)])


def _have_twins(landmark_map: LandmarkMap, rows: NDArray[np.int64], move: NDArray[np.float64]
                ) -> NDArray[np.bool_]:
    """Return which landmarks (r,), moved by a transform (4, 4), meet another of their class."""
    moved = landmark_map.centers[rows] @ move[:3, :3].T + move[:3, 3]
    count = min(_NEIGHBOURS, len(landmark_map))
    distances, near = landmark_map.tree.query(moved, [*range(1, count + 1)],
                                              distance_upper_bound=_SAME_M)
    classes = np.append(landmark_map.classes.of_landmarks, -1)  # none near has index L
    same = (classes[near] == classes[rows][:, None]) & (near != rows[:, None])
    return np.asarray((same & np.isfinite(distances)).any(axis=1))
