# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pose and covariance from points of the map and where an image shows them."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform

#: Fewer inliers determine no pose: three fix it, the others agree with it.
LEAST_INLIERS = 8
# An inlier's reprojection is no further off, as an angle: 3 px at f = 525 px.
_MOST_ERROR = 3.0 / 525.0
_SURE = 0.9999
# A pose of three points is rough: so many times the error makes an inlier at first.
_START_TOLERANCE = 2.0
# Least squares end after so many steps, or after one that is small [m and rad].
_STEPS, _SMALL_STEP = 10, 1e-5
# The least deviation of a feature, as an angle: half a pixel at f = 525 px.
_LEAST_DEVIATION = 0.5 / 525.0
# Of a normal distribution: standard deviation divided by the median of absolute values.
_FROM_MEDIAN = 1.4826


class PointPose(NamedTuple):
    """A pose that many points agree with.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    inliers : ndarray (k,) of int
        Rows of the points that agree.
    covariance : ndarray (6, 6)
        From the features' deviations alone; in the order of core.fit.covariance.
    """

    map_from_camera: NDArray[np.float64]
    inliers: NDArray[np.int64]
    covariance: NDArray[np.float64]


def find_pose(points: NDArray[np.float64], bearings: NDArray[np.float64], iterations: int = 3000
              ) -> PointPose | None:
    """Return the pose that most points agree with; None where there is none.

    MSAC of OpenCV finds it, and robust least squares refines it on the inliers. Its own local
    optimization, MAGSAC++ and PoseLib took longer at equal success.

    Parameters
    ----------
    points : ndarray (n, 3)
        In the map [m].
    bearings : ndarray (n, 2)
        Where the image shows them, on the plane z = 1.
    iterations : int
        Most samples of three points.
    """
    if len(points) < LEAST_INLIERS:
        return None
    options = cv2.UsacParams()
    options.score, options.loMethod = cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_NULL
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
    inliers = agreeing(points, bearings, camera_from_map, _START_TOLERANCE)
    for _ in range(2):
        if len(inliers) < LEAST_INLIERS:
            return None
        camera_from_map, information = _least_squares(points[inliers], bearings[inliers],
                                                      camera_from_map)
        inliers = agreeing(points, bearings, camera_from_map)
    if len(inliers) < LEAST_INLIERS:
        return None
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(covariance).all():
        return None
    return PointPose(invert_transform(camera_from_map), inliers,
                     _about_map_axes(covariance, camera_from_map))


def agreeing(points: NDArray[np.float64], bearings: NDArray[np.float64],
             camera_from_map: NDArray[np.float64], tolerance: float = 1.0) -> NDArray[np.int64]:
    """Return the rows (k,) of the points that a pose puts where the image shows them."""
    inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        errors = np.linalg.norm(inside[:, :2] / inside[:, 2:] - bearings, axis=1)
    return np.nonzero((inside[:, 2] > 0.0) & (errors < tolerance * _MOST_ERROR))[0]


def _least_squares(points: NDArray[np.float64], bearings: NDArray[np.float64],
                   camera_from_map: NDArray[np.float64]
                   ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the refined pose, and its information (6, 6): translation, rotation of the camera."""
    information = np.eye(6)
    for _ in range(_STEPS):
        inside = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        x, y, z = inside.T
        z = np.maximum(z, 1e-3)
        residuals = np.stack([x / z, y / z], axis=1) - bearings
        deviation = max(_LEAST_DEVIATION,
                        _FROM_MEDIAN * float(np.median(np.abs(residuals))))
        zero, one = np.zeros_like(z), 1.0 / z
        by_x = np.stack([one, zero, -x / z**2, -x * y / z**2, 1.0 + (x / z)**2, -y / z], axis=1)
        by_y = np.stack([zero, one, -y / z**2, -1.0 - (y / z)**2, x * y / z**2, x / z], axis=1)
        jacobian = np.stack([by_x, by_y], axis=1) / deviation
        scaled = residuals / deviation
        weights = 1.0 / (1.0 + np.sum(scaled**2, axis=1) / 4.0)
        information = np.einsum('nij,nik,n->jk', jacobian, jacobian, weights)
        gradient = np.einsum('nij,ni,n->j', jacobian, scaled, weights)
        step = -np.linalg.lstsq(information, gradient, rcond=None)[0]
        turn = Rotation.from_rotvec(step[3:]).as_matrix()
        camera_from_map = make_transform(turn, step[:3]) @ camera_from_map
        if np.abs(step).max() < _SMALL_STEP:
            break
    return camera_from_map, information


def _about_map_axes(covariance: NDArray[np.float64], camera_from_map: NDArray[np.float64]
                    ) -> NDArray[np.float64]:
    """Return the covariance of the camera's pose in the map, in ROS order.

    A step (v, w) from the left of camera_from_map moves the camera's place by -R^T v, and turns
    it by -R^T w about the map's axes; R is the rotation of camera_from_map.
    """
    turn = np.kron(np.eye(2), -camera_from_map[:3, :3].T)
    moved = turn @ covariance @ turn.T
    return np.asarray((moved + moved.T) / 2)
