# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a camera sees, as the edges of a pyramid, for drawing."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera

# Corners of the base: right and down, in units of half its size.
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def frusta(camera: Camera, map_from_camera: NDArray[np.float64], depth_m: float
           ) -> NDArray[np.float64]:
    """Return the edges (8 f, 2, 3) of the frusta of a camera at some poses [m].

    Parameters
    ----------
    camera : Camera
    map_from_camera : ndarray (f, 4, 4)
    depth_m : float
        From the tip to the base [m].
    """
    half = np.array([camera.width / camera.fx, camera.height / camera.fy]) * 0.5 * depth_m
    corners = np.column_stack([_CORNERS * half, np.full(4, depth_m)])
    points = np.einsum('fij,kj->fki', map_from_camera[:, :3, :3], corners) \
        + map_from_camera[:, None, :3, 3]
    tips = np.broadcast_to(map_from_camera[:, None, :3, 3], points.shape)
    lines = np.concatenate([np.stack([tips, points], axis=2),
                            np.stack([points, np.roll(points, 1, axis=1)], axis=2)], axis=1)
    return np.asarray(lines.reshape(-1, 2, 3))
