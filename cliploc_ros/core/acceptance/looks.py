# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive looks: the best poses of the last frames, and their confidence in the newest pose.

Every retry is another chance of a false accept. Odometry carries the pose of each look to the
newest frame, and drifts on the way. The looks of a standing robot show the same, so their
confidences must not multiply. Their mean needs no independence. Where looks are exchangeable,
their mean ever reaches a limit with a probability of at most the expected confidence of one look,
divided by the limit, however often the robot looks (Ramdas and Manole, "Randomized and
exchangeable improvements of Markov's, Chebyshev's and Chernoff's inequalities", 2023). So with a
limit of .5, a robot that is nowhere in the map ever accepts a pose with at most twice the mean
confidence of its looks.

An accepted pose ends a series of looks: the next request begins another one. What keyframes
recognized stays for a while, since a picture of a place is told from it by how both move.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_LOOK, invert_transform
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.observation import Observation


class Look(NamedTuple):
    """The best pose of one frame."""

    observation: Observation
    map_from_camera: NDArray[np.float64]  #: (4, 4)
    confidence: float  #: From the frames of this look alone
    recognized: RecognizedPlace | None = None  #: The place that keyframes recognize


@dataclass(frozen=True)
class Looks:
    """The last looks of one run of odometry, oldest first."""

    past: tuple[Look, ...] = ()  #: Those that led to no accepted pose
    recognized: tuple[Look, ...] = ()  #: The last looks by keyframes, accepted or not

    def __len__(self) -> int:
        """Return the number of looks."""
        return len(self.past)

    def with_look(self, look: Look, accepted: bool = False) -> 'Looks':
        """Return these looks and a new one; those at the same or a later stamp are dropped.

        An observation without odometry links to no look, so it counts as the only one.
        """
        is_linked = look.observation.odom_from_camera is not None
        past, recognized = (_before(some, look.observation) if is_linked else ()
                            for some in (self.past, self.recognized))
        if look.recognized is not None:
            recognized = (*recognized, look)[-int(CALIBRATION.looks.most_recognized):]
        return Looks(() if accepted else (*past, look)[-int(CALIBRATION.looks.most):], recognized)

    def confidences_in(self, observation: Observation, map_from_camera: NDArray[np.float64]
                       ) -> tuple[float, ...]:
        """Return the confidence of each look before an observation in its pose (4, 4).

        A look that leads elsewhere has 0. The allowed distance between two poses grows with the
        way between them.
        """
        terms, odom_from_camera = CALIBRATION.looks, observation.odom_from_camera
        if odom_from_camera is None:
            return ()
        found = []
        for one in _before(self.past, observation)[1 - int(terms.most):]:
            assert one.observation.odom_from_camera is not None
            carried = one.map_from_camera @ invert_transform(
                one.observation.odom_from_camera) @ odom_from_camera
            way_m = max(observation.odom_way_m - one.observation.odom_way_m,
                        float(np.linalg.norm(carried[:3, 3] - one.map_from_camera[:3, 3])))
            near = SAME_LOOK.wider(terms.drift_m * way_m, terms.drift_deg * way_m)
            found.append(one.confidence if near.agree(carried, map_from_camera) else 0.0)
        return tuple(found)

    def passed(self, observation: Observation) -> tuple[Look, NDArray[np.float64]] | None:
        """Return the look by keyframes that odometry takes furthest away, and the motion since.

        The motion (4, 4) takes coordinates of the camera now to those of then.
        """
        odom_from_camera, found = observation.odom_from_camera, []
        if odom_from_camera is None:
            return None
        for one in _before(self.recognized, observation):
            assert one.observation.odom_from_camera is not None
            found.append((one, invert_transform(one.observation.odom_from_camera)
                          @ odom_from_camera))
        return max(found, key=lambda pair: float(np.linalg.norm(pair[1][:3, 3])), default=None)


def _before(looks: tuple[Look, ...], observation: Observation) -> tuple[Look, ...]:
    return tuple(look for look in looks if look.observation.stamp_ns < observation.stamp_ns)
