# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the robot probably is: evidence, never a cut.

A region is right with its probability p; otherwise the robot may be anywhere in the map. So a pose
has the density p N(pose) + (1 - p) u, where u is uniform over the map. Its logarithm over u is
bounded: 0 in the region, a constant elsewhere. So a region never raises a pose against the case
that no pose is right, and lifts none that its objects support weakly: the confidence of a pose
stays below that without its rivals. Nor does it decide alone between two places that look the
same: the robot may have been told the wrong one of them.
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
# A body that points up or down has no yaw: of its x axis, this much must be level.
_LEAST_AHEAD = 0.5


def region_odds(landmark_map: LandmarkMap, region: Region, poses: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """Return the log odds (m,), 0 or less, that a region gives to camera poses (m, 4, 4) of a map.

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
    steps[np.hypot(*bodies[:, :2, 0].T) < _LEAST_AHEAD, 2] = 0.0
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
    p = min(max(region.probability, 1e-9), 1.0 - 1e-9)
    odds = np.logaddexp(math.log(1.0 - p), math.log(p) + peak - 0.5 * squares)
    return np.asarray(np.clip(odds, -terms.most, 0.0))
