# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The depth of a landmark's centre, from the depth in its box.

The visible surface is nearer than the centre, by a share of half the chord that the ray through
the centre cuts off the ellipsoid. By how much objects differ from ellipsoids makes this uncertain,
by another share of it.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled

# Both of half a chord. Of 892 boxes of a kitchen.
SURFACE_SHARE, CHORD_DEVIATION = 0.6, 0.4
# Deviation of a measured depth: a floor, and a share of it. Of the same boxes.
_FLOOR_M, _SHARE = 0.03, 0.02
# Share of the right matches whose depth is that of something else, as where they are hidden in
# part; and the deviation of the depth of wrong matches, as a share of it. In simulated worlds .1
# tells right from wrong poses better than .15 to .5.
_ELSEWHERE, _WRONG_SHARE = 0.1, 0.1


@compiled
def depth_of(rotation, translation, point):
    """Return the depth of a point (3,) of the map, at the camera_from_map (3, 3), (3,)."""
    return (rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2]
            + translation[2])


@compiled
def centre_depth(measured, center, shape, sigma, rotation, translation):
    """Return the depth of a landmark's centre by measurement, and its deviation; 0, 0 if none [m].

    Parameters
    ----------
    measured : ndarray (2,)
        Depth of the surface and its standard deviation [m]; 0, 0 if unknown.
    center, shape : ndarray (3,), (6,)
        Centre and shape of the landmark.
    sigma : float
        Standard deviation of the centre on each axis [m].
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map. They give the thickness along the ray.
    """
    if not measured[1] > 0.0:
        return 0.0, 0.0
    half = half_chord(center, shape, rotation, translation)
    noise = CHORD_DEVIATION * half
    return (measured[0] + SURFACE_SHARE * half,
            sqrt(measured[1] * measured[1] + noise * noise + sigma * sigma))


@compiled
def half_chord(center, shape, rotation, translation):
    """Return half the depth of what the ray through its centre cuts off a landmark [m].

    The ray r to the centre passes through 1 / sqrt(r^T S^-1 r) of its length, with the inverse of
    the shape S by its cofactors.
    """
    ray = np.empty(3)  # from the camera to the centre
    for axis in range(3):
        ray[axis] = center[axis]
        for row in range(3):
            ray[axis] += rotation[row, axis] * translation[row]
    xx, xy, xz, yy, yz, zz = shape
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    x, y, z = ray
    square = (x * (c00 * x + 2.0 * (c01 * y + c02 * z)) + y * (c11 * y + 2.0 * c12 * z)
              + c22 * z * z)
    determinant = xx * c00 + xy * c01 + xz * c02
    if not (determinant > 0.0 and square > 0.0):
        return 0.0
    return depth_of(rotation, translation, center) * sqrt(determinant / square)


@compiled
def depth_errors(measured, centers, shapes, sigmas, rotation, translation):
    """Return by how much m landmarks are deeper than measured, the deviations, and depths (m, 3).

    All are in metres; the deviation is 0 where nothing was measured. Parameters are those of
    centre_depth, with a row for each landmark.
    """
    errors = np.zeros((len(measured), 3))
    for row in range(len(measured)):
        depth, deviation = centre_depth(measured[row], centers[row], shapes[row], sigmas[row],
                                        rotation, translation)
        if deviation > 0.0:
            errors[row, 2] = depth_of(rotation, translation, centers[row])
            errors[row, 0] = errors[row, 2] - depth
            errors[row, 1] = deviation
    return errors


def depth_deviations(depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviations (n,) of the depths of a usual RGB-D camera [m]."""
    return np.hypot(_FLOOR_M, _SHARE * depths)


def depth_odds(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the log odds (m,) of matches, by their depth_errors (m, 3); 0 where none.

    A wrong match has about the right depth, too: its box is as large as that of the landmark, and
    the pose was fitted to both.
    """
    odds, known = np.zeros(len(errors)), errors[:, 1] > 0.0
    error, deviation, depth = errors[known].T
    wrong = np.hypot(_WRONG_SHARE * depth, deviation)
    ratio = wrong / deviation * np.exp(
        0.5 * np.minimum((error / wrong) ** 2 - (error / deviation) ** 2, 0.0))
    odds[known] = np.log((1.0 - _ELSEWHERE) * ratio + _ELSEWHERE)
    return odds
