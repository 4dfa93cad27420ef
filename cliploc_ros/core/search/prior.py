# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is known of the camera before the search: its vertical and the range of its height."""

from math import cos, inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: A vertical (7,) holds up in the camera (3,) and in the map (3,), unit vectors, and the standard
#: deviation of the angle between them [rad]. This one is unknown.
VERTICAL_UNKNOWN = np.zeros(7)


class Prior(NamedTuple):
    """What is known of the camera; by default nothing.

    Parameters
    ----------
    up_in_camera, up_in_map : tuple of float
        The vertical, unit vectors in the camera's optical frame and in the map frame.
    min_height, max_height : float
        Of the camera's centre, along up_in_map from the map's origin [m].
    max_tilt : float
        Greatest angle between both verticals at a pose from three points [rad]. Poses from two
        points hold them equal.
    """

    up_in_camera: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up_in_map: tuple[float, float, float] = (0.0, 0.0, 1.0)
    min_height: float = -inf
    max_height: float = inf
    max_tilt: float = pi

    def as_array(self) -> NDArray[np.float64]:
        """Return up in camera and map, height range, and least cosine of the tilt (9,)."""
        least_cosine = cos(self.max_tilt) if self.max_tilt < pi else -inf
        return np.array([*self.up_in_camera, *self.up_in_map, self.min_height, self.max_height,
                         least_cosine])
