# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When two poses agree: every tolerance has a name here."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Tolerance(NamedTuple):
    """Two poses agree if they are nearer than this to each other, in both [m] [deg]."""

    distance_m: float
    angle_deg: float

    @property
    def least_trace(self) -> float:
        """Return the trace of a rotation by the angle; a smaller turn has a greater trace."""
        return float(1.0 + 2.0 * np.cos(np.radians(self.angle_deg)))

    def agree(self, one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
        """Return whether two poses (4, 4) agree."""
        return bool(self.agreeing(one[None], other[None])[0, 0])

    def agreeing(self, poses: NDArray[np.float64], others: NDArray[np.float64] | None = None
                 ) -> NDArray[np.bool_]:
        """Return which poses (m, 4, 4) agree with which others (k, 4, 4), or with each other."""
        others = poses if others is None else others
        near = np.linalg.norm(poses[:, None, :3, 3] - others[:, :3, 3], axis=2) < self.distance_m
        traces = np.einsum('iab,jab->ij', poses[:, :3, :3], others[:, :3, :3])
        return np.asarray(near & (traces > self.least_trace))

    def wider(self, distance_m: float, angle_deg: float) -> 'Tolerance':
        """Return a tolerance that allows so much more."""
        return Tolerance(self.distance_m + distance_m, min(180.0, self.angle_deg + angle_deg))


#: Two poses are the same answer to where the camera is; a right pose is so near to the truth.
SAME_ANSWER = Tolerance(1.0, 45.0)
#: A pose further from the truth than this is wrong [m].
RIGHT_M = SAME_ANSWER.distance_m
#: Two hypotheses of a search are at one place: the better one stands for both.
SAME_PLACE = Tolerance(0.5, 20.0)
#: Two looks, linked by odometry, lead to the same pose.
SAME_LOOK = Tolerance(0.5, 20.0)
#: Two refined poses are the same minimum of the cost.
SAME_MINIMUM = Tolerance(0.05, 2.0)
#: A camera that moved less sees the same again.
SAME_VIEW = Tolerance(0.05, 3.0)
#: A keyframe sees what a camera sees; the shares of both tolerances add up.
SAME_SIGHT = Tolerance(2.0, 40.0)
#: A robot that moved less since its image is still where its pose says.
SAME_SPOT = Tolerance(0.1, 5.0)
#: A localizer that shows a pose so near to the given one has taken it. Its particles scatter by
#: the given covariance, so the tolerance is wider by three standard deviations.
TAKEN = Tolerance(0.3, 10.0)
#: Moves of a place onto another one that differ by less are one move, about the vertical.
SAME_MOVE = Tolerance(1.0, 30.0)
