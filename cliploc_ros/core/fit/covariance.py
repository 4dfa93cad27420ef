# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of a pose that is not refined, and what a covariance says."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_difference
from cliploc_ros.core.search.prior import VERTICAL_UNKNOWN

# Scatter of box centres assumed before any box is seen, as a share of the box, and how many
# measurements this prior counts as. Without it three boxes alone would seem to fit perfectly.
_PRIOR_SCATTER = 0.1
_PRIOR_WEIGHT = 6.0
# Neighbouring edges share errors of box and map, so fewer edges are independent than counted.
# Chosen on the 258 TUM frames that also fitted the confidence: with it 94 to 95 % of the accepted
# poses lie in their 95 % ellipsoids.
_VARIANCE_INFLATION = 2.0
# The least deviation of a box centre on the plane z = 1: about a twentieth of a pixel.
_MIN_DEVIATION = 1e-4
# Finite-difference steps of position [m] and rotation [rad].
_STEPS = (1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)
#: Variance of a direction that the boxes do not fix: m^2 and rad^2.
PRIOR_VARIANCES = (100.0, 100.0, 100.0, 10.0, 10.0, 10.0)
# Deviation of odometry between two frames, on each axis: a floor, which covers stamps and
# interpolation, and a share of the way. The shares are guesses: wheels and visual odometry drift
# by 1 to 5 % of distance and angle. The floors were chosen on the TUM frames.
_ODOMETRY_FLOOR_M = 0.005
_ODOMETRY_FLOOR_RAD = np.radians(0.25)
_ODOMETRY_DRIFT = 0.03
# A camera that moves less stands still: rounding [m and rad].
_STANDS_STILL = 1e-9
# Weights of the first pose that covariance intersection tries.
_WEIGHTS = np.linspace(0.0, 1.0, 11)


def box_scatter(ellipses: NDArray[np.float64], box_ellipses: NDArray[np.float64],
                views: float = 1.0) -> float:
    """Return the standard deviation of box centres, as a share of the box's size.

    Parameters
    ----------
    ellipses : ndarray (m, 5)
        Projected outlines of the inliers' landmarks, see project_ellipsoids.
    box_ellipses : ndarray (m, 4)
        Centre and semi-axes of the ellipses inscribed in the inliers' boxes.
    views : float
        Mean number of inliers that show the same object; together they count as one.
    """
    size = 2.0 * box_ellipses[:, 2:]
    center_errors = (ellipses[:, :2] - box_ellipses[:, :2]) / size
    # An edge moves by half of what its box grows.
    size_errors = (np.sqrt(ellipses[:, [2, 4]]) - box_ellipses[:, 2:]) / size
    squares = (np.nansum(center_errors**2) + np.nansum(size_errors**2)) / views
    # Six of the centres' errors are zero by construction: P3P fits three centres exactly.
    freedom = max(0.0, center_errors.size / views - 6) + size_errors.size / views
    return float(np.sqrt((squares + _PRIOR_WEIGHT * _PRIOR_SCATTER**2)
                         / (freedom + _PRIOR_WEIGHT)))


def pose_covariance(map_from_camera: NDArray[np.float64], centers: NDArray[np.float64],
                    box_sizes: NDArray[np.float64], scatter: float,
                    vertical: NDArray[np.float64] = VERTICAL_UNKNOWN) -> NDArray[np.float64]:
    """Return the covariance of a pose from three box centres, or from two and the vertical.

    The error of a minimal pose comes from its bearings and its vertical only. Bearings scatter
    in proportion to their boxes, as much as the boxes of the inliers miss the projected
    landmarks. The linearized projection propagates this scatter to the pose.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    centers : ndarray (m, 3)
        The sampled landmarks' centres in the map [m].
    box_sizes : ndarray (m, 2)
        Width and height of the sampled boxes on the plane z = 1.
    vertical : ndarray (7,), optional
        See make_rig.

    Returns
    -------
    ndarray (6, 6)
        Of x, y, z [m] and the rotations about the map's fixed X, Y, Z axes [rad], about the
        camera's position (ROS order). Symmetric and positive definite.
    """
    def projections(step: NDArray[np.float64]) -> NDArray[np.float64]:
        camera_from_map = invert_transform(_moved(map_from_camera, step))
        points = centers @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        return (points[:, :2] / points[:, 2:]).ravel()

    jacobian = np.stack([(projections(step) - projections(-step)) / (2 * step.max())
                         for step in np.diag(_STEPS)], axis=1)
    variances = _VARIANCE_INFLATION * np.maximum(box_sizes.ravel() * scatter, _MIN_DEVIATION)**2
    information = (jacobian.T @ (jacobian / variances[:, None])
                   + np.diag(1.0 / np.array(PRIOR_VARIANCES)))
    if vertical[6] > 0.0:  # it measures the rotation about level axes
        up = vertical[3:6]
        information[3:, 3:] += (np.eye(3) - np.outer(up, up)) / vertical[6] ** 2
    covariance = np.linalg.inv(information)
    return (covariance + covariance.T) / 2


