# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refinement of a pose on all of its inliers, in one frame or several.

A minimal pose fits three box centres. Refinement fits the edges of all inliers, which the outlines
should touch. Each match has four residuals, in units of their standard deviation. The deviation
combines a share of the box's size, because the errors of detector and shape grow with the object,
and the landmark's position_sigma as seen by the camera. A fifth residual is the depth of the
landmark's centre if depth was measured. Cauchy's weights limit the influence of outliers (Triggs
et al., "Bundle Adjustment", 1999).

Of the residuals that were tested on the 258 recorded frames, edges solved the most frames with the
smallest error. The others were the Wasserstein distance of ellipses, the level sets of Zins et al.
("Level Set-Based Camera Pose Estimation From Multiple 2D/3D Ellipse-Ellipsoid Correspondences",
IROS 2022), and logarithms of sizes. Edges that the image border cuts are used like the others:
omitting them, or making them one-sided, did not solve more frames.

The robust cost, summed over all frames, is minimized by the Levenberg-Marquardt method. If the
reference camera moves by a and turns by w about its centre, a camera at the lever l from it moves
by a + w x l and turns by w. The information H and gradient g of this camera therefore enter as
A^T H A and A^T g with A = [1, -[l]; 0, 1].
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.verification import camera_pose, verify_rig
from cliploc_ros.core.geometry.depth import centre_depth, depth_of
from cliploc_ros.core.geometry.ellipsoid import project_ellipsoid
from cliploc_ros.core.kernels.compiled import compiled

# Standard deviation of an edge if the landmark's position is exact: a share of the mean of the
# box's two sides, plus a constant of about a pixel on the plane z = 1. The share is close to the
# median error of boxes and fitted maps on the recorded frames, on which the maps were fitted, too.
# The constant is a guess.
RELATIVE_DEVIATION = 0.06
LEAST_DEVIATION = 0.003

# Residuals beyond this many standard deviations lose influence, because some edges of maps and
# boxes are far off.
_CAUCHY = 1.0
# A round may lower the score to this share of the best score, because a fit of many edges is
# closer to the truth than the greatest overlap. A lower score means that landmarks were lost.
LEAST_SHARE = 0.9
_ROUNDS = 4
_STEPS = 5
_TRIALS = 4
_FIRST_DAMPING = 1e-3
_SETTLED = 1e-5
# For steps longer than this, in metres and radians, the residuals are far from linear.
_LONGEST_STEP = 1.0


@compiled
def residuals_of(pairs, vertical, rotation, translation, residuals):
    """Write the residuals of all matches; return False if a landmark is not in front.

    Parameters
    ----------
    pairs : ndarray (m, 16)
        Box ellipse (4,), centre (3,) and shape (6,) of the landmark, edge_deviation and
        centre_depth (2,) of each match.
    vertical : ndarray (7,)
        See VERTICAL_UNKNOWN.
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map.
    residuals : ndarray (5 * m + 3,)
        Residuals, in standard deviations, of the left, right, top and bottom edges and the depth
        of each match, and of the vertical.
    """
    for row in range(len(pairs)):
        box = pairs[row]
        in_front, cx, cy, exx, _, eyy = project_ellipsoid(
            rotation, translation, pairs[row, 4:7], pairs[row, 7:13])
        if not in_front:
            return False
        deviation = box[13]
        half_x, half_y = sqrt(exx), sqrt(eyy)
        residuals[5 * row] = ((cx - half_x) - (box[0] - box[2])) / deviation
        residuals[5 * row + 1] = ((cx + half_x) - (box[0] + box[2])) / deviation
        residuals[5 * row + 2] = ((cy - half_y) - (box[1] - box[3])) / deviation
        residuals[5 * row + 3] = ((cy + half_y) - (box[1] + box[3])) / deviation
        residuals[5 * row + 4] = 0.0
        if box[15] > 0.0:
            depth = depth_of(rotation, translation, box[4:7])
            residuals[5 * row + 4] = (depth - box[14]) / box[15]
    first = 5 * len(pairs)
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

    It is computed at the pose at which the match was found, and then kept. If it followed the
    pose, moving the camera away from uncertain landmarks would lower the cost.

    Parameters
    ----------
    box, center : ndarray (4,), (3,)
        Box ellipse, and centre of the landmark [m].
    sigma : float
        Standard deviation of the centre on each axis [m].
    rotation, translation : ndarray (3, 3), (3,)
        Rotation and translation of camera_from_map.
    """
    # the sum of the semi-axes is the mean of the sides
    own = RELATIVE_DEVIATION * (box[2] + box[3]) + LEAST_DEVIATION
    depth = depth_of(rotation, translation, center)
    seen = sigma / depth if depth > 0.0 else 0.0
    return sqrt(own * own + seen * seen)


@compiled
def robust_cost(residuals):
    """Return the sum of Cauchy's losses of the residuals."""
    total = 0.0
    for residual in residuals:
        if residual != 0.0:
            total += np.log1p((residual / _CAUCHY) ** 2)
    return total


