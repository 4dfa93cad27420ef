# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far the hypotheses near the best one spread: one of them may be the right one.

The confidence counts all hypotheses within 1 m as right, such as those that take each bottle of a
shelf for its neighbour. The covariance must hold them too.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.tolerances import SAME_ANSWER


def spread(poses: NDArray[np.float64], odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of the differences between a pose and those that agree with it.

    The right pose need not be among those found. So their mean square is added in all directions,
    too.

    Parameters
    ----------
    poses : ndarray (m, 4, 4)
        map_from_camera; the first one is the pose.
    odds : ndarray (m,)
        Logarithm of the odds of each, up to a constant.

    Returns
    -------
    ndarray (6, 6)
        Of position [m] and rotation about the map's axes [rad].
    """
    agreeing = SAME_ANSWER.agreeing(poses)[0]
    # poses near each other share landmarks and errors: their supports differ by less than they say
    weights = np.exp(CALIBRATION.covariance.sharpness * (odds[agreeing] - odds[agreeing].max()))
    turns = Rotation.from_matrix(poses[agreeing, :3, :3] @ poses[0, :3, :3].T).as_rotvec()
    steps = np.concatenate([poses[agreeing, :3, 3] - poses[0, :3, 3], turns], axis=1)
    squares = (steps.T * (weights / weights.sum())) @ steps
    anywhere = np.repeat([np.trace(squares[:3, :3]) / 3, np.trace(squares[3:, 3:]) / 3], 3)
    return np.asarray(squares + np.diag(anywhere))
