# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose made better by all of its inliers, where the search used three box centres.

The outline of each matched landmark shall touch the edges of its box: four residuals a match, in
shares of the box's size, since both a detector's and a mapper's errors grow with the object.
Levenberg-Marquardt with Cauchy's weights minimizes them (Triggs et al., "Bundle Adjustment",
1999); matching and minimizing alternate until neither changes.
"""

from math import cos, sin, sqrt

import numpy as np

from cliploc_ros.core.compiled import compiled
from cliploc_ros.core.ellipsoid import project_ellipsoid
from cliploc_ros.core.scoring import verify

# Of an edge, as a share of its box's mean side, and on the plane z = 1: boxes of detectors and of
# fitted maps are off by a tenth or so, and by a pixel or so at least.
RELATIVE_DEVIATION = 0.1
LEAST_DEVIATION = 0.003
#: What refine takes for a vertical that is not known.
VERTICAL_UNKNOWN = np.zeros(7)

# Residuals beyond this many deviations lose their say.
_CAUCHY = 2.0
_ROUNDS = 4
_STEPS = 5
_DIFFERENCE = 1e-6
_FIRST_DAMPING = 1e-3
_SETTLED = 1e-5
# A step that is longer, in metres and in radians, has left where the residuals are nearly linear.
_LONGEST_STEP = 1.0


@compiled
def refine(scene, rotation, translation, vertical, workspace):
    """Refine a pose in place; return its score, and the information of its last system.

    Parameters
    ----------
    scene : Scene
    rotation, translation : ndarray (3, 3), (3,)
        Of camera_from_map; changed in place, unless the score would fall.
    vertical : ndarray (7,)
        Up in the camera (3,) and in the map (3,), unit vectors, and the standard deviation of the
        angle between them [rad]; 0 where it is not known.
    workspace : Workspace
        Holds the matches of the refined pose afterwards.

    Returns
    -------
    score : float
        See verify.
    information : ndarray (6, 6)
        Of the camera's position [m] and its rotation about the map's axes [rad].
    """
    score = verify(scene, rotation, translation, workspace)
    information = np.zeros((6, 6))
    new_rotation, new_translation = rotation.copy(), translation.copy()
    detections = np.empty(len(workspace.landmarks), dtype=np.int64)
    landmarks = np.empty(len(workspace.landmarks), dtype=np.int64)
    for _ in range(_ROUNDS):
        count = _one_to_one(workspace, detections, landmarks)
        if count < 3:
            break
        _minimize(scene, detections[:count], landmarks[:count], vertical, new_rotation,
                  new_translation, information)
        new_score = verify(scene, new_rotation, new_translation, workspace)
        if not new_score > score * (1.0 + _SETTLED):
            break
        score = new_score
        rotation[:] = new_rotation
        translation[:] = new_translation
    return verify(scene, rotation, translation, workspace), information


@compiled
def _one_to_one(workspace, detections, landmarks):
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
def _minimize(scene, detections, landmarks, vertical, rotation, translation, information):
    """Move a pose to where the robust sum of squares is least, and write its information."""
    count = 4 * len(detections) + 3
    residuals, moved = np.empty(count), np.empty(count)
    jacobian = np.empty((count, 6))
    weights = np.empty(count)
    gradient, step = np.empty(6), np.zeros(6)
    damped = np.empty((6, 6))
    trial_rotation, trial_translation = rotation.copy(), translation.copy()
    damping = _FIRST_DAMPING
    if not _residuals(scene, detections, landmarks, vertical, rotation, translation, residuals):
        return
    cost = _robust_cost(residuals)
    for _ in range(_STEPS):
        for axis in range(6):  # forward differences
            step[:] = 0.0
            step[axis] = _DIFFERENCE
            _move(rotation, translation, step, trial_rotation, trial_translation)
            if not _residuals(scene, detections, landmarks, vertical, trial_rotation,
                              trial_translation, moved):
                return
            for row in range(count):
                jacobian[row, axis] = (moved[row] - residuals[row]) / _DIFFERENCE
        for row in range(count):
            weights[row] = 1.0 / (1.0 + (residuals[row] / _CAUCHY) ** 2)
        _normal_equations(jacobian, residuals, weights, information, gradient)
        accepted = False
        for _ in range(4):
            damped[:] = information
            for axis in range(6):
                damped[axis, axis] += damping * information[axis, axis] + 1e-9
            if not _solve(damped, gradient, step):
                return
            if _dot6(step, step) > _LONGEST_STEP * _LONGEST_STEP:
                damping = 10.0 * damping
                continue
            _move(rotation, translation, step, trial_rotation, trial_translation)
            if _residuals(scene, detections, landmarks, vertical, trial_rotation,
                          trial_translation, moved):
                new_cost = _robust_cost(moved)
                if new_cost < cost:
                    accepted = True
                    break
            damping = 10.0 * damping
        if not accepted:
            return
        settled = cost - new_cost < _SETTLED * cost
        cost = new_cost
        residuals[:] = moved
        rotation[:] = trial_rotation
        translation[:] = trial_translation
        damping = 0.1 * damping
        if settled:
            return


@compiled
def _residuals(scene, detections, landmarks, vertical, rotation, translation, residuals):
    """Write by how many deviations outlines miss the edges; False if one is not in front."""
    for row in range(len(detections)):
        box, landmark = scene.box_ellipses[detections[row]], landmarks[row]
        visible, cx, cy, exx, _, eyy = project_ellipsoid(
            rotation, translation, scene.centers[landmark], scene.shapes[landmark])
        if not visible:
            return False
        deviation = RELATIVE_DEVIATION * (box[2] + box[3]) + LEAST_DEVIATION
        half_x, half_y = sqrt(exx), sqrt(eyy)
        residuals[4 * row] = ((cx - half_x) - (box[0] - box[2])) / deviation
        residuals[4 * row + 1] = ((cx + half_x) - (box[0] + box[2])) / deviation
        residuals[4 * row + 2] = ((cy - half_y) - (box[1] - box[3])) / deviation
        residuals[4 * row + 3] = ((cy + half_y) - (box[1] + box[3])) / deviation
    first = 4 * len(detections)
    for axis in range(3):
        residuals[first + axis] = 0.0
        if vertical[6] > 0.0:
            up = (rotation[axis, 0] * vertical[3] + rotation[axis, 1] * vertical[4]
                  + rotation[axis, 2] * vertical[5])
            residuals[first + axis] = (up - vertical[axis]) / vertical[6]
    return True


@compiled
def _robust_cost(residuals):
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
def _move(rotation, translation, step, new_rotation, new_translation):
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
def _solve(matrix, right, solution):
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


@compiled
def _dot6(a, b):
    total = 0.0
    for i in range(6):
        total += a[i] * b[i]
    return total
