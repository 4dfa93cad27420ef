# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit ellipsoids, each to the edges of its boxes, by robust least squares.

Each edge that does not lie at the image border gives a residual: projected edge minus detected
edge, in standard deviations. An edge at the border only bounds the object: it counts if the
projection ends inside it. A measured depth gives one more residual. Residuals r pass through the
Cauchy loss c^2/2 log(1 + r^2/c^2). A weak prior pulls the logarithms of the semi-axes to their
mean, since boxes from similar directions do not constrain the thickness. With depth, boxes from
one side suffice for a landmark. For the same reason, a semi-axis that is longer than objects of
its class then gives a residual of its logarithm, with the same loss.
"""

from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.offline.mapping.landmarks import (
    LANDMARK_SIZE,
    POSE_SIZE,
    Landmarks,
    group_boxes,
    linearize_box,
    move_ellipsoid,
)
from cliploc_ros.offline.mapping.views import NO_SIZE, Views

#: Scale of the Cauchy loss, in standard deviations of an edge.
LOSS_SCALE = 1.5
# Standard deviation of the logarithm of a semi-axis about the mean of the three. Chosen.
_AXIS_SPREAD = 0.7
# An ellipsoid that is not entirely in front of a camera costs as much as four edges this far off.
_BEHIND_RESIDUAL = 20.0
_BEHIND_COST = 4.0 * 20.0
# Objects are not ellipsoids, and detectors are biased, so the errors of a landmark's boxes are
# correlated: the mean over any number of viewpoints keeps this share of the variance. Chosen on
# TUM fr3 and the demo: .59 and .84 of all errors are within one deviation, .93 and 1.00 within
# three.
_ALIKE = 0.15
_UNKNOWN_M = 1e6
_MAX_DAMPING = 1e7
_LEAST_IMPROVEMENT = 1e-4
# Greatest change in one step: of a logarithm, and of the centre in sizes of the ellipsoid.
_MAX_STEP = 1.0


class Fit(NamedTuple):
    """A fitted ellipsoid."""

    #: (3,), (3, 3): in the map; the basis' columns are the semi-axes [m]
    center: NDArray[np.float64]
    basis: NDArray[np.float64]
    cost: float  #: Robust cost, the prior included


def fit_landmarks(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                  iterations: int = 30, among: NDArray[np.bool_] | None = None) -> Landmarks:
    """Fit landmarks, or those that the mask among (L,) selects, to the boxes that show them."""
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    for number, rows in enumerate(group_boxes(shown, len(centers))):
        if len(rows) and (among is None or among[number]):
            fit = fit_ellipsoid(views, rows, centers[number], bases[number], iterations)
            centers[number], bases[number] = fit.center, fit.basis
    return landmarks._replace(centers=centers, bases=bases)


def fit_ellipsoid(views: Views, rows: NDArray[np.int64], center: NDArray[np.float64],
                  basis: NDArray[np.float64], iterations: int = 30) -> Fit:
    """Fit an ellipsoid to the boxes of some rows, from a start.

    The fit takes at most the given number of Levenberg-Marquardt steps.
    """
    center, basis = center.copy(), basis.copy()
    cost = descend(views, np.ascontiguousarray(rows, dtype=np.int64), center, basis, iterations)
    return Fit(center, basis, cost)


def centre_covariance(views: Views, rows: NDArray[np.int64], center: NDArray[np.float64],
                      basis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (3, 3) [m^2] of a centre that was fitted to the boxes of some rows.

    All modules take the uncertainty of a landmark from here. If the boxes do not constrain the
    centre, the covariance is a large multiple of the identity. The size of the class is ignored.
    """
    information = np.zeros((LANDMARK_SIZE, LANDMARK_SIZE))
    without_sizes = views._replace(sizes=np.full_like(views.sizes, NO_SIZE))
    accumulate(without_sizes, rows, center, basis, information, np.zeros(LANDMARK_SIZE))
    alike = 1.0 + _ALIKE * len(np.unique(views.viewpoints[views.frames[rows]]))
    try:
        covariance = alike * np.linalg.inv(information)[:3, :3]
    except np.linalg.LinAlgError:  # boxes cut off on all sides constrain nothing
        covariance = np.full((3, 3), np.nan)
    # rounding makes unconstrained directions negative
    is_known = np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0.0
    return covariance if is_known else _UNKNOWN_M ** 2 * np.eye(3)


