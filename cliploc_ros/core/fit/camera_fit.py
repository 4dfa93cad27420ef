# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The systematic errors of a camera and its boxes, fitted together with one pose.

A wrong camera_info, boxes in the pixels of another image, and boxes by another convention displace
all boxes of a camera systematically. A box with centre c and half size h on the plane z = 1 is
corrected to

    h' = exp(-size) h / scale,    c' = (c - shift) / scale - 2 corner h',

on both axes, where scale is exp(focal + aspect / 2) in x and exp(focal - aspect / 2) in y. The
errors are the seven numbers

    focal, aspect, shift x and y, corner x and y, size,

which are 0 for a right camera. Shifts are lengths on the plane z = 1, corners are shares of a
box's sides, and the other errors are logarithms. A roll error is not among them, because the pose
absorbs it.

Pose and errors are fitted to the edges of the boxes of one frame (Levenberg and Marquardt, see
refinement). The pose is then eliminated with the Schur complement, which leaves the information
about the errors alone. A frame of eight objects determines the focal length to 15 to 25 %. Many
frames determine it better.
"""

from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.refinement import (
    jacobian_of,
    move,
    normal_equations,
    residuals_of,
    robust_cost,
    solve,
)
from cliploc_ros.core.kernels.compiled import compiled

#: Number of errors of a camera.
ERRORS = 7
# Focal length and distance are correlated along a curved valley of the cost, so a fit takes 15 to
# 40 steps of 10 us.
_STEPS, _TRIALS = 40, 5
_FIRST_DAMPING, _SETTLED = 1e-3, 1e-5
# For steps longer than this, in metres and radians, the residuals are far from linear.
_LONGEST_STEP = 1.0
# Information about a direction that no box determines [1 / m^2] [1 / rad^2].
_LEAST_INFORMATION = 0.01
# Limit of the residuals in the mean square.
_MOST_RESIDUAL = 4.0


class CameraFit(NamedTuple):
    """The errors of a camera, estimated from one frame with the pose eliminated."""

    errors: NDArray[np.float64]  #: (7,): the most likely errors, given their prior deviations
    information: NDArray[np.float64]  #: (7, 7): information of the boxes alone about the errors
    square: float  #: Sum of the squared residuals after the fit


@compiled
def corrected(pairs, errors):
    """Return matches (m, 16), see residuals_of, with boxes corrected for errors of the camera."""
    found = pairs.copy()
    for axis in range(2):
        scale = exp(errors[0] + (0.5 - axis) * errors[1])
        for row in range(len(pairs)):
            half = pairs[row, 2 + axis] * exp(-errors[6]) / scale
            found[row, axis] = ((pairs[row, axis] - errors[2 + axis]) / scale
                                - 2.0 * errors[4 + axis] * half)
            found[row, 2 + axis] = half
    for row in range(len(pairs)):
        found[row, 13] = pairs[row, 13] * exp(-errors[0])
    return found


@compiled
def camera_jacobian(pairs, vertical, errors, rotation, translation, residuals):
    """Return the Jacobian (5 * m + 3, 13) of the residuals with respect to pose and errors.

    Parameters
    ----------
    pairs : ndarray (m, 16)
        Matches with boxes corrected for the errors.
    residuals : ndarray (5 * m + 3,)
        Residuals of these matches. For the other parameters see residuals_of.
    """
    jacobian = np.zeros((5 * len(pairs) + 3, 6 + ERRORS))
    jacobian[:, :6] = jacobian_of(pairs, vertical, rotation, translation)
    for row in range(len(pairs)):
        box = pairs[row]
        for axis in range(2):
            scale = exp(errors[0] + (0.5 - axis) * errors[1])
            half = box[2 + axis] / box[13]
            for side in range(2):
                sign, number = 2.0 * side - 1.0, 5 * row + 2 * axis + side
                edge = box[axis] / box[13] + sign * half
                jacobian[number, 6] = edge + residuals[number]
                jacobian[number, 7] = (0.5 - axis) * edge
                jacobian[number, 8 + axis] = 1.0 / (scale * box[13])
                jacobian[number, 10 + axis] = 2.0 * half
                jacobian[number, 12] = (sign - 2.0 * errors[4 + axis]) * half
    return jacobian


@compiled
def fit_camera(pairs, is_edge, vertical, rotation, translation, deviations):
    """Fit the errors of a camera together with its pose to the boxes of one frame: CameraFit.

    Parameters
    ----------
    pairs, vertical, rotation, translation
        See residuals_of. The pose is near the best pose of a camera without errors.
    is_edge : ndarray (m, 4) of bool
        Whether the left, right, top and bottom edges are edges of the object. Edges that are cut
        by the border of the image are ignored: they would seem to shift and shrink all boxes.
    deviations : ndarray (7,)
        Standard deviations of the errors before any box is seen.
    """
    errors, damping = np.zeros(ERRORS), _FIRST_DAMPING
    residuals, cost = _cost(pairs, is_edge, vertical, errors, rotation, translation, deviations)
    information, gradient = _equations(pairs, is_edge, vertical, errors, rotation, translation,
                                       residuals)
    step = np.zeros(6 + ERRORS)
    for _ in range(_STEPS):
        for axis in range(ERRORS):
            information[6 + axis, 6 + axis] += deviations[axis] ** -2
            gradient[6 + axis] -= errors[axis] * deviations[axis] ** -2
        improved, new_cost = False, cost
        for _ in range(_TRIALS):
            damped = information.copy()
            for axis in range(6 + ERRORS):
                damped[axis, axis] *= 1.0 + damping
            if not solve(damped, gradient, step):
                break
            if np.sum(step[:6] ** 2) > _LONGEST_STEP ** 2:
                damping = 10.0 * damping
                continue
            new_rotation, new_translation = move(rotation, translation, step)
            new_residuals, new_cost = _cost(pairs, is_edge, vertical, errors + step[6:],
                                            new_rotation, new_translation, deviations)
            if new_cost < cost:
                improved = True
                break
            damping = 10.0 * damping
        if improved:
            settled = cost - new_cost < _SETTLED * cost
            errors = errors + step[6:]
            rotation, translation = new_rotation, new_translation
            residuals, cost = new_residuals, new_cost
            damping = 0.1 * damping
        information, gradient = _equations(pairs, is_edge, vertical, errors, rotation,
                                           translation, residuals)
        if not improved or settled:
            break
    last, own = _moves(information), information[6:, 6:].copy()
    for row in range(ERRORS):
        for column in range(ERRORS):
            for axis in range(6):
                own[row, column] += information[6 + row, axis] * last[axis, column]
    square = np.sum(np.minimum(np.abs(residuals[:5 * len(pairs)]), _MOST_RESIDUAL) ** 2)
    return CameraFit(errors, 0.5 * (own + own.T), square)


@compiled
def _cost(pairs, is_edge, vertical, errors, rotation, translation, deviations):
    """Return the residuals and the cost, infinite if a landmark is not in front of the camera."""
    residuals = np.zeros(5 * len(pairs) + 3)
    if not residuals_of(corrected(pairs, errors), vertical, rotation, translation, residuals):
        return residuals, np.inf
    for row in range(len(pairs)):
        for edge in range(4):
            if not is_edge[row, edge]:
                residuals[5 * row + edge] = 0.0
    return residuals, robust_cost(residuals) + np.sum((errors / deviations) ** 2)


@compiled
def _equations(pairs, is_edge, vertical, errors, rotation, translation, residuals):
    """Return the information (13, 13) and gradient (13,) of the boxes for pose and errors."""
    jacobian = camera_jacobian(corrected(pairs, errors), vertical, errors, rotation, translation,
                               residuals)
    for row in range(len(pairs)):
        for edge in range(4):
            if not is_edge[row, edge]:
                jacobian[5 * row + edge] = 0.0
    information, gradient = normal_equations(jacobian, residuals)
    for axis in range(6):
        information[axis, axis] += _LEAST_INFORMATION
    return information, gradient


@compiled
def _moves(information):
    """Return the Jacobian (6, 7) of the best pose with respect to the errors."""
    moves, column = np.zeros((6, ERRORS)), np.zeros(6)
    for error in range(ERRORS):
        if not solve(information[:6, :6].copy(), -information[:6, 6 + error].copy(), column):
            break
        moves[:, error] = column
    return moves
