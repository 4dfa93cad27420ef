# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of an answer for a filter that fuses successive answers.

Answers share images, landmarks and their errors. A filter that fuses ten answers as independent
measurements underestimates its standard deviation by a factor of three. Each answer is therefore
given a covariance with only the information that the earlier answers, propagated by odometry, did
not contain. In each direction, the filter then becomes as certain as the better of the two
estimates, but not more. This is safe fusion (Gustafsson, "Statistical Sensor Fusion", 2010),
computed on the side of the sensor.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import moved_pose
from cliploc_ros.core.geometry.transforms import invert_transform, move_covariance, pose_difference

# Odometry as a random walk: standard deviation on each axis after a metre and after a radian, as
# in cliploc_ros.core.fit.covariance. A filter that assumes more drift stays consistent.
_DRIFT = CALIBRATION.covariance.odometry_drift
# The following are not in calibration.yaml, because the input of a filter affects no decision
# about a pose.
# Answers further apart than this quantile contradict each other.
_CONTRADICTION = float(chdtri(6, 0.01))
# The share of its information that an answer keeps in directions without new information, because
# a covariance must be finite.
_LEAST_SHARE = 1e-4


class FilterState(NamedTuple):
    """The state of a filter that has fused all answers of one run of odometry."""

    #: (4, 4), (4, 4): poses at the last answer
    odom_from_camera: NDArray[np.float64]
    map_from_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: (6, 6): covariance of the pose, see Relocalization


def succeed(known: FilterState | None, odom_from_camera: NDArray[np.float64],
            map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64]
            ) -> tuple[NDArray[np.float64], FilterState]:
    """Return the covariance (6, 6) of an answer for a filter, and the filter state after it.

    If an answer contradicts the earlier answers, one of them is wrong, and the covariances of both
    are increased. An outlier therefore hardly moves the filter, and a filter misled by an outlier
    recovers.

    Parameters
    ----------
    known : FilterState or None
        State of the filter before the answer; None for the first answer.
    odom_from_camera, map_from_camera : ndarray (4, 4)
        Poses of the camera, from this answer alone.
    covariance : ndarray (6, 6)
        Covariance of map_from_camera.
    """
    if known is None:
        return covariance, FilterState(odom_from_camera, map_from_camera, covariance)
    # the filter, propagated by odometry as a random walk: a filter that assumes more drift stays
    # consistent
    motion = invert_transform(known.odom_from_camera) @ odom_from_camera
    before = known.map_from_camera @ motion
    ways = np.array([float(np.linalg.norm(motion[:3, 3])),
                     float(Rotation.from_matrix(motion[:3, :3]).magnitude())])
    carried = move_covariance(known.covariance, before[:3, 3] - known.map_from_camera[:3, 3]
                              ) + np.diag(np.repeat(_DRIFT ** 2 * ways, 3))
    innovation = pose_difference(before, map_from_camera)
    square = float(innovation @ np.linalg.solve(carried + covariance, innovation))
    doubt = max(1.0, square / _CONTRADICTION)
    prior, own = doubt * carried, doubt * covariance
    # The covariance with which the filter becomes as certain as the better of prior and answer.
    root = np.linalg.cholesky(prior)
    whitened = np.linalg.solve(root, np.linalg.solve(root, own).T)
    ratios, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    information = np.maximum(1.0 / ratios - 1.0, _LEAST_SHARE / ratios)
    axes = root @ axes
    given = np.asarray((axes / information) @ axes.T)
    gain = np.linalg.solve(prior + given, prior).T
    step, after = gain @ innovation, prior - gain @ prior
    return given, FilterState(odom_from_camera, moved_pose(before, step), (after + after.T) / 2)