@compiled
def jacobian_of(pairs, vertical, rotation, translation):
    """Return the derivatives (5 * m + 3, 6) of the residuals, see residuals_of.

    Columns are the camera's position [m] and rotations about the map's axes [rad].
    """
    jacobian = np.zeros((5 * len(pairs) + 3, 6))
    for row in range(len(pairs)):
        center, deviation, depth = pairs[row, 4:7], pairs[row, 15], jacobian[5 * row + 4]
        _differentiate(center, pairs[row, 7:13], rotation, translation, pairs[row, 13],
                       jacobian[5 * row:5 * row + 4])
        if deviation > 0.0:  # the residual of a depth is axis @ (center - camera)
            for axis in range(3):
                j, k = (axis + 1) % 3, (axis + 2) % 3
                ray_j, ray_k = center[j], center[k]
                for i in range(3):
                    ray_j += rotation[i, j] * translation[i]
                    ray_k += rotation[i, k] * translation[i]
                depth[axis] = -rotation[2, axis] / deviation
                depth[3 + axis] = (rotation[2, j] * ray_k - rotation[2, k] * ray_j) / deviation
    if vertical[6] > 0.0:  # a rotation by a adds -a x up
        up, own = np.empty(3), jacobian[5 * len(pairs):]
        for i in range(3):
            up[i] = (rotation[i, 0] * vertical[3] + rotation[i, 1] * vertical[4]
                     + rotation[i, 2] * vertical[5])
        for axis in range(3):
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                own[i, 3 + axis] = (rotation[k, axis] * up[j]
                                    - rotation[j, axis] * up[k]) / vertical[6]
    return jacobian


@compiled
def _differentiate(center, shape, rotation, translation, deviation, jacobian):
    """Write the derivatives (4, 6) of the edges of a landmark in front of the camera.

    In the camera's coordinate frame, the dual conic is G = M - X X^T, up to sign and scale. A
    translation of the camera by a changes G by dG = a X^T + X a^T. A rotation by a changes it by
    dG = B + B^T with B = -[a] G. N is G scaled so that its last element is 1. Then cx and cy are
    its last column, and exx = cx^2 - N00.
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
def normal_equations(jacobian, residuals):
    """Return information (k, k) and gradient (k,) with Cauchy's weights; jacobian (r, k)."""
    size = jacobian.shape[1]
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for row in range(len(residuals)):
        if residuals[row] == 0.0 and not jacobian[row].any():
            continue  # an unknown depth or vertical
        weight = 1.0 / (1.0 + (residuals[row] / _CAUCHY) ** 2)
        for i in range(size):
            weighted = jacobian[row, i] * weight
            gradient[i] -= weighted * residuals[row]
            for j in range(i, size):
                information[i, j] += weighted * jacobian[row, j]
    for i in range(size):
        for j in range(i):
            information[i, j] = information[j, i]
    return information, gradient


class Refined(NamedTuple):
    """A refined pose of the reference camera."""

    #: (3, 3), (3,): rotation and translation of camera_from_map
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    score: float  #: Sum of the IoUs, see verify_rig
    #: (6, 6): information about the reference camera's position [m] and its rotation about the
    #: map's axes [rad]; 0 if the pose has too few inliers
    information: NDArray[np.float64]


class Inliers(NamedTuple):
    """The m matches of F frames, with one detection for each landmark of a frame."""

    pairs: NDArray[np.float64]  #: (m, 16): see residuals_of
    landmarks: NDArray[np.int64]  #: (m,): rows of the landmarks in the map
    starts: NDArray[np.int64]  #: (F + 1,): first match of each frame, then m
    #: (F, 3, 4), (F, 7): cameras and verticals of the rig, see Rig
    cameras: NDArray[np.float64]
    verticals: NDArray[np.float64]


