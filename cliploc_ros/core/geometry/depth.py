# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images, the depth of the objects in boxes, and from it the depth of a landmark's centre.

Depth is never exact: it has holes, errors of scale, and a small offset to the colour image. The
depth of a box is therefore the median over its inner half, together with the spread there.

The visible surface is nearer than the centre by a share of half the chord that the ellipsoid cuts
off the ray through the centre. The standard deviation of this offset is another share of half the
chord, because objects differ from ellipsoids.
"""

from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.errors import DatasetError

# Offset of the surface from the centre and its standard deviation, as shares of half a chord.
# Measured on 892 boxes of a kitchen.
SURFACE_SHARE, CHORD_DEVIATION = 0.6, 0.4
# Standard deviation of a measured depth: a constant, and a share of the depth (same boxes).
_FLOOR_M, _SHARE = 0.03, 0.02
# Share of the right matches with the depth of another object, for example of an occluding object,
# and the relative standard deviation of the depth of wrong matches. In simulated worlds, .1
# separates right from wrong poses better than .15 to .5.
_ELSEWHERE, _WRONG_SHARE = 0.1, 0.1
#: Units of a 16-bit depth image: the conventions of ROS and of the TUM RGB-D dataset [m].
MILLIMETRE, TUM_UNIT = 1e-3, 1 / 5000
# The share of a box, in each direction, whose depths are used, and the minimum number of depths.
_INNER_SHARE = 0.5
_LEAST_VALUES = 12
_LEAST_SHARE = 0.1
# Step between the pixels that are used [px]: every second pixel is enough for a median.
_STEP = 2
#: Range of the typical depth of a recording in rooms and halls [m].
PLAUSIBLE_DEPTH_M = (0.15, 40.0)


@compiled
def depth_of(rotation, translation, point):
    """Return the depth of a point (3,) of the map, given camera_from_map (3, 3), (3,)."""
    return (rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2]
            + translation[2])


@compiled
def centre_depth(measured, center, shape, sigma, rotation, translation):
    """Return the measured depth of a landmark's centre and its deviation [m]; 0, 0 if unknown.

    Parameters
    ----------
    measured : ndarray (2,)
        Depth of the surface and its standard deviation [m]; 0, 0 if unknown.
    center, shape : ndarray (3,), (6,)
        Centre and shape of the landmark.
    sigma : float
        Standard deviation of the centre on each axis [m].
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map, which determine the chord.
    """
    if not measured[1] > 0.0:
        return 0.0, 0.0
    half = half_chord(center, shape, rotation, translation)
    noise = CHORD_DEVIATION * half
    return (measured[0] + SURFACE_SHARE * half,
            sqrt(measured[1] * measured[1] + noise * noise + sigma * sigma))


@compiled
def half_chord(center, shape, rotation, translation):
    """Return half the depth of the chord that a landmark cuts off the ray through its centre [m].

    Half the chord is 1 / sqrt(r^T S^-1 r) of the length of the ray r to the centre. The inverse of
    the shape S is computed from its cofactors.
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
    """Return depth minus measured depth, standard deviation and depth (m, 3) of m landmarks [m].

    The standard deviation is 0 if no depth was measured. The parameters are those of centre_depth,
    with a row for each landmark.
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
    """Return the standard deviations (n,) of depths (n,) of a typical RGB-D camera [m]."""
    return np.hypot(_FLOOR_M, _SHARE * depths)


def depth_odds(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the log odds (m,) of matches from their depth_errors (m, 3); 0 if unknown.

    The depth of a wrong match is approximately right, too, because its box is as large as that of
    the landmark, and the pose was fitted to both.
    """
    odds, known = np.zeros(len(errors)), errors[:, 1] > 0.0
    error, deviation, depth = errors[known].T
    wrong = np.hypot(_WRONG_SHARE * depth, deviation)
    ratio = wrong / deviation * np.exp(
        0.5 * np.minimum((error / wrong) ** 2 - (error / deviation) ** 2, 0.0))
    odds[known] = np.log((1.0 - _ELSEWHERE) * ratio + _ELSEWHERE)
    return odds


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera whose images are not registered to the colour images."""

    #: Focal lengths and principal point of the depth image [px]
    fx: float
    fy: float
    cx: float
    cy: float
    #: (4, 4): pose of the depth camera in the coordinate frame of the colour camera
    color_from_depth: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class DepthImage:
    """A depth image, registered to the colour image or with its own camera."""

    depths_m: NDArray[np.float32]  #: (h, w): depths along z [m]; NaN where unknown
    camera: DepthCamera | None = None  #: None if the depths are registered to the colour image


def depth_from_counts(counts: NDArray[np.generic], unit_m: float | None, where: str
                      ) -> NDArray[np.float32]:
    """Convert a decoded depth image to depths (h, w) [m], NaN where unknown.

    Parameters
    ----------
    counts : ndarray (h, w)
        uint16, with 0 and 65535 for unknown depth, or float.
    unit_m : float or None
        Metres of one count. None: 1 mm for uint16, 1 m for float.
    where : str
        Name of the file or message, for the error.

    Raises
    ------
    DatasetError
        The image has another type or shape.
    """
    if counts.ndim != 2 or counts.dtype not in (np.uint16, np.float32, np.float64):
        raise DatasetError(f'{where}: {counts.dtype} with shape {counts.shape} is not a depth '
                           'image of 16-bit integers or floats')
    is_integer = counts.dtype == np.uint16
    depths = counts.astype(np.float32) * np.float32(unit_m or (MILLIMETRE if is_integer else 1.0))
    with np.errstate(invalid='ignore'):
        valid = np.isfinite(depths) & (depths > 0.0)
    if is_integer:
        valid &= counts != np.uint16(65535)
    depths[~valid] = np.nan
    return depths


def depths_of_boxes(depth: DepthImage, camera: Camera, bboxes_xyxy: NDArray[np.float64]
                    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the depths of the objects in boxes, and their spreads.

    Parameters
    ----------
    camera : Camera
        Camera of the colour image.
    bboxes_xyxy : ndarray (n, 4)
        Boxes in the distorted colour image [px].

    Returns
    -------
    depths_m : ndarray (n,) float32
        Median over the inner half of each box, along z of the colour camera [m]; NaN if too few
        pixels have depth.
    spreads_m : ndarray (n,) float32
        Half the difference of the 84th and 16th percentiles there [m].
    """
    pixels, values = points_in_color(depth, camera, _STEP)
    depths = np.full(len(bboxes_xyxy), np.nan, dtype=np.float32)
    spreads = depths.copy()
    density = depth.depths_m.size / (camera.width * camera.height) / _STEP**2
    centres = np.tile(0.5 * (bboxes_xyxy[:, :2] + bboxes_xyxy[:, 2:]), 2)
    inner = centres + _INNER_SHARE * (bboxes_xyxy - centres)
    for row, (left, top, right, bottom) in enumerate(inner):
        inside = values[(pixels[0] >= left) & (pixels[0] <= right)
                        & (pixels[1] >= top) & (pixels[1] <= bottom)]
        expected = density * (right - left) * (bottom - top)
        if len(inside) >= max(_LEAST_VALUES, _LEAST_SHARE * expected):
            low, depths[row], high = np.percentile(inside, [16, 50, 84])
            spreads[row] = 0.5 * (high - low)
    return depths, spreads


def points_in_color(depth: DepthImage, camera: Camera, step: int
                    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the pixels (2, p) of known depths in the colour image, and the depths (p,) [m].

    Only every `step`-th row and column of the depth image is used.
    """
    height, width = depth.depths_m.shape
    v, u = np.mgrid[0:height:step, 0:width:step]
    values = depth.depths_m[::step, ::step]
    valid = np.isfinite(values)
    u, v, values = u[valid].astype(np.float64), v[valid].astype(np.float64), values[valid]
    own = depth.camera
    if own is None:  # the depth image may be smaller than the colour image
        return np.stack([u * camera.width / width, v * camera.height / height]), values
    points = np.stack([(u - own.cx) / own.fx * values, (v - own.cy) / own.fy * values, values],
                      axis=1) @ own.color_from_depth[:3, :3].T + own.color_from_depth[:3, 3]
    points = points[points[:, 2] > 0.0]
    pixels = camera.project_normalized(points[:, :2] / points[:, 2:])
    inside = np.isfinite(pixels).all(axis=1)
    return pixels[inside].T, points[inside, 2].astype(np.float32)