@compiled
def descend(views, rows, center, basis, iterations):
    """Improve center and basis in place, and return the cost."""
    information, gradient = np.zeros((LANDMARK_SIZE, LANDMARK_SIZE)), np.zeros(LANDMARK_SIZE)
    trial_information, trial_gradient = information.copy(), gradient.copy()
    trial_center, trial_basis = center.copy(), basis.copy()
    cost = accumulate(views, rows, center, basis, information, gradient)
    damping = 1e-3
    for _ in range(iterations):
        damped = information + np.diag(damping * np.diag(information) + 1e-9)
        step = np.linalg.solve(damped, -gradient)
        limit_step(step, basis)
        move_ellipsoid(center, basis, step, trial_center, trial_basis)
        trial_cost = accumulate(views, rows, trial_center, trial_basis, trial_information,
                                trial_gradient)
        if trial_cost < cost:
            improvement = cost - trial_cost
            center[:], basis[:] = trial_center, trial_basis
            information[:], gradient[:] = trial_information, trial_gradient
            cost = trial_cost
            damping *= 0.2
            if improvement < _LEAST_IMPROVEMENT * cost:
                break
        else:
            damping *= 5.0
            if damping > _MAX_DAMPING:
                break
    return cost


@compiled
def limit_step(step, basis):
    """Shorten a step (9,) that exceeds the range of its linearization."""
    size = sqrt((basis * basis).sum())
    length = sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    largest = max(length / size, np.abs(step[3:]).max())
    if largest > _MAX_STEP:
        step *= _MAX_STEP / largest


@compiled
def accumulate(views, rows, center, basis, information, gradient):
    """Write the normal equations of one landmark; return its cost."""
    information[:] = 0.0
    gradient[:] = 0.0
    box = np.empty(4)
    by_landmark, by_pose = np.empty((4, LANDMARK_SIZE)), np.empty((4, POSE_SIZE))
    cost = 0.0
    for row in rows:
        frame = views.frames[row]
        share = views.weights[frame]
        if not linearize_box(views.rotations[frame], views.translations[frame], center, basis,
                             box, by_landmark, by_pose):
            cost += share * 4.0 * robust_cost(_BEHIND_RESIDUAL)
            continue
        for edge in range(4):
            residual = edge_residual(views, row, edge, box)
            cost += share * robust_cost(residual)
            stiffness = views.stiffness[row, edge]
            weight = share * robust_weight(residual)
            if residual == 0.0:
                continue
            for i in range(LANDMARK_SIZE):
                scaled = weight * stiffness * by_landmark[edge, i]
                gradient[i] += scaled * residual
                for j in range(i + 1):
                    information[i, j] += scaled * stiffness * by_landmark[edge, j]
        cost += share * add_depth(views, row, center, share, information, gradient)
    size = _largest(views.sizes[rows], np.zeros_like(rows), 1)[0]
    cost += add_axis_prior(basis, size, information, gradient)
    information += np.tril(information, -1).T
    return cost


@compiled
def add_depth(views, row, center, share, information, gradient):
    """Add the measured depth of a box to the normal equations; return its cost."""
    stiffness = views.depth_stiffness[row]
    if stiffness == 0.0:
        return 0.0
    frame = views.frames[row]
    direction = views.rotations[frame, 2]
    depth = views.translations[frame, 2]
    for i in range(3):
        depth += direction[i] * center[i]
    residual = (depth - views.depths[row]) * stiffness
    weight = share * robust_weight(residual)
    for i in range(3):
        scaled = weight * stiffness * direction[i]
        gradient[i] += scaled * residual
        for j in range(i + 1):
            information[i, j] += scaled * stiffness * direction[j]
    return robust_cost(residual)


