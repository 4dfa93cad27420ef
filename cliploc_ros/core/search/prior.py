# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is known of the camera before the search: its vertical and the range of its height."""

from math import atan2, cos, hypot, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: A vertical (7,) holds up in the camera (3,) and in the map (3,), unit vectors, and the standard
#: deviation of the angle between them [rad]. This one is unknown.
VERTICAL_UNKNOWN = np.zeros(7)


class Prior(NamedTuple):
    """What is known of the camera; by default nothing."""

    #: The vertical, unit vectors in the camera's optical frame and in the map frame
    up_in_camera: tuple[float, float, float] = (0.0, -1.0, 0.0)
    up_in_map: tuple[float, float, float] = (0.0, 0.0, 1.0)
    #: Of the camera's centre, along up_in_map from the map's origin [m]
    min_height: float = -inf
    max_height: float = inf
    #: Greatest angle between both verticals at a pose from three points [rad]. Poses from two
    #: points hold them equal.
    max_tilt: float = pi
    #: Standard deviation of the angle between both verticals [rad]; inf: only max_tilt counts
    vertical_deviation: float = inf

    def as_array(self) -> NDArray[np.float64]:
        """Return up in camera and map, height range, and least cosine of the tilt (9,)."""
        least_cosine = cos(self.max_tilt) if self.max_tilt < pi else -inf
        return np.array([*self.up_in_camera, *self.up_in_map, self.min_height, self.max_height,
                         least_cosine])

    def allows(self, map_from_camera: NDArray[np.float64]) -> bool:
        """Return whether the height range and max_tilt allow a pose (4, 4)."""
        height = float(np.dot(self.up_in_map, map_from_camera[:3, 3]))
        up = map_from_camera[:3, :3] @ self.up_in_camera
        return self.min_height <= height <= self.max_height and (
            self.max_tilt >= pi or float(up @ self.up_in_map) >= cos(self.max_tilt))

    def tilt_error(self, map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64]
                   ) -> float:
        """Return the angle between both verticals at a pose (4, 4), in its standard deviations.

        Those of the vertical and of the pose, with covariance (6, 6), count. Of right poses, one
        of 1,000 exceeds 3.7, if the vertical is right. 0 where the vertical is unknown.
        """
        up = map_from_camera[:3, :3] @ self.up_in_camera
        axis = np.cross(up, self.up_in_map)
        sine = float(np.linalg.norm(axis))
        axis /= max(sine, 1e-12)
        deviation = hypot(self.vertical_deviation, sqrt(axis @ covariance[3:, 3:] @ axis))
        return atan2(sine, float(up @ self.up_in_map)) / deviation
