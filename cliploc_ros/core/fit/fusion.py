# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two poses of one camera as one."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform

# Weights of the first pose that covariance intersection tries.
_WEIGHTS = np.linspace(0.0, 1.0, 11)


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
