# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive looks: the best poses of the last frames, and their confidence in the newest pose.

Every retry is another chance of a false accept. Odometry predicts the pose of each look in the
newest frame, with some drift. The looks of a standing robot are not independent, so their
confidences must not be multiplied. Their mean does not need independence. If looks are
exchangeable, the probability that their mean ever reaches a limit is at most the expected
confidence of one look, divided by the limit, however often the robot looks (Ramdas and Manole,
"Randomized and exchangeable improvements of Markov's, Chebyshev's and Chernoff's inequalities",
2023). With a limit of .5, the probability that a robot outside the map ever accepts a pose is
therefore at most twice the mean confidence of its looks.

Looks with one camera share its errors and those of the map, so another look at the same view is no
new chance: the mean log odds of the looks of a view must be as high as those of a single look. A
look that finds another pose, or is unsure, counts as even odds. Looks after the robot has moved or
turned count less, as far as their views differ.

An accepted pose ends a series of looks, and the next request starts a new one. The places that
keyframes recognized are kept for a while, because the motion between two of them distinguishes a
place from a picture of it.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_LOOK, invert_transform, pose_error
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.observation import Observation


class Look(NamedTuple):
    """The best pose of one frame."""

    observation: Observation
    map_from_camera: NDArray[np.float64]  #: (4, 4)
    confidence: float  #: From the frames of this look alone, if all cameras are right
    recognized: RecognizedPlace | None = None  #: The place that keyframes recognize
    doubted: float = 0.0  #: The confidence including doubts about the camera


class EarlierLook(NamedTuple):
    """The evidence of an earlier look for the pose of a later one."""

    confidence: float  #: In this pose, if all cameras are right
    doubted: float  #: In this pose, including doubts about the camera
    same_view: float  #: To what degree both looks have the same view, 0 to 1


@dataclass(frozen=True)
class Looks:
    """The last looks of one run of odometry, oldest first."""

    past: tuple[Look, ...] = ()  #: The looks since the last accepted pose
    recognized: tuple[Look, ...] = ()  #: The last looks by keyframes, accepted or not

    def with_look(self, look: Look, accepted: bool = False) -> 'Looks':
        """Return these looks and a new one; looks at the same or a later stamp are dropped.

        Without odometry, the new look is not linked to the others, which are dropped.
        """
        is_linked = look.observation.odom_from_camera is not None
        past, recognized = (_before(looks, look.observation) if is_linked else ()
                            for looks in (self.past, self.recognized))
        if look.recognized is not None:
            recognized = (*recognized, look)[-int(CALIBRATION.looks.most_recognized):]
        return Looks(() if accepted else (*past, look)[-int(CALIBRATION.looks.most):], recognized)

    def earlier(self, observation: Observation, map_from_camera: NDArray[np.float64]
                ) -> tuple[EarlierLook, ...]:
        """Return the earlier looks, given the pose (4, 4) of an observation.

        A look with another pose has confidence 0. The tolerance between two poses grows with the
        distance driven between them.
        """
        terms, odom_from_camera = CALIBRATION.looks, observation.odom_from_camera
        if odom_from_camera is None:
            return ()
        found = []
        for look in _before(self.past, observation)[1 - int(terms.most):]:
            before = look.observation.odom_from_camera
            assert before is not None
            carried = look.map_from_camera @ invert_transform(before) @ odom_from_camera
            way_m = max(observation.odom_way_m - look.observation.odom_way_m,
                        float(np.linalg.norm(carried[:3, 3] - look.map_from_camera[:3, 3])))
            tolerance = SAME_LOOK.wider(terms.drift_m * way_m, terms.drift_deg * way_m)
            moved_m, turned_deg = pose_error(before, odom_from_camera)
            same_view = math.exp(-moved_m / terms.view_m - turned_deg / terms.view_deg)
            agrees = float(tolerance.agree(carried, map_from_camera))
            found.append(EarlierLook(agrees * look.confidence, agrees * look.doubted, same_view))
        return tuple(found)

    def passed(self, observation: Observation) -> tuple[Look, NDArray[np.float64]] | None:
        """Return the look by keyframes at the greatest distance by odometry, and the motion since.

        The motion is then_from_now (4, 4) of the camera. None without such a look or odometry.
        """
        odom_from_camera, found = observation.odom_from_camera, []
        if odom_from_camera is None:
            return None
        for look in _before(self.recognized, observation):
            assert look.observation.odom_from_camera is not None
            found.append((look, invert_transform(look.observation.odom_from_camera)
                          @ odom_from_camera))
        return max(found, key=lambda pair: float(np.linalg.norm(pair[1][:3, 3])), default=None)


#: No earlier looks
NO_LOOKS = Looks()


def _before(looks: tuple[Look, ...], observation: Observation) -> tuple[Look, ...]:
    return tuple(look for look in looks if look.observation.stamp_ns < observation.stamp_ns)
