# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the robot probably is: evidence between poses, never a cut.

A region is right with its probability p; otherwise the robot may be anywhere in the map. So a pose
has the density p N(pose) + (1 - p) u, where u is uniform over the map. Its logarithm over u is
bounded by log(1 - p) below and by a constant above, and decides between poses. It never raises a
pose against the case that no pose is right, see confidences: the confidence of a pose stays below
that without its rivals, so a region lifts no pose that its objects support weakly. Against that
case it only lowers poses outside of it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Region

# A robot drives about beyond the outermost landmarks, too [m].
_MARGIN_M = 1.0


def region_odds(landmark_map: LandmarkMap, region: Region, poses: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """Return the log odds (m,) that a region gives to camera poses (m, 4, 4) of a map.

    A region of a map that is not there says nothing.
    """
    parts = parts_of(landmark_map)
    shift = next((one.shift for one in parts if one.landmark_map.frame_id == region.frame_id),
                 None)
    if shift is None:
        return np.zeros(len(poses))
    terms = CALIBRATION.prior
    bodies = poses @ region.camera_from_body
    steps = np.c_[bodies[:, :2, 3] - shift[:2], np.arctan2(bodies[:, 1, 0], bodies[:, 0, 0])]
    steps -= region.mean
    steps[:, 2] = (steps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    covariance = region.covariance + np.diag(
        [terms.least_m, terms.least_m, math.radians(terms.least_deg)]) ** 2
    spot, yaw = covariance[:2, :2], covariance[2, 2]
    squares = (np.einsum('ni,ij,nj->n', steps[:, :2], np.linalg.inv(spot), steps[:, :2])
               + steps[:, 2] ** 2 / yaw)
    area = sum(float(np.prod(np.ptp(one.landmark_map.centers[:, :2], axis=0) + 2.0 * _MARGIN_M))
               for one in parts)
    # a region wider than the map is as good as the map
    peak = (max(0.0, math.log(area / (2.0 * math.pi)) - 0.5 * np.linalg.slogdet(spot)[1])
            + max(0.0, 0.5 * math.log(2.0 * math.pi / yaw)))
    p = min(region.probability, terms.most_probability)
    return np.asarray(np.minimum(
        terms.most, np.logaddexp(math.log(1.0 - p), math.log(max(p, 1e-9)) + peak - 0.5 * squares)))