@compiled
def edge_residual(views, row, edge, box):
    """Return the residual of a projected edge, in standard deviations."""
    residual = (box[edge] - views.edges[row, edge]) * views.stiffness[row, edge]
    if views.is_open[row, edge]:
        return max(0.0, residual) if edge < 2 else min(0.0, residual)
    return residual


@compiled
def robust_cost(residual):
    """Return the Cauchy loss of a residual."""
    ratio = residual / LOSS_SCALE
    return 0.5 * LOSS_SCALE * LOSS_SCALE * log(1.0 + ratio * ratio)


@compiled
def robust_weight(residual):
    """Return the weight of a residual in the next step."""
    ratio = residual / LOSS_SCALE
    return 1.0 / (1.0 + ratio * ratio)


@compiled
def _largest(sizes, numbers, count):
    """Return the largest size (count, 2) among the boxes (m, 2) of each landmark."""
    largest = np.full((count, 2), -np.inf)
    for place in range(len(sizes)):
        if sizes[place, 0] > largest[numbers[place], 0]:
            largest[numbers[place]] = sizes[place]
    return largest


@compiled
def add_axis_prior(basis, size, information, gradient):
    """Add the prior on the semi-axes to the normal equations; return its cost.

    The logarithm of a semi-axis changes by half of its diagonal element of D. The size (2,) is
    the entry of Views.sizes for the largest class among the landmark's boxes.
    """
    logs = np.empty(3)
    for k in range(3):
        logs[k] = log(sqrt(basis[0, k] ** 2 + basis[1, k] ** 2 + basis[2, k] ** 2))
    mean = logs.mean()
    cost = 0.0
    diagonal = (3, 6, 8)  # indices of D's diagonal among the numbers of a landmark
    for k in range(3):
        residual = (logs[k] - mean) / _AXIS_SPREAD
        cost += 0.5 * residual * residual
        excess = (logs[k] - size[0]) * size[1]
        if excess > 0.0:
            cost += robust_cost(excess)
            weight = robust_weight(excess)
            gradient[diagonal[k]] += 0.5 * weight * size[1] * excess
            information[diagonal[k], diagonal[k]] += 0.25 * weight * size[1] * size[1]
        slopes = (0.5 * (np.arange(3) == k) - 1.0 / 6.0) / _AXIS_SPREAD
        for i in range(3):
            gradient[diagonal[i]] += slopes[i] * residual
            for j in range(i + 1):
                information[diagonal[i], diagonal[j]] += slopes[i] * slopes[j]
    # The off-diagonal numbers rotate the axes, which boxes of a sphere do not constrain: weak
    # damping without a target keeps the equations regular.
    for off in (4, 5, 7):
        information[off, off] += 0.5 / (_AXIS_SPREAD * _AXIS_SPREAD)
    return cost


class Linear(NamedTuple):
    """m boxes that show landmarks: residuals, their weights, derivatives by landmark and pose."""

    #: (m,): rows of the boxes, and the landmark that each shows
    rows: NDArray[np.int64]
    numbers: NDArray[np.int64]
    #: (m, 4), (m, 4), (m, 4, 9), (m, 4, 6): in standard deviations; open edges weigh 0
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    by_landmark: NDArray[np.float64]
    by_pose: NDArray[np.float64]


def linearize_boxes(views: Views, shown: NDArray[np.int64], landmarks: Landmarks) -> Linear:
    """Return residuals and derivatives of the boxes that show landmarks."""
    rows = np.nonzero(shown >= 0)[0]
    linear = Linear(rows, shown[rows], np.zeros((len(rows), 4)), np.zeros((len(rows), 4)),
                    np.zeros((len(rows), 4, LANDMARK_SIZE)), np.zeros((len(rows), 4, POSE_SIZE)))
    _linearize_all(views, landmarks.centers, landmarks.bases, *linear)
    return linear


