# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pose and covariance from points of the map and where an image shows them."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.kernels.compiled import compiled

#: Fewer inliers determine no pose: three fix it, the others agree with it.
LEAST_INLIERS = 8
# An inlier's reprojection is no further off, as an angle: 3 px at f = 525 px.
_MOST_ERROR = 3.0 / 525.0
_SURE = 0.9999
# Least squares end after some steps, or one that is small [m, rad]; none changes the logarithm of
# the focal length by more.
_STEPS, _SMALL_STEP, _MOST_STEP = 6, 1e-4, 0.3
# Tolerances of the inliers, as multiples: for a pose of three points, and for one with a focal
# length that may be half the true one. None is wrong by more than the logarithm.
_ROUGH, _WRONG_FOCAL, _MOST_LOGARITHM = (2.0, 1.0), (12.0, 6.0, 3.0, 1.0), np.log(10.0)
# Logarithms of the focal lengths of x and y, from those of both and of the aspect.
_OF_X_AND_Y = np.array([[1.0, 1.0], [1.0, -1.0]])
# The least deviation of a feature, as an angle: half a pixel at f = 525 px.
_LEAST_DEVIATION = 0.5 / 525.0
# Points behind the camera count as points before it at this depth [m].
_LEAST_DEPTH = 1e-3
# Standard deviation of a normal distribution over its median of absolute values.
_FROM_MEDIAN = 1.4826


class PointPose(NamedTuple):
    """A pose that many points agree with."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    inliers: NDArray[np.int64]  #: (k,): rows of the points that agree
    #: (6, 6): from the features' deviations alone; in the order of core.fit.covariance
    covariance: NDArray[np.float64]


def find_pose(points: NDArray[np.float64], bearings: NDArray[np.float64], iterations: int = 3000,
              are_best_first: bool = False) -> PointPose | None:
    """Return the pose that most points agree with; None if there is none.

    MSAC of OpenCV finds it, and robust least squares refines it on the inliers. Its own local
    optimization, MAGSAC++ and PoseLib took longer at equal success. Points (n, 3) are in the map
    [m], bearings (n, 2) where the image shows them, on the plane z = 1. Where the best matches are
    first, samples are drawn of them first (PROSAC; Chum and Matas 2005).
    """
    if len(points) < LEAST_INLIERS:
        return None
    options = cv2.UsacParams()
    options.score, options.loMethod = cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_NULL
    if are_best_first:
        options.sampler = cv2.SAMPLING_PROSAC
    options.maxIterations, options.confidence, options.threshold = iterations, _SURE, _MOST_ERROR
    middle = points.mean(axis=0)  # OpenCV computes with floats: keep numbers small
    try:
        found, _, vector, translation, _ = cv2.solvePnPRansac(
            points - middle, bearings, np.eye(3), None, params=options)
    except cv2.error:  # degenerate points
        return None
    if not found or not (np.isfinite(vector).all() and np.isfinite(translation).all()):
        return None
    rotation = cv2.Rodrigues(vector)[0]
    start = make_transform(rotation, translation.ravel() - rotation @ middle)
    return refine(points, bearings, start)


def refine(points: NDArray[np.float64], bearings: NDArray[np.float64],
           camera_from_map: NDArray[np.float64]) -> PointPose | None:
    """Return a pose after least squares with Cauchy's weights; None with too few inliers."""
    found = _fit(points, bearings, _Fit(camera_from_map, np.zeros(2), np.eye(6)), _ROUGH)
    if found is None:
        return None
    fit, inliers = found
    # A step (v, w) from the left of camera_from_map moves the camera's place by -R^T v, and turns
    # it by -R^T w about the map's axes; R is the rotation of camera_from_map.
    turn = np.kron(np.eye(2), -fit.camera_from_map[:3, :3].T)
    covariance = turn @ np.linalg.inv(fit.information) @ turn.T
    return PointPose(invert_transform(fit.camera_from_map), inliers,
                     (covariance + covariance.T) / 2)


def free_focal(points: NDArray[np.float64], bearings: NDArray[np.float64],
               camera_from_map: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]] | None:
    """Return the focal lengths that fit points best; None with too few of them.

    Points that the given focal length keeps from agreeing count, too: the tolerance falls step by
    step. Under a focal length that is half or twice the true one, a pose has but a few of them.

    Parameters
    ----------
    points : ndarray (n, 3)
        All that may agree, in the map [m].
    bearings : ndarray (n, 2)
        As of find_pose, by the given focal length.
    camera_from_map : ndarray (4, 4)
        By the given focal length.

    Returns
    -------
    logarithms, deviations : ndarray (2,)
        Logarithms of the focal length, as a multiple of the given one, and of its aspect, x to y:
        the root of the quotient. Their standard deviations, from those of the features alone.
    inliers : ndarray (k,) of int
        Rows of the points that agree.
    """
    fit = _fit(points, bearings, _Fit(camera_from_map, np.zeros(2), np.eye(8)), _WRONG_FOCAL)
    return fit and (fit[0].logarithms,
                    np.sqrt(np.diag(np.linalg.inv(fit[0].information))[6:]), fit[1])


