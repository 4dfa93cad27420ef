# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What moves a pose to where all of its inliers fit, where the search used three box centres.

The outline of each matched landmark shall touch the edges of its box: four residuals a match, in
shares of the box's size, since both a detector's and a mapper's errors grow with the object.
Here are one frame's residuals with Cauchy's weights, and the system they make (Triggs et al.,
"Bundle Adjustment", 1999); cliploc_ros.core.fit.several_frames minimizes them over one frame or
several.

Over all 258 recorded frames edges solved most and most exactly, against Wasserstein's distance of
ellipses, the level sets of Zins et al. ("Level Set-Based Camera Pose Estimation From Multiple
2D/3D Ellipse-Ellipsoid Correspondences", IROS 2022), and logarithms of sizes. Edges that the
image's border cuts count as others: leaving them out, or letting them push to one side only, made
poses no more often right.
"""

from math import cos, sin, sqrt

import numpy as np

from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoid

# Of an edge, as a share of its box's mean side, and on the plane z = 1: boxes of detectors and of
# fitted maps are off by so much, in the median, and by a pixel or so at least.
RELATIVE_DEVIATION = 0.06
LEAST_DEVIATION = 0.003
#: What residuals_of takes for a vertical that is not known.
VERTICAL_UNKNOWN = np.zeros(7)

# Residuals beyond this many deviations lose their say: maps and boxes hold edges that are far off.
_CAUCHY = 1.0


@compiled
def one_to_one(workspace, detections, landmarks):
    """Write the matches, of several boxes on one landmark the best; return their number."""
    count = 0
    for detection in range(workspace.landmarks.shape[0]):
        landmark = workspace.landmarks[detection]
        if landmark < 0:
            continue
        for row in range(count):
            if landmarks[row] == landmark:
                if workspace.ious[detection] > workspace.ious[detections[row]]:
                    detections[row] = detection
                break
        else:
            detections[count], landmarks[count] = detection, landmark
            count += 1
    return count


@compiled
def linearize(pairs, vertical, rotation, translation, residuals, jacobian, information, gradient):
    """Write the normal equations at a pose of known residuals, see residuals_of."""
    weights = np.empty(len(residuals))
    for row in range(len(residuals)):
        weights[row] = 1.0 / (1.0 + (residuals[row] / _CAUCHY) ** 2)
    for row in range(len(pairs)):
        _differentiate(pairs[row, 4:7], pairs[row, 7:], rotation, translation,
                       _deviation(pairs[row]), jacobian[4 * row:4 * row + 4])
    jacobian[4 * len(pairs):] = 0.0
    if vertical[6] > 0.0:
        _differentiate_vertical(vertical, rotation, jacobian[4 * len(pairs):])
    _normal_equations(jacobian, residuals, weights, information, gradient)


@compiled
def _differentiate(center, shape, rotation, translation, deviation, jacobian):
    """Write the derivatives (4, 6) of a visible landmark's residuals.

    In the camera's frame the dual conic is G = M - X X^T, up to sign and scale. A camera moved
    by a has dG = a X^T + X a^T, one turned by a has dG = B + B^T with B = -[a] G. N is G with a
    last element of one: cx, cy are its last column, and exx = cx^2 - N00.
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
    for axis in range(3):
        a0, a1, a2 = r[0, axis], r[1, axis], r[2, axis]
        d22 = 2.0 * a2 * z * scale
        _write_edges(jacobian, axis, (a0 * z + a2 * x) * scale - cx * d22, cx,
                     2.0 * a0 * x * scale - n00 * d22, sqrt(exx), deviation, 0)
        _write_edges(jacobian, axis, (a1 * z + a2 * y) * scale - cy * d22, cy,
                     2.0 * a1 * y * scale - n11 * d22, sqrt(eyy), deviation, 2)
        d22 = 2.0 * (a1 * cx - a0 * cy)
        _write_edges(jacobian, 3 + axis, a2 * cy - a1 + a1 * n00 - a0 * n01 - cx * d22, cx,
                     2.0 * (a2 * n01 - a1 * cx) - n00 * d22, sqrt(exx), deviation, 0)
        _write_edges(jacobian, 3 + axis, a0 - a2 * cx + a1 * n01 - a0 * n11 - cy * d22, cy,
                     2.0 * (a0 * cy - a2 * n01) - n11 * d22, sqrt(eyy), deviation, 2)


@compiled
def _write_edges(jacobian, column, d_middle, middle, d_diagonal, half, deviation, first):
    """Write how two opposite edges move, from what becomes of N's column and diagonal."""
    d_half = (2.0 * middle * d_middle - d_diagonal) / (2.0 * half)
    jacobian[first, column] = (d_middle - d_half) / deviation
    jacobian[first + 1, column] = (d_middle + d_half) / deviation


@compiled
def _differentiate_vertical(vertical, rotation, jacobian):
    """Write the derivatives (3, 6) of the vertical's residuals: a turned camera sees -a x up."""
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
def residuals_of(pairs, vertical, rotation, translation, residuals):
    """Write by how many deviations outlines miss the edges; False if one is not in front.

    Parameters
    ----------
    pairs : ndarray (m, 13)
        Box ellipse (4,), centre (3,) and shape (6,) of the landmark of each match.
    vertical : ndarray (7,)
        Up in the camera (3,) and in the map (3,), unit vectors, and the standard deviation of the
        angle between them [rad]; VERTICAL_UNKNOWN where it is not known.
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map.
    residuals : ndarray (4 * m + 3,)
        Of left, right, upper and lower edge of each match; of the vertical.
    """
    for row in range(len(pairs)):
        box = pairs[row]
        visible, cx, cy, exx, _, eyy = project_ellipsoid(
            rotation, translation, pairs[row, 4:7], pairs[row, 7:])
        if not visible:
            return False
        deviation = _deviation(box)
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
def _deviation(box):
    """Return the standard deviation assumed of a box's edges."""
    return RELATIVE_DEVIATION * (box[2] + box[3]) + LEAST_DEVIATION


@compiled
def robust_cost(residuals):
    """Return Cauchy's sum."""
    total = 0.0
    for residual in residuals:
        total += np.log1p((residual / _CAUCHY) ** 2)
    return total


@compiled
def _normal_equations(jacobian, residuals, weights, information, gradient):
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


@compiled
def move(rotation, translation, step, new_rotation, new_translation):
    """Write a camera_from_map whose camera is moved by step[:3] and turned by step[3:]."""
    angle = sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    sine = sin(angle) / angle if angle > 1e-12 else 1.0
    versine = (1.0 - cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    # Each row of the rotation is a camera axis in the map, and turns with the camera (Rodrigues).
    for row in range(3):
        x, y, z = rotation[row, 0], rotation[row, 1], rotation[row, 2]
        along = (step[3] * x + step[4] * y + step[5] * z) * versine
        cosine = 1.0 - versine * angle * angle
        new_rotation[row, 0] = x * cosine + sine * (step[4] * z - step[5] * y) + along * step[3]
        new_rotation[row, 1] = y * cosine + sine * (step[5] * x - step[3] * z) + along * step[4]
        new_rotation[row, 2] = z * cosine + sine * (step[3] * y - step[4] * x) + along * step[5]
    for row in range(3):
        new_translation[row] = 0.0
    for axis in range(3):
        center = step[axis]
        for row in range(3):
            center -= rotation[row, axis] * translation[row]
        for row in range(3):
            new_translation[row] -= new_rotation[row, axis] * center


@compiled
def solve(matrix, right, solution):
    """Solve a symmetric positive definite system of six; its matrix is overwritten."""
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(6):
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * solution[k]
        solution[i] = total / matrix[i, i]
    for i in range(5, -1, -1):
        total = solution[i]
        for k in range(i + 1, 6):
            total -= matrix[k, i] * solution[k]
        solution[i] = total / matrix[i, i]
    return True
