# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks while they are being built: ellipsoids with a class."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap


class Landmarks(NamedTuple):
    """L ellipsoids of known classes."""

    centers: NDArray[np.float64]  #: (L, 3): [m]
    #: (L, 3, 3): their columns are the semi-axes [m], see cliploc_ros.mapping.projection
    bases: NDArray[np.float64]
    classes: NDArray[np.int64]  #: (L,): detector classes

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> 'Landmarks':
        """Return some of the landmarks."""
        return Landmarks(self.centers[rows], self.bases[rows], self.classes[rows])


def landmarks_of_map(landmark_map: LandmarkMap, class_names: Sequence[str]) -> Landmarks:
    """Return the landmarks of a map; those of other classes than the named ones get -1."""
    numbers = {name: number for number, name in enumerate(class_names)}
    rotations = Rotation.from_quat(landmark_map.quats_xyzw).as_matrix()
    return Landmarks(landmark_map.centers, rotations * landmark_map.semi_axes[:, None, :],
                     np.array([numbers.get(name, -1) for name in landmark_map.class_ids]))


def no_landmarks() -> Landmarks:
    """Return none."""
    return Landmarks(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))


def join_landmarks(*parts: Landmarks) -> Landmarks:
    """Return the landmarks of all parts."""
    columns = zip(no_landmarks(), *parts, strict=True)
    return Landmarks(*(np.concatenate(column) for column in columns))


def group_boxes(shown: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the boxes of each of a number of landmarks, in ascending order."""
    order = np.argsort(shown, kind='stable')
    bounds = np.searchsorted(shown[order], np.arange(count + 1))
    return [order[bounds[number]:bounds[number + 1]] for number in range(count)]
