# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The residuals that refinement minimizes in one frame: outlines should touch their boxes' edges.

The minimal pose fits three box centres; refinement fits the edges of all inliers. Each match has
four residuals, in deviations: a share of the box's size, because the errors of detector and shape
grow with the object, and the landmark's position_sigma as the camera sees it. Cauchy's weights
limit outliers (Triggs et al., "Bundle Adjustment", 1999). cliploc_ros.core.fit.refinement sums the
frames.

Of the residuals tried on the 258 recorded frames, edges solved most frames with the least error:
better than Wasserstein's distance of ellipses, the level sets of Zins et al. ("Level Set-Based
Camera Pose Estimation From Multiple 2D/3D Ellipse-Ellipsoid Correspondences", IROS 2022), and
logarithms of sizes. Edges cut by the image border count like others: dropping them, or making them
one-sided, solved no more frames.
"""

from math import sqrt

import numpy as np

from cliploc_ros.core.geometry.ellipsoid import project_ellipsoid
from cliploc_ros.core.kernels.compiled import compiled

# Standard deviation of an edge at a landmark of known position: a share of the mean of its box's
# two sides, plus a constant on the plane z = 1, about a pixel. The share is near the median error
# of boxes and fitted maps on the recorded frames, which also served for fitting; the constant is a
# guess.
RELATIVE_DEVIATION = 0.06
LEAST_DEVIATION = 0.003

# Residuals beyond this many deviations lose influence: some edges of maps and boxes are far off.
_CAUCHY = 1.0


@compiled
def residuals_of(pairs, vertical, rotation, translation, residuals):
    """Write by how many deviations outlines miss the edges; False if one is not in front.

    Parameters
    ----------
    pairs : ndarray (m, 14)
        Box ellipse (4,), centre (3,) and shape (6,) of the landmark, and edge_deviation of each
        match.
    vertical : ndarray (7,)
        See VERTICAL_UNKNOWN.
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map.
    residuals : ndarray (4 * m + 3,)
        Of left, right, top and bottom edge of each match, and of the vertical.
    """
    for row in range(len(pairs)):
        box = pairs[row]
        in_front, cx, cy, exx, _, eyy = project_ellipsoid(
            rotation, translation, pairs[row, 4:7], pairs[row, 7:13])
        if not in_front:
            return False
        deviation = box[13]
        half_x, half_y = sqrt(exx), sqrt(eyy)
        residuals[4 * row] = ((cx - half_x) - (box[0] - box[2])) / deviation
        residuals[4 * row + 1] = ((cx + half_x) - (box[0] + box[2])) / deviation
        residuals[4 * row + 2] = ((cy - half_y) - (box[1] - box[3])) / deviation
        residuals[4 * row + 3] = ((cy + half_y) - (box[1] + box[3])) / deviation
    first = 4 * len(pairs)
    for axis in range(3):
        residuals[first + axis] = 0.0
        if vertical[6] > 0.0:
            up = (rotation[axis, 0] * vertical[3] + rotation[axis, 1] * vertical[4]
                  + rotation[axis, 2] * vertical[5])
            residuals[first + axis] = (up - vertical[axis]) / vertical[6]
    return True


@compiled
def edge_deviation(box, center, sigma, rotation, translation):
    """Return the standard deviation of a match's edges on the plane z = 1.

    It is that of the pose at which the match was found. If it followed the pose, a camera that
    moves away from uncertain landmarks would lower the cost.

    Parameters
    ----------
    box, center : ndarray (4,), (3,)
        Box ellipse, and centre of the landmark [m].
    sigma : float
        Standard deviation of the centre on each axis [m].
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map.
    """
    # the sum of the semi-axes is the mean of the sides
    own = RELATIVE_DEVIATION * (box[2] + box[3]) + LEAST_DEVIATION
    depth = (rotation[2, 0] * center[0] + rotation[2, 1] * center[1] + rotation[2, 2] * center[2]
             + translation[2])
    seen = sigma / depth if depth > 0.0 else 0.0
    return sqrt(own * own + seen * seen)


@compiled
def robust_cost(residuals):
    """Return the sum of Cauchy's losses."""
    total = 0.0
    for residual in residuals:
        total += np.log1p((residual / _CAUCHY) ** 2)
    return total


@compiled
def linearize(pairs, vertical, rotation, translation, residuals):
    """Return the normal equations at a pose of known residuals: information (6, 6), gradient (6,).

    They are for steps of the camera's position [m] and rotations about the map's axes [rad]. See
    residuals_of for the parameters.
    """
    return _normal_equations(jacobian_of(pairs, vertical, rotation, translation), residuals)


