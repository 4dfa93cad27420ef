# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated depths of boxes."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.depth import (
    CHORD_DEVIATION,
    SURFACE_SHARE,
    depth_deviations,
    depth_of,
    half_chord,
)
from cliploc_ros.core.geometry.transforms import invert_transform

# Share of boxes without depth, measured in a kitchen; share of boxes with the depth of another
# object, and the range of that depth [m]. The latter two are not measured.
_NO_DEPTH, _SOMETHING_ELSE, _ANY_DEPTH_M = 0.1, 0.05, (0.5, 5.0)


def simulate_depths(centers: NDArray[np.float64], shapes: NDArray[np.float64],
                    map_from_camera: NDArray[np.float64], rng: np.random.Generator,
                    scale: float = 1.0) -> NDArray[np.float64]:
    """Return the depths (m,) [m] that an RGB-D camera would measure in m boxes; NaN: no depth.

    Parameters
    ----------
    centers, shapes : ndarray (m, 3), (m, 6)
        Ellipsoid of the object in each box, in the map; NaN: an object that is not in the map.
    map_from_camera : ndarray (4, 4)
    scale : float
        Ratio of measured and true depth.
    """
    camera_from_map = invert_transform(map_from_camera)
    rotation, translation = (np.ascontiguousarray(camera_from_map[:3, :3]),
                             np.ascontiguousarray(camera_from_map[:3, 3]))
    depths = rng.uniform(*_ANY_DEPTH_M, len(centers))
    seen = np.isfinite(centers).all(axis=1) & (rng.random(len(centers)) >= _SOMETHING_ELSE)
    for row in np.nonzero(seen)[0]:
        share = rng.normal(SURFACE_SHARE, CHORD_DEVIATION)
        depths[row] = (depth_of(rotation, translation, centers[row]) - share * half_chord(
            centers[row], shapes[row], rotation, translation))
    depths = scale * depths + rng.normal(size=len(depths)) * depth_deviations(depths)
    depths[(rng.random(len(depths)) < _NO_DEPTH) | (depths <= 0.0)] = np.nan
    return depths