@compiled
def refine_rig(rig, rotation, translation):
    """Refine a pose (3, 3), (3,) of the reference camera on all frames: Refined.

    Each round matches detections with landmarks and fits the pose to the matches. The rounds end
    when the score converges or drops.
    """
    found = verify_rig(rig, rotation, translation)
    best_score = found.score
    # minimum number of boxes that determine a pose
    least = 3
    for vertical in rig.verticals:
        if vertical[6] > 0.0:
            least = 2
    for _ in range(_ROUNDS):
        inliers = one_to_one(rig, found, rotation, translation)
        if len(inliers.pairs) < least:
            break
        new_rotation, new_translation = _minimize(inliers, rotation, translation)
        new = verify_rig(rig, new_rotation, new_translation)
        if new.score < LEAST_SHARE * best_score:
            break
        settled = abs(new.score - found.score) <= _SETTLED * found.score
        best_score = max(best_score, new.score)
        rotation, translation, found = new_rotation, new_translation, new
        if settled:
            break
    inliers = one_to_one(rig, found, rotation, translation)
    information = np.zeros((6, 6))
    if len(inliers.pairs) >= least:
        in_front, residuals = residuals_of_rig(inliers, rotation, translation)
        if in_front:
            information, _ = linearize_rig(inliers, rotation, translation, residuals)
    return Refined(rotation, translation, found.score, information)


@compiled
def one_to_one(rig, found, rotation, translation):
    """Return the inliers of a verified pose, with the best detection of each landmark."""
    scene, frames = rig.scene, rig.starts.boxes
    pairs, starts = np.empty((len(found.ious), 16)), np.zeros(len(frames), dtype=np.int64)
    landmarks = np.empty(len(pairs), dtype=np.int64)
    count = 0
    for frame in range(len(frames) - 1):
        own_rotation, own_translation = camera_pose(rig.cameras[frame], rotation, translation)
        for detection in range(frames[frame], frames[frame + 1]):
            landmark = found.landmarks[detection]
            best = _best_detection(found, detection, frames[frame], frames[frame + 1])
            if landmark < 0 or best < 0:
                continue
            pairs[count, :4] = scene.box_ellipses[best]
            pairs[count, 4:7] = scene.centers[landmark]
            pairs[count, 7:13] = scene.shapes[landmark]
            pairs[count, 13] = edge_deviation(scene.box_ellipses[best], scene.centers[landmark],
                                              rig.sigmas[landmark], own_rotation, own_translation)
            pairs[count, 14], pairs[count, 15] = centre_depth(
                scene.depths[best], scene.centers[landmark], scene.shapes[landmark],
                rig.sigmas[landmark], own_rotation, own_translation)
            landmarks[count] = landmark
            count += 1
        starts[frame + 1] = count
    return Inliers(pairs[:count], landmarks[:count], starts, rig.cameras, rig.verticals)


@compiled
def _best_detection(found, detection, first, last):
    """Return the best detection of a detection's landmark; -1 if it is not its first detection."""
    best = detection
    for other in range(first, last):
        if found.landmarks[other] == found.landmarks[detection]:
            if other < detection:
                return -1
            if found.ious[other] > found.ious[best]:
                best = other
    return best


@compiled
def residuals_of_rig(inliers, rotation, translation):
    """Return whether all landmarks are in front of their cameras, and all residuals."""
    pairs, _, starts, cameras, verticals = inliers
    residuals = np.empty(5 * len(pairs) + 3 * len(cameras))
    for frame in range(len(cameras)):
        own_rotation, own_translation = camera_pose(cameras[frame], rotation, translation)
        first, last = starts[frame], starts[frame + 1]
        if not residuals_of(pairs[first:last], verticals[frame], own_rotation,
                            own_translation,
                            residuals[5 * first + 3 * frame:5 * last + 3 * frame + 3]):
            return False, residuals
    return True, residuals


