# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive looks: the best poses of the last frames, and how sure they were of the newest one.

Every retry is another chance of a false accept. Odometry carries the pose of each look to the
newest frame. The looks of a standing robot show the same, so their confidences must not multiply.
Their mean needs no independence. Where looks are exchangeable, their mean ever reaches a limit
with a probability of at most the expected confidence of one look, divided by the limit, however
often the robot looks (Ramdas and Manole, "Randomized and exchangeable improvements of Markov's,
Chebyshev's and Chernoff's inequalities", 2023). So with a limit of .5, a robot that is nowhere in
the map ever accepts a pose with at most twice the mean confidence of its looks.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.observation import Observation

# Looks that are nearer than this agree.
_AGREEING_M = 0.5
_AGREEING_DEG = 20.0
# Older looks are dropped, so that a camera recovers soon after something blocked its view.
_MAX_LOOKS = 20


class Look(NamedTuple):
    """The best pose of one frame, accepted or not.

    Parameters
    ----------
    stamp_ns : int
    odom_from_camera, map_from_camera : ndarray (4, 4)
    confidence : float
    """

    stamp_ns: int
    odom_from_camera: NDArray[np.float64]
    map_from_camera: NDArray[np.float64]
    confidence: float


@dataclass(frozen=True)
class Looks:
    """The last looks of one run of odometry, oldest first; at most 20."""

    past: tuple[Look, ...] = ()

    def __len__(self) -> int:
        """Return the number of looks."""
        return len(self.past)

    def with_look(self, observation: Observation, map_from_camera: NDArray[np.float64],
                  confidence: float) -> 'Looks':
        """Return these looks and a new one.

        Looks at the same or a later stamp are dropped. An observation without odometry links to
        no look, so it counts as the only one.

        Parameters
        ----------
        observation : Observation
        map_from_camera : ndarray (4, 4)
            Its best pose.
        confidence : float
            Of this pose, from the frames of this look alone.
        """
        odom_from_camera = observation.odom_from_camera
        if odom_from_camera is None:
            return Looks((Look(observation.stamp_ns, np.eye(4), map_from_camera, confidence),))
        newest = Look(observation.stamp_ns, odom_from_camera, map_from_camera, confidence)
        return Looks((*self._before(observation), newest)[-_MAX_LOOKS:])

    def confidences_in(self, observation: Observation, map_from_camera: NDArray[np.float64]
                       ) -> tuple[float, ...]:
        """Return the confidence of each look before an observation in its pose (4, 4).

        A look that leads elsewhere has none: 0.
        """
        odom_from_camera = observation.odom_from_camera
        if odom_from_camera is None:
            return ()
        carried = [(one.confidence, one.map_from_camera @ invert_transform(one.odom_from_camera)
                    @ odom_from_camera) for one in self._before(observation)[1 - _MAX_LOOKS:]]
        return tuple(confidence if _agree(pose, map_from_camera) else 0.0
                     for confidence, pose in carried)

    def _before(self, observation: Observation) -> tuple[Look, ...]:
        return tuple(one for one in self.past if one.stamp_ns < observation.stamp_ns)


def _agree(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    distance_m, angle_deg = pose_error(one, other)
    return distance_m < _AGREEING_M and angle_deg < _AGREEING_DEG