class _Fit(NamedTuple):
    """A pose, logarithms of the focal length and its aspect (2,), and the information.

    It is of translation and rotation of the camera, and of the logarithms if it is (8, 8); with
    (6, 6) they stay.
    """

    camera_from_map: NDArray[np.float64]
    logarithms: NDArray[np.float64]
    information: NDArray[np.float64]

    @property
    def ratios(self) -> NDArray[np.float64]:
        """Return the focal lengths (2,) of x and y as multiples of the given focal lengths."""
        return np.exp(_OF_X_AND_Y @ self.logarithms)


def _fit(points: NDArray[np.float64], bearings: NDArray[np.float64], fit: _Fit,
         tolerances: tuple[float, ...]) -> tuple[_Fit, NDArray[np.int64]] | None:
    """Fit again and again, to the points within one tolerance after another; None with too few."""
    for tolerance in tolerances:
        inliers = agreeing(points, bearings / fit.ratios, fit.camera_from_map, tolerance)
        if len(inliers) < LEAST_INLIERS:
            return None
        fit = _least_squares(points[inliers], bearings[inliers], fit)
    inliers = agreeing(points, bearings / fit.ratios, fit.camera_from_map)
    is_sound = np.isfinite(fit.information).all() and \
        np.abs(fit.logarithms).max() < _MOST_LOGARITHM and \
        np.linalg.matrix_rank(fit.information) == len(fit.information)
    return (fit, inliers) if is_sound and len(inliers) >= LEAST_INLIERS else None


def agreeing(points: NDArray[np.float64], bearings: NDArray[np.float64],
             camera_from_map: NDArray[np.float64], tolerance: float = 1.0) -> NDArray[np.int64]:
    """Return the rows (k,) of the points that a pose puts where the image shows them."""
    inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - bearings, axis=1)
    return np.nonzero((inside[:, 2] > 0.0) & (errors < tolerance * _MOST_ERROR))[0]


def _least_squares(points: NDArray[np.float64], bearings: NDArray[np.float64], fit: _Fit) -> _Fit:
    """Return a fit after some steps of Gauss and Newton."""
    points, bearings = np.ascontiguousarray(points), np.ascontiguousarray(bearings)
    for _ in range(_STEPS):
        information, gradient = _normal_equations(
            points, bearings, np.ascontiguousarray(fit.camera_from_map), fit.ratios,
            len(fit.information))
        try:
            step = -np.linalg.solve(information, gradient)
        except np.linalg.LinAlgError:  # the points fix no pose
            return fit._replace(information=information)
        step /= max(1.0, np.abs(step[6:]).max(initial=0.0) / _MOST_STEP)
        moved = make_transform(cv2.Rodrigues(step[3:6])[0], step[:3])
        fit = _Fit(moved @ fit.camera_from_map,
                   fit.logarithms + np.append(step[6:], [0.0, 0.0])[:2], information)
        if np.abs(step).max() < _SMALL_STEP:
            break
    return fit


@compiled
def _normal_equations(points, bearings, camera_from_map, ratios, size):
    """Return the information (size, size) and the gradient of a fit with Cauchy's weights.

    The unknowns are a step (v, w) from the left of camera_from_map, and with a size of 8 the
    logarithms of the focal length and its aspect. Residuals are divided by their deviation.
    """
    count = len(points)
    seen, residuals = np.empty((count, 3)), np.empty(2 * count)
    for row in range(count):
        for axis in range(3):
            seen[row, axis] = camera_from_map[axis, 3]
            for other in range(3):
                seen[row, axis] += camera_from_map[axis, other] * points[row, other]
        seen[row, 2] = 1.0 / max(seen[row, 2], _LEAST_DEPTH)
        for axis in range(2):
            seen[row, axis] *= seen[row, 2]
            residuals[2 * row + axis] = seen[row, axis] - bearings[row, axis] / ratios[axis]
    deviation = max(_LEAST_DEVIATION, _FROM_MEDIAN * np.median(np.abs(residuals)))
    information, gradient = np.zeros((size, size)), np.zeros(size)
    jacobian = np.empty((2, 8))
    for row in range(count):
        u, v, one = seen[row]
        # of the residuals times the focal length: else an endless one would fit best
        jacobian[0] = one, 0.0, -u * one, -u * v, 1.0 + u * u, -v, u, u
        jacobian[1] = 0.0, one, -v * one, -1.0 - v * v, u * v, u, v, -v
        square = (residuals[2 * row] ** 2 + residuals[2 * row + 1] ** 2) / deviation ** 2
        weight = 1.0 / (1.0 + square / 4.0) / deviation ** 2
        for i in range(size):
            for axis in range(2):
                weighted = weight * jacobian[axis, i]
                gradient[i] += weighted * residuals[2 * row + axis]
                for j in range(size):
                    information[i, j] += weighted * jacobian[axis, j]
    return information, gradient
