# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability that a localizer is right, over looks: a Bayes filter.

Between looks a localizer may get lost, or find itself: the probability goes to one half, at a rate
of the time and the way. Looks of the same place from the same spot share their errors, such as
those of the map, so a standing robot learns little from more of them.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_ANSWER, invert_transform, pose_error
from cliploc_ros.core.observation import Observation
from cliploc_ros.units import NS_PER_S

# Looks that are kept to compare a new one with.
_MOST_LOOKS = 10


class _Look(NamedTuple):
    observation: Observation
    map_from_camera: NDArray[np.float64]
    log_odds: float
    known: int


class Belief:
    """The filter. Looks come in the order of time."""

    def __init__(self) -> None:
        self._log_odds = 0.0
        self._looks: deque[_Look] = deque(maxlen=_MOST_LOOKS)
        self._last: _Look | None = None

    @property
    def probability(self) -> float:
        """Return the probability that the pose of the last look is right."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def against(self) -> int:
        """Return how many of the last looks without exception spoke against the pose."""
        count = 0
        for one in reversed(self._looks):
            if one.log_odds >= 0.0:
                break
            count += one.known >= 3
        return count

    def wait(self, observation: Observation, map_from_camera: NDArray[np.float64]) -> None:
        """Let the time to a look pass, and the way to its pose (4, 4)."""
        last, terms = self._last, CALIBRATION.watch
        self._last = _Look(observation, map_from_camera, 0.0, 0)
        if last is None:
            return
        if jumped(last.observation, last.map_from_camera, observation, map_from_camera):
            self._log_odds, self._looks = 0.0, deque(maxlen=_MOST_LOOKS)
            return
        time_s = max(0, observation.stamp_ns - last.observation.stamp_ns) / NS_PER_S
        way_m = pose_error(map_from_camera, last.map_from_camera)[0]
        keep = math.exp(-terms.lost_per_s * time_s - terms.lost_per_m * way_m)
        likely = 0.5 + keep * (self.probability - 0.5)
        self._log_odds = math.log(likely / (1.0 - likely))

    def add(self, observation: Observation, map_from_camera: NDArray[np.float64],
            log_odds: float, known: int) -> None:
        """Take in a look after wait, by its log odds and its detections of the map's classes."""
        look = _Look(observation, map_from_camera, log_odds, known)
        self._log_odds += log_odds * (1.0 - max(
            (_correlation(one, look) for one in self._looks), default=0.0))
        self._looks.append(look)


def jumped(before: Observation, pose_before: NDArray[np.float64], now: Observation,
           pose_now: NDArray[np.float64]) -> bool:
    """Return whether a localizer made another statement: its pose moved, and odometry did not."""
    if before.odom_from_camera is None or now.odom_from_camera is None:
        return False
    carried = pose_before @ invert_transform(before.odom_from_camera) @ now.odom_from_camera
    return not SAME_ANSWER.agree(carried, pose_now)


def _correlation(one: _Look, look: _Look) -> float:
    """Return the correlation of the errors of two looks, 0 to 1."""
    terms = CALIBRATION.watch
    if one.observation.odom_from_camera is None or look.observation.odom_from_camera is None:
        time_s = abs(look.observation.stamp_ns - one.observation.stamp_ns) / NS_PER_S
        away = time_s / terms.correlated_s
    else:
        way_m, turn_deg = pose_error(one.observation.odom_from_camera,
                                     look.observation.odom_from_camera)
        away = way_m / terms.correlated_m + turn_deg / terms.correlated_deg
    # looks that say the opposite are no repetition: the robot was carried away, or back
    return terms.correlated * math.exp(-away - abs(one.log_odds - look.log_odds) / terms.most)
