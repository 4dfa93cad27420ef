# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map of two equal rooms, for the tests of look-alike places."""

import numpy as np

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map

_ROOM = np.array([[0.0, 0.0, 0.4], [0.9, 0.2, 0.6], [0.3, 1.1, 0.5], [1.2, 1.3, 0.8],
                  [-0.5, 0.8, 0.3]])
_CLASSES = ('cup', 'book', 'plant', 'cup', 'chair')


def write_two_rooms(path):
    """Write the map; its rooms are 7 m apart, and labels in them are equal."""
    centers = np.concatenate([_ROOM, _ROOM + np.array([7.0, 0.0, 0.0])])
    count = len(centers)
    classes = _CLASSES * 2
    write_map(path, LandmarkMap(
        'map', tuple(f'{name}_{row}' for row, name in enumerate(classes)),
        tuple(f'a {name}' for name in classes), classes, centers, np.full((count, 3), 0.15),
        np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))))