@compiled
def _linearize_all(views, centers, bases, rows, numbers, residuals, weights, by_landmark, by_pose):
    """Write residuals, weights and derivatives, in standard deviations; open edges weigh 0."""
    box = np.empty(4)
    for place in range(len(rows)):
        row, number = rows[place], numbers[place]
        frame = views.frames[row]
        if not linearize_box(views.rotations[frame], views.translations[frame], centers[number],
                             bases[number], box, by_landmark[place], by_pose[place]):
            continue
        for edge in range(4):
            if views.is_open[row, edge]:
                continue
            residuals[place, edge] = edge_residual(views, row, edge, box)
            weights[place, edge] = robust_weight(residuals[place, edge])
            by_landmark[place, edge] *= views.stiffness[row, edge]
            by_pose[place, edge] *= views.stiffness[row, edge]


@compiled
def move_all(centers, bases, steps, new_centers, new_bases):
    """Write ellipsoids moved by steps (L, 9), each within the range of its linearization."""
    for number in range(len(centers)):
        limit_step(steps[number], bases[number])
        move_ellipsoid(centers[number], bases[number], steps[number], new_centers[number],
                       new_bases[number])


@compiled
def accumulate_all(views, rows, landmarks, centers, bases, of_landmarks, of_poses, of_boxes,
                   landmark_gradient, pose_gradient):
    """Add up the normal equations of all boxes; return their cost, including the axis prior."""
    cost, box = 0.0, np.empty(4)
    sizes = _largest(views.sizes[rows], landmarks, len(centers))
    by_landmark, by_motion = np.empty((4, LANDMARK_SIZE)), np.empty((4, POSE_SIZE))
    for place in range(len(rows)):
        row, landmark = rows[place], landmarks[place]
        frame = views.frames[row]
        rotation = views.rotations[frame]
        share = views.weights[frame]
        if not linearize_box(rotation, views.translations[frame], centers[landmark],
                             bases[landmark], box, by_landmark, by_motion):
            cost += share * _BEHIND_COST
            continue
        # a pose error in the map's axes moves the map the opposite way in the camera's axes
        by_pose = np.concatenate((-by_motion[:, :3] @ rotation, -by_motion[:, 3:] @ rotation),
                                 axis=1)
        by_pose[:, 3:] += np.cross(views.levers[frame], by_pose[:, :3])
        for edge in range(4):
            residual = edge_residual(views, row, edge, box)
            if residual == 0.0:
                continue
            cost += share * robust_cost(residual)
            stiffness = views.stiffness[row, edge]
            weight = share * robust_weight(residual) * stiffness * stiffness
            pull = share * robust_weight(residual) * stiffness * residual
            for i in range(LANDMARK_SIZE):
                landmark_gradient[landmark, i] += pull * by_landmark[edge, i]
                for j in range(LANDMARK_SIZE):
                    of_landmarks[landmark, i, j] += (weight * by_landmark[edge, i]
                                                     * by_landmark[edge, j])
            for i in range(POSE_SIZE):
                pose_gradient[frame, i] += pull * by_pose[edge, i]
                for j in range(POSE_SIZE):
                    of_poses[frame, i, j] += weight * by_pose[edge, i] * by_pose[edge, j]
                for j in range(LANDMARK_SIZE):
                    of_boxes[place, i, j] += weight * by_pose[edge, i] * by_landmark[edge, j]
    for landmark in range(len(centers)):
        lower = np.zeros((LANDMARK_SIZE, LANDMARK_SIZE))
        cost += add_axis_prior(bases[landmark], sizes[landmark], lower,
                               landmark_gradient[landmark])
        of_landmarks[landmark] += lower + np.tril(lower, -1).T
    return cost