def odometry_deviations(first_from_second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the deviations (6,) of odometry between two frames: 0 if the camera did not move.

    On each axis, of position [m] and rotation [rad]; first_from_second (4, 4) is the camera's
    motion.
    """
    way_m = float(np.linalg.norm(first_from_second[:3, 3]))
    angle = float(Rotation.from_matrix(first_from_second[:3, :3]).magnitude())
    if way_m < _STANDS_STILL and angle < _STANDS_STILL:
        return np.zeros(6)
    return np.repeat([_ODOMETRY_FLOOR_M + _ODOMETRY_DRIFT * way_m,
                      _ODOMETRY_FLOOR_RAD + _ODOMETRY_DRIFT * angle], 3)


def share_within(radius_m: float, covariance: NDArray[np.float64]) -> float:
    """Return the probability that a position is within a distance of the truth.

    The squared distance is a sum of squares with different variances. A scaled chi-squared
    distribution of the same mean and variance stands for it (Box, "Some Theorems on Quadratic
    Forms Applied in the Study of Analysis of Variance Problems", 1954). The covariance (6, 6) is
    as of pose_covariance.
    """
    mean = np.trace(covariance[:3, :3])
    squares = np.sum(covariance[:3, :3] ** 2)
    return float(gammainc(0.5 * mean ** 2 / squares, 0.5 * radius_m ** 2 * mean / squares))


def normalized_square(map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64],
                      truth: NDArray[np.float64]) -> float:
    """Return the normalized estimation error squared (NEES) of a pose (4, 4).

    Where covariances (6, 6), as of pose_covariance, are right, it follows the chi-squared
    distribution with six degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001).
    """
    error = pose_difference(map_from_camera, truth)
    return float(error @ np.linalg.solve(covariance, error))


def _moved(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose displaced by a step (6,) of position and of rotation about fixed axes."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[:3]
    return moved


def fuse(first: NDArray[np.float64], first_covariance: NDArray[np.float64],
         second: NDArray[np.float64], second_covariance: NDArray[np.float64]
         ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of two poses (4, 4) and its covariance (6, 6).

    Both share the errors of the map, to an unknown degree. Covariance intersection is right for
    any degree (Julier and Uhlmann, "A Non-divergent Estimation Algorithm in the Presence of
    Unknown Correlations", 1997). The weight gives the least variance of the position, so a pose
    that is better in every direction stays as it is. The covariances are in the order of
    core.fit.covariance.
    """
    informations = np.linalg.inv(first_covariance), np.linalg.inv(second_covariance)
    covariances = [np.linalg.inv(weight * informations[0] + (1.0 - weight) * informations[1])
                   for weight in _WEIGHTS]
    best = int(np.argmin([np.trace(one[:3, :3]) for one in covariances]))
    covariance = (covariances[best] + covariances[best].T) / 2
    step = np.concatenate([first[:3, 3] - second[:3, 3],
                           Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_rotvec()])
    moved = _WEIGHTS[best] * covariance @ informations[0] @ step
    turn = Rotation.from_rotvec(moved[3:]).as_matrix()
    return make_transform(turn @ second[:3, :3], second[:3, 3] + moved[:3]), covariance
