# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far a pose may be off, from how well its inliers' boxes fit."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.box_edges import RELATIVE_DEVIATION
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.search.prior import VERTICAL_UNKNOWN

# The scatter of box centres, as a share of the box, before anything is seen, and how many
# measurements that belief is worth: three boxes alone would seem to fit perfectly.
_PRIOR_SCATTER = 0.1
_PRIOR_WEIGHT = 6.0
# Errors of box and map are shared by neighbouring edges, so fewer are independent than counted.
# Doubling the variance brings accepted poses of real TUM frames near their 95 % ellipsoids.
_VARIANCE_INFLATION = 2.0
# The same for refined poses: 94 to 95 % of accepted ones lie in their ellipsoids then.
_REFINED_INFLATION = 1.2
# No box centre is known better than this on the plane z = 1: a twentieth of a pixel or so.
_MIN_DEVIATION = 1e-4
# Finite-difference steps of position [m] and rotation [rad].
_STEPS = (1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)
# A direction the boxes do not fix is uncertain by this much, not infinitely: m^2 and rad^2.
_PRIOR_VARIANCES = (100.0, 100.0, 100.0, 10.0, 10.0, 10.0)

# What odometry adds to the pose of several frames, on each axis: five real frames whose steps are
# off by four times this lie in their 95 % ellipsoids nine times of ten.
_ODOMETRY_DEVIATION_M = 0.005
_ODOMETRY_DEVIATION_RAD = np.radians(0.25)


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
        How many of the inliers show one object: together they measure like one.
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
    """Return the covariance of a pose that three box centres fix, or two and the vertical.

    A minimal pose has no error but that of its bearings, and of the vertical. Bearings scatter
    with the size of their boxes, by as much as the inliers' boxes miss the projected landmarks;
    the linearized projection carries the scatter to the pose.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    centers : ndarray (m, 3)
        The sampled landmarks' centres in the map [m].
    box_sizes : ndarray (m, 2)
        Width and height of the sampled boxes on the plane z = 1.
    scatter : float
        See box_scatter.
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
                   + np.diag(1.0 / np.array(_PRIOR_VARIANCES)))
    if vertical[6] > 0.0:  # it tells of turns about level axes
        up = vertical[3:6]
        information[3:, 3:] += (np.eye(3) - np.outer(up, up)) / vertical[6] ** 2
    covariance = np.linalg.inv(information)
    return (covariance + covariance.T) / 2


def refined_covariance(information: NDArray[np.float64], scatter: float
                       ) -> NDArray[np.float64]:
    """Return the covariance of a pose that was refined on its inliers.

    Parameters
    ----------
    information : ndarray (6, 6)
        Of the last linearized system, of residuals in assumed deviations, see refine_rig.
    scatter : float
        See box_scatter: by how much the deviations assumed are to be stretched.

    Returns
    -------
    ndarray (6, 6)
        As of pose_covariance.
    """
    stretch = _REFINED_INFLATION * max(1.0, scatter / RELATIVE_DEVIATION) ** 2
    prior = np.diag(1.0 / np.array(_PRIOR_VARIANCES))
    covariance = np.linalg.inv(information / stretch + prior)
    return np.asarray((covariance + covariance.T) / 2)


def odometry_covariance() -> NDArray[np.float64]:
    """Return what a pose is off by (6, 6) as odometry misplaces the frames that it is seen in."""
    return np.diag(np.repeat(np.square([_ODOMETRY_DEVIATION_M, _ODOMETRY_DEVIATION_RAD]), 3))


def normalized_square(map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64],
                      truth: NDArray[np.float64]) -> float:
    """Return the squared error of a pose in its own covariance (NEES).

    Over many poses whose covariances are true it has the chi-squared distribution of six degrees
    of freedom (Bar-Shalom, Li and Kirubarajan 2001).

    Parameters
    ----------
    map_from_camera, truth : ndarray (4, 4)
    covariance : ndarray (6, 6)
        As of pose_covariance.
    """
    turn = Rotation.from_matrix(truth[:3, :3] @ map_from_camera[:3, :3].T).as_rotvec()
    error = np.concatenate([truth[:3, 3] - map_from_camera[:3, 3], turn])
    return float(error @ np.linalg.solve(covariance, error))


def _moved(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose displaced by a step (6,) of position and of rotation about fixed axes."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[:3]
    return moved
