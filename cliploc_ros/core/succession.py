# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of an answer for a filter that fuses successive answers.

Answers share images, landmarks and their errors. A filter that fuses ten answers as independent
measurements is three times too certain of the pose. A filter therefore gets only the information
that the earlier answers, carried on by odometry, did not give. In each direction it ends up as
certain as the better of the two, never more. That is safe fusion (Gustafsson, "Statistical Sensor
Fusion", 2010), seen from the sensor.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import moved_pose
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    move_covariance,
    pose_difference,
)

# Odometry as a random walk: deviation on each axis after a metre and after a radian, the share of
# cliploc_ros.core.fit.covariance. A filter that trusts its odometry less is less certain, not
# wrong.
_DRIFT = CALIBRATION.covariance.odometry_drift
# These are not in calibration.yaml: the input of a filter decides about no pose.
# Answers further apart than this quantile contradict each other.
_CONTRADICTION = float(chi2.ppf(0.99, 6))
# An answer keeps this share of its information in directions in which it says nothing new: a
# covariance must be finite.
_LEAST_SHARE = 1e-4


class FilterState(NamedTuple):
    """The state of a filter that fused all answers of one run of odometry."""

    #: (4, 4): at the last answer
    odom_from_camera: NDArray[np.float64]
    map_from_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: (6, 6): as of Relocalization


def succeed(known: FilterState | None, odom_from_camera: NDArray[np.float64],
            map_from_camera: NDArray[np.float64], covariance: NDArray[np.float64]
            ) -> tuple[NDArray[np.float64], FilterState]:
    """Return the covariance of an answer to a filter, and the state of the filter after it.

    An answer that contradicts its predecessors makes both less certain: one of them is wrong. So
    an outlier hardly moves the filter, and a filter that it misled recovers. Poses (4, 4) and
    covariance (6, 6) are of the answer alone; known is None for the first one.
    """
    if known is None:
        return covariance, FilterState(odom_from_camera, map_from_camera, covariance)
    before = _carried(known, odom_from_camera)
    innovation = pose_difference(before.map_from_camera, map_from_camera)
    square = float(innovation @ np.linalg.solve(before.covariance + covariance, innovation))
    doubt = max(1.0, square / _CONTRADICTION)
    prior, own = doubt * before.covariance, doubt * covariance
    # The covariance that makes a filter of a prior as certain as the better of both.
    root = np.linalg.cholesky(prior)
    whitened = np.linalg.solve(root, np.linalg.solve(root, own).T)
    ratios, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    information = np.maximum(1.0 / ratios - 1.0, _LEAST_SHARE / ratios)
    axes = root @ axes
    given = np.asarray((axes / information) @ axes.T)
    gain = np.linalg.solve(prior + given, prior).T
    step, after = gain @ innovation, prior - gain @ prior
    return given, FilterState(odom_from_camera, moved_pose(before.map_from_camera, step),
                              (after + after.T) / 2)


def _carried(known: FilterState, odom_from_camera: NDArray[np.float64]) -> FilterState:
    """Return the state after the camera moved on by odometry."""
    motion = invert_transform(known.odom_from_camera) @ odom_from_camera
    pose = known.map_from_camera @ motion
    covariance = move_covariance(known.covariance, pose[:3, 3] - known.map_from_camera[:3, 3])
    ways = [float(np.linalg.norm(motion[:3, 3])),
            float(Rotation.from_matrix(motion[:3, :3]).magnitude())]
    return FilterState(odom_from_camera, pose,
                       covariance + np.diag(np.repeat(_DRIFT ** 2 * np.array(ways), 3)))
