# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far a pose may be off, from how well its inliers' boxes fit."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.ellipsoid import ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.transforms import invert_transform

# Box edges are never trusted beyond this, as a share of the box's size.
_MIN_EDGE_ERROR = 0.03
# Finite-difference steps of position [m] and rotation [rad].
_STEPS = (1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)
# A direction the boxes do not fix is uncertain by this much, not infinitely: m^2 and rad^2.
_PRIOR_VARIANCES = (100.0, 100.0, 100.0, 10.0, 10.0, 10.0)


def pose_covariance(map_from_camera: NDArray[np.float64], bboxes: NDArray[np.float64],
                    centers: NDArray[np.float64], shapes: NDArray[np.float64]
                    ) -> NDArray[np.float64]:
    """Return the covariance of a camera pose whose boxes show given landmarks.

    The edges of the boxes, in units of each box's size, are taken as measurements of the edges
    of the projected ellipsoids. Their scatter at the pose itself (its bias included, since the
    pose is not refined) goes through the linearized projection to the pose.

    Parameters
    ----------
    map_from_camera : ndarray (4, 4)
    bboxes : ndarray (m, 4)
        Inlier boxes x, y, x, y on the plane z = 1.
    centers, shapes : ndarray (m, 3), (m, 6)
        The landmark that each box shows.

    Returns
    -------
    ndarray (6, 6)
        Of x, y, z [m] and the rotations about the map's fixed X, Y, Z axes [rad], about the
        camera's position (ROS order). Symmetric and positive definite.
    """
    size = np.repeat(bboxes[:, 2:] - bboxes[:, :2], 2, axis=0).reshape(-1, 4)

    def edge_errors(step: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = _moved(map_from_camera, step)
        edges = ellipse_bboxes(project_ellipsoids(invert_transform(moved), centers, shapes))
        return np.nan_to_num((edges - bboxes) / size).ravel()

    jacobian = np.stack([(edge_errors(step) - edge_errors(-step)) / (2 * step.max())
                         for step in np.diag(_STEPS)], axis=1)
    errors = edge_errors(np.zeros(6))
    spare = max(1, len(errors) - 6)
    variance = max(_MIN_EDGE_ERROR**2, float(errors @ errors) / spare)
    information = jacobian.T @ jacobian / variance + np.diag(1.0 / np.array(_PRIOR_VARIANCES))
    covariance = np.linalg.inv(information)
    return (covariance + covariance.T) / 2


def _moved(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose displaced by a step (6,) of position and of rotation about fixed axes."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[:3]
    return moved