@compiled
def jacobian_of(pairs, vertical, rotation, translation):
    """Return the derivatives (4 * m + 3, 6) of the residuals, see residuals_of and linearize."""
    jacobian = np.zeros((4 * len(pairs) + 3, 6))
    for row in range(len(pairs)):
        _differentiate(pairs[row, 4:7], pairs[row, 7:13], rotation, translation, pairs[row, 13],
                       jacobian[4 * row:4 * row + 4])
    if vertical[6] > 0.0:
        _differentiate_vertical(vertical, rotation, jacobian[4 * len(pairs):])
    return jacobian


@compiled
def _differentiate(center, shape, rotation, translation, deviation, jacobian):
    """Write the derivatives (4, 6) of the residuals of a landmark in front of the camera.

    In the camera's frame the dual conic is G = M - X X^T, up to sign and scale. A translation of
    the camera by a changes G by dG = a X^T + X a^T, a rotation by a changes it by dG = B + B^T
    with B = -[a] G. N is G scaled to a last element of one: cx and cy are its last column, and
    exx = cx^2 - N00.
    """
    _, cx, cy, exx, exy, eyy = project_ellipsoid(rotation, translation, center, shape)
    n00, n01, n11 = cx * cx - exx, cx * cy - exy, cy * cy - eyy
    r = rotation
    x = r[0, 0] * center[0] + r[0, 1] * center[1] + r[0, 2] * center[2] + translation[0]
    y = r[1, 0] * center[0] + r[1, 1] * center[1] + r[1, 2] * center[2] + translation[1]
    z = r[2, 0] * center[0] + r[2, 1] * center[1] + r[2, 2] * center[2] + translation[2]
    sxx, sxy, sxz, syy, syz, szz = shape
    depth = (r[2, 0] * (sxx * r[2, 0] + 2.0 * (sxy * r[2, 1] + sxz * r[2, 2]))
             + r[2, 1] * (syy * r[2, 1] + 2.0 * syz * r[2, 2]) + r[2, 2] * szz * r[2, 2])
    scale = 1.0 / (depth - z * z)
    half_x, half_y = sqrt(exx), sqrt(eyy)
    for axis in range(3):
        a0, a1, a2 = r[0, axis], r[1, axis], r[2, axis]
        d22 = 2.0 * a2 * z * scale
        jacobian[0, axis], jacobian[1, axis] = _edges(
            (a0 * z + a2 * x) * scale - cx * d22, 2.0 * a0 * x * scale - n00 * d22, cx, half_x,
            deviation)
        jacobian[2, axis], jacobian[3, axis] = _edges(
            (a1 * z + a2 * y) * scale - cy * d22, 2.0 * a1 * y * scale - n11 * d22, cy, half_y,
            deviation)
        d22 = 2.0 * (a1 * cx - a0 * cy)
        jacobian[0, 3 + axis], jacobian[1, 3 + axis] = _edges(
            a2 * cy - a1 + a1 * n00 - a0 * n01 - cx * d22,
            2.0 * (a2 * n01 - a1 * cx) - n00 * d22, cx, half_x, deviation)
        jacobian[2, 3 + axis], jacobian[3, 3 + axis] = _edges(
            a0 - a2 * cx + a1 * n01 - a0 * n11 - cy * d22,
            2.0 * (a0 * cy - a2 * n01) - n11 * d22, cy, half_y, deviation)


@compiled
def _edges(d_middle, d_diagonal, middle, half, deviation):
    """Return the derivatives of two opposite edges from those of N's column and diagonal."""
    d_half = (2.0 * middle * d_middle - d_diagonal) / (2.0 * half)
    return (d_middle - d_half) / deviation, (d_middle + d_half) / deviation


@compiled
def _differentiate_vertical(vertical, rotation, jacobian):
    """Write the derivatives (3, 6) of the vertical's residuals: a rotation by a adds -a x up."""
    up = np.empty(3)
    for i in range(3):
        up[i] = (rotation[i, 0] * vertical[3] + rotation[i, 1] * vertical[4]
                 + rotation[i, 2] * vertical[5])
    for axis in range(3):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            jacobian[i, 3 + axis] = (rotation[k, axis] * up[j]
                                     - rotation[j, axis] * up[k]) / vertical[6]


@compiled
def _normal_equations(jacobian, residuals):
    """Return information and gradient with Cauchy's weights."""
    information, gradient = np.empty((6, 6)), np.empty(6)
    weights = np.empty(len(residuals))
    for row in range(len(residuals)):
        weights[row] = 1.0 / (1.0 + (residuals[row] / _CAUCHY) ** 2)
    for i in range(6):
        total = 0.0
        for row in range(len(residuals)):
            total -= jacobian[row, i] * weights[row] * residuals[row]
        gradient[i] = total
        for j in range(i, 6):
            total = 0.0
            for row in range(len(residuals)):
                total += jacobian[row, i] * weights[row] * jacobian[row, j]
            information[i, j] = information[j, i] = total
    return information, gradient
