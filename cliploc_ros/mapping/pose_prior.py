# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The process of pose errors, and the poses' part of the normal equations.

The errors e of the given poses are a stationary process in the map's axes: each of x, y, z and
the rotations about them has a standard deviation sigma and forgets itself with a time constant,

    e_0 ~ N(0, sigma^2),   e_k+1 - a e_k ~ N(0, sigma^2 (1 - a^2)),   a = exp(-dt / tau),

which covers independent noise (tau = 0), the slow errors of a localizer, and drift (large sigma
and tau).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.options import PoseErrors
from cliploc_ros.mapping.projection import POSE_SIZE


class Prior(NamedTuple):
    """The information of the process of errors: its diagonal and next-to-diagonal (F, 6)."""

    diagonal: NDArray[np.float64]
    beside: NDArray[np.float64]

    @staticmethod
    def of(stamps_s: NDArray[np.float64], errors: PoseErrors) -> 'Prior':
        """Return the prior of frames at some times."""
        kept = np.zeros(len(stamps_s))
        if errors.correlation_s > 0.0:
            kept[:-1] = np.exp(-np.maximum(np.diff(stamps_s), 1e-3) / errors.correlation_s)
        # information of the innovation between a frame and the next one
        gain = 1.0 / (1.0 - kept[:-1] ** 2)
        diagonal = np.ones(len(stamps_s))
        diagonal[1:] = gain
        diagonal[:-1] += gain * kept[:-1] ** 2
        beside = np.zeros(len(stamps_s))
        beside[:-1] = -gain * kept[:-1]
        weights = 1.0 / errors.sigmas ** 2
        return Prior(diagonal[:, None] * weights, beside[:, None] * weights)

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the information."""
        # Q = L D L': each pivot is what the frames before leave of the diagonal
        pivots = self.diagonal.copy()
        for frame in range(1, len(pivots)):
            pivots[frame] -= self.beside[frame - 1] ** 2 / pivots[frame - 1]
        return float(np.log(pivots).sum())

    def gradient(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the information times errors (F, 6)."""
        product = self.diagonal * errors
        product[:-1] += self.beside[:-1] * errors[1:]
        product[1:] += self.beside[:-1] * errors[:-1]
        return product


def pose_bands(of_poses: NDArray[np.float64], prior: Prior,
               of_steps: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the poses' part of the equations with the prior, as lower bands.

    Parameters
    ----------
    of_poses : ndarray (F, 6, 6)
        A block for each pose.
    prior : Prior
    of_steps : ndarray (F, 6, 6), optional
        The block below each of these: the rows of the next pose, the columns of this one.

    Returns
    -------
    ndarray (7, 6 F), or (12, 6 F) with blocks below
    """
    count = POSE_SIZE + 1 if of_steps is None else 2 * POSE_SIZE
    bands = np.zeros((count, len(of_poses), POSE_SIZE))
    for below in range(POSE_SIZE):
        for column in range(POSE_SIZE - below):
            bands[below, :, column] = of_poses[:, column + below, column]
    bands[0] += prior.diagonal
    bands[POSE_SIZE] = prior.beside
    if of_steps is not None:
        for row, column in np.ndindex(POSE_SIZE, POSE_SIZE):
            bands[POSE_SIZE + row - column, :, column] += of_steps[:, row, column]
    return bands.reshape(count, -1)
