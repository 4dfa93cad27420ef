# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pose and covariance of a camera from points of the map and their positions in the image."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.kernels.compiled import compiled

#: Minimum number of inliers of a pose: three determine it, five confirm it.
LEAST_INLIERS = 8
# Maximum reprojection error of an inlier, as an angle: 3 px at f = 525 px.
_MOST_ERROR = 3.0 / 525.0
# Confidence at which MSAC stops sampling.
_SURE = 0.9999
# Least squares: maximum number of steps, length of a step that ends it [m, rad], and maximum
# change of the logarithm of the focal length in a step.
_STEPS, _SMALL_STEP, _MOST_STEP = 6, 1e-4, 0.3
# Tolerances of the inliers, as multiples of _MOST_ERROR, used one after another: for a pose from
# three points, and for a focal length that may be half the true value; maximum error of the
# logarithm of the focal length.
_ROUGH, _WRONG_FOCAL, _MOST_LOGARITHM = (2.0, 1.0), (12.0, 6.0, 3.0, 1.0), np.log(10.0)
# Maps the logarithms of focal length and aspect to those of the focal lengths of x and y.
_OF_X_AND_Y = np.array([[1.0, 1.0], [1.0, -1.0]])
# Minimum standard deviation of a feature, as an angle: half a pixel at f = 525 px.
_LEAST_DEVIATION = 0.5 / 525.0
# Points behind the camera are treated as points in front of it at this depth [m].
_LEAST_DEPTH = 1e-3
# Ratio of a normal distribution's standard deviation to its median absolute deviation.
_FROM_MEDIAN = 1.4826


class PointPose(NamedTuple):
    """A pose that many points support."""

    map_from_camera: NDArray[np.float64]  #: (4, 4)
    inliers: NDArray[np.int64]  #: (k,): rows of the agreeing points
    #: (6, 6): due to the noise of the features alone; in the order of core.fit.covariance
    covariance: NDArray[np.float64]


def find_pose(points: NDArray[np.float64], bearings: NDArray[np.float64], iterations: int = 3000,
              are_best_first: bool = False) -> PointPose | None:
    """Estimate the pose that most points agree with; return None if it has too few inliers.

    OpenCV's MSAC finds the pose, and robust least squares refines it on the inliers. MSAC's local
    optimization, MAGSAC++ and PoseLib took longer without a higher success rate.

    Parameters
    ----------
    points : ndarray (n, 3)
        Points in the map [m].
    bearings : ndarray (n, 2)
        Their positions in the image, on the plane z = 1.
    are_best_first : bool
        The points are in order of preference: samples are drawn from the first points first
        (PROSAC; Chum and Matas 2005).
    """
    if len(points) < LEAST_INLIERS:
        return None
    options = cv2.UsacParams()
    options.score, options.loMethod = cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_NULL
    if are_best_first:
        options.sampler = cv2.SAMPLING_PROSAC
    options.maxIterations, options.confidence, options.threshold = iterations, _SURE, _MOST_ERROR
    middle = points.mean(axis=0)  # OpenCV uses single precision: keep coordinates small
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
    """Refine a pose (4, 4) by least squares with Cauchy weights; None with too few inliers."""
    found = _fit(points, bearings, _Fit(camera_from_map, np.zeros(2), np.eye(6)), _ROUGH)
    if found is None:
        return None
    fit, inliers = found
    # A step (v, w), applied to camera_from_map from the left, moves the camera by -R^T v and
    # rotates it by -R^T w about the axes of the map; R is the rotation of camera_from_map.
    turn = np.kron(np.eye(2), -fit.camera_from_map[:3, :3].T)
    covariance = turn @ np.linalg.inv(fit.information) @ turn.T
    return PointPose(invert_transform(fit.camera_from_map), inliers,
                     (covariance + covariance.T) / 2)


def free_focal(points: NDArray[np.float64], bearings: NDArray[np.float64],
               camera_from_map: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Estimate the focal lengths that fit the points best; return None with too few inliers.

    The tolerance decreases step by step, because points may disagree only due to a wrong focal
    length. If the given focal length is half or twice the true value, a pose has few inliers.

    Parameters
    ----------
    points : ndarray (n, 3)
        All points that may agree, in the map [m].
    bearings : ndarray (n, 2)
        As in find_pose, computed with the given focal length.
    camera_from_map : ndarray (4, 4)
        Pose estimated with the given focal length.

    Returns
    -------
    logarithms, deviations : ndarray (2,)
        Logarithms of the focal length, as a multiple of the given value, and of its aspect: the
        root of the ratio x to y. Their standard deviations, due to the noise of the features
        alone.
    """
    fit = _fit(points, bearings, _Fit(camera_from_map, np.zeros(2), np.eye(8)), _WRONG_FOCAL)
    return fit and (fit[0].logarithms, np.sqrt(np.diag(np.linalg.inv(fit[0].information))[6:]))


class _Fit(NamedTuple):
    """A pose, the logarithms of focal length and aspect (2,), and the information matrix.

    An information matrix (6, 6) is that of the camera's translation and rotation; the logarithms
    stay constant. With (8, 8), they are estimated, too.
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
    """Fit to the points within each tolerance, one after another; None with too few inliers."""
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
    """Return the rows (k,) of the points that a pose projects to their positions in the image."""
    inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - bearings, axis=1)
    return np.nonzero((inside[:, 2] > 0.0) & (errors < tolerance * _MOST_ERROR))[0]


def _least_squares(points: NDArray[np.float64], bearings: NDArray[np.float64], fit: _Fit) -> _Fit:
    """Return a fit after Gauss-Newton steps."""
    points, bearings = np.ascontiguousarray(points), np.ascontiguousarray(bearings)
    for _ in range(_STEPS):
        information, gradient = _normal_equations(
            points, bearings, np.ascontiguousarray(fit.camera_from_map), fit.ratios,
            len(fit.information))
        try:
            step = -np.linalg.solve(information, gradient)
        except np.linalg.LinAlgError:  # the points do not determine a pose
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
    """Return the information (size, size) and the gradient (size,) of a fit with Cauchy weights.

    The unknowns are a step (v, w), applied to camera_from_map from the left, and, with size 8, the
    logarithms of focal length and aspect. Residuals are divided by their standard deviation.
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
        # Jacobian of the residuals times the focal length: otherwise, an infinite focal length
        # would fit best
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
