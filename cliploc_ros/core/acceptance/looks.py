# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive looks: the best poses of the last frames, and whether they agree.

Every retry is another chance of a false accept. A right pose is found again and again, a wrong
one seldom twice. Odometry carries the pose of each look to the newest frame, where they are
compared.
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
    """

    stamp_ns: int
    odom_from_camera: NDArray[np.float64]
    map_from_camera: NDArray[np.float64]


@dataclass(frozen=True)
class Looks:
    """The last looks of one run of odometry, oldest first; at most 20."""

    past: tuple[Look, ...] = ()

    def __len__(self) -> int:
        """Return the number of looks."""
        return len(self.past)

    def with_look(self, observation: Observation, map_from_camera: NDArray[np.float64]
                  ) -> 'Looks':
        """Return these looks and a new one.

        Looks at the same or a later stamp are dropped. An observation without odometry links to
        no look, so it counts as the only one.

        Parameters
        ----------
        observation : Observation
        map_from_camera : ndarray (4, 4)
            Its best pose.
        """
        odom_from_camera = observation.odom_from_camera
        if odom_from_camera is None:
            return Looks((Look(observation.stamp_ns, np.eye(4), map_from_camera),))
        earlier = [one for one in self.past if one.stamp_ns < observation.stamp_ns]
        newest = Look(observation.stamp_ns, odom_from_camera, map_from_camera)
        return Looks((*earlier, newest)[-_MAX_LOOKS:])

    @property
    def agreeing(self) -> int:
        """Return how many looks agree with the newest one, which counts."""
        newest = self.past[-1]
        carried = [one.map_from_camera @ invert_transform(one.odom_from_camera)
                   @ newest.odom_from_camera for one in self.past]
        return sum(_agree(pose, newest.map_from_camera) for pose in carried)


def _agree(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    distance_m, angle_deg = pose_error(one, other)
    return distance_m < _AGREEING_M and angle_deg < _AGREEING_DEG