@compiled
def linearize_rig(inliers, rotation, translation, residuals):
    """Return information (6, 6) and gradient (6,) of all frames for steps of the reference."""
    pairs, _, starts, cameras, verticals = inliers
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    for frame in range(len(cameras)):
        own_rotation, own_translation = camera_pose(cameras[frame], rotation, translation)
        first, last = starts[frame], starts[frame + 1]
        own_information, own_gradient = normal_equations(
            jacobian_of(pairs[first:last], verticals[frame], own_rotation, own_translation),
            residuals[5 * first + 3 * frame:5 * last + 3 * frame + 3])
        lever = np.zeros(3)
        for axis in range(3):
            for row in range(3):
                lever[axis] += (rotation[row, axis] * translation[row]
                                - own_rotation[row, axis] * own_translation[row])
        for axis in range(3):  # the reference turns about this axis: w x l = -[l] w
            i, j = (axis + 1) % 3, (axis + 2) % 3
            own_gradient[3 + axis] += lever[i] * own_gradient[j] - lever[j] * own_gradient[i]
            for row in range(6):
                own_information[row, 3 + axis] += (lever[i] * own_information[row, j]
                                                   - lever[j] * own_information[row, i])
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            for column in range(6):
                own_information[3 + axis, column] += (lever[i] * own_information[j, column]
                                                      - lever[j] * own_information[i, column])
        gradient += own_gradient
        information += own_information
    return information, gradient


@compiled
def _minimize(inliers, rotation, translation):
    """Return the pose with the minimum robust cost (Levenberg-Marquardt)."""
    step, damping = np.zeros(6), _FIRST_DAMPING
    in_front, residuals = residuals_of_rig(inliers, rotation, translation)
    if not in_front:
        return rotation, translation
    cost = robust_cost(residuals)
    for _ in range(_STEPS):
        information, gradient = linearize_rig(inliers, rotation, translation, residuals)
        improved, new_cost = False, cost
        for _ in range(_TRIALS):
            damped = information.copy()
            for axis in range(6):
                damped[axis, axis] += damping * information[axis, axis] + 1e-9
            if not solve(damped, gradient, step):
                return rotation, translation
            if np.sum(step ** 2) > _LONGEST_STEP * _LONGEST_STEP:
                damping = 10.0 * damping
                continue
            new_rotation, new_translation = move(rotation, translation, step)
            in_front, new_residuals = residuals_of_rig(inliers, new_rotation, new_translation)
            if in_front:
                new_cost = robust_cost(new_residuals)
                if new_cost < cost:
                    improved = True
                    break
            damping = 10.0 * damping
        if not improved:
            break
        settled = cost - new_cost < _SETTLED * cost
        rotation, translation = new_rotation, new_translation
        residuals, cost = new_residuals, new_cost
        damping = 0.1 * damping
        if settled:
            break
    return rotation, translation


@compiled
def move(rotation, translation, step):
    """Return camera_from_map after the camera moves by step[:3] and turns by step[3:]."""
    new_rotation, new_translation = np.empty((3, 3)), np.zeros(3)
    angle = sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    sine = sin(angle) / angle if angle > 1e-12 else 1.0
    versine = (1.0 - cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    # Each row of the rotation is a camera axis in the map. It turns with the camera (Rodrigues).
    for row in range(3):
        x, y, z = rotation[row, 0], rotation[row, 1], rotation[row, 2]
        along = (step[3] * x + step[4] * y + step[5] * z) * versine
        cosine = 1.0 - versine * angle * angle
        new_rotation[row, 0] = x * cosine + sine * (step[4] * z - step[5] * y) + along * step[3]
        new_rotation[row, 1] = y * cosine + sine * (step[5] * x - step[3] * z) + along * step[4]
        new_rotation[row, 2] = z * cosine + sine * (step[3] * y - step[4] * x) + along * step[5]
    for axis in range(3):
        center = step[axis]
        for row in range(3):
            center -= rotation[row, axis] * translation[row]
        for row in range(3):
            new_translation[row] -= new_rotation[row, axis] * center
    return new_rotation, new_translation


@compiled
def solve(matrix, right, solution):
    """Solve a symmetric positive definite system by Cholesky's method, and overwrite the matrix.

    Returns False if the matrix is not positive definite.
    """
    size = len(right)
    for i in range(size):
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
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * solution[k]
        solution[i] = total / matrix[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= matrix[k, i] * solution[k]
        solution[i] = total / matrix[i, i]
    return True
