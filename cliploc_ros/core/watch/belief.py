# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability that a localizer is right, over looks: a Bayes filter.

Between looks a localizer may get lost, or find itself: the probability goes to one half, at a rate
of the time and the way. A pose that moves against odometry is another statement. Looks of the same
place from the same spot share their errors, such as those of the map, so a standing robot learns
little from more of them.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_PLACE, invert_transform, pose_error
from cliploc_ros.core.observation import Observation
from cliploc_ros.units import NS_PER_S

# Looks that are kept to compare a new one with.
_MOST_LOOKS = 10


class _Look(NamedTuple):
    observation: Observation
    log_odds: float
    is_full: bool  #: Whether a wrong pose would show: enough objects, and enough mapped ones


class Belief:
    """The filter. Looks come in the order of time."""

    def __init__(self) -> None:
        self._log_odds = 0.0
        self._looks: deque[_Look] = deque(maxlen=_MOST_LOOKS)
        self._last: tuple[Observation, NDArray[np.float64]] | None = None
        #: Whether the localizer made another statement since it was right last
        self.has_jumped = False

    @property
    def probability(self) -> float:
        """Return the probability that the pose of the last look is right."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def against(self) -> int:
        """Return how many of the last full looks speak against the pose."""
        return sum(one.is_full and one.log_odds < 0.0 for one in self._looks)

    def wait(self, observation: Observation, map_from_camera: NDArray[np.float64]) -> None:
        """Let the time to a look pass, and the way to its pose (4, 4)."""
        last, terms = self._last, CALIBRATION.watch
        self._last = observation, map_from_camera
        if last is None:
            return
        before, pose = last
        away_m, away_deg = 0.0, 0.0  # against odometry
        if before.odom_from_camera is not None and observation.odom_from_camera is not None:
            away_m, away_deg = pose_error(pose @ invert_transform(
                before.odom_from_camera) @ observation.odom_from_camera, map_from_camera)
        if away_m > SAME_PLACE.distance_m or away_deg > SAME_PLACE.angle_deg:
            # Where the camera had confirmed the pose before, this one is wrong, unless that was.
            self._log_odds = -min(max(self._log_odds, 0.0), terms.most_jump)
            self._looks.clear()
            self.has_jumped = True
            return
        time_s = max(0, observation.stamp_ns - before.stamp_ns) / NS_PER_S
        way_m = float(np.linalg.norm(map_from_camera[:3, 3] - pose[:3, 3]))
        keep = math.exp(-terms.lost_per_s * time_s - terms.lost_per_m * way_m)
        likely = 0.5 + keep * (self.probability - 0.5)
        self._log_odds = math.log(likely / (1.0 - likely))

    def add(self, observation: Observation, log_odds: float, is_full: bool) -> float:
        """Take in a look after wait; return its weight, 1 if it shares no errors with others."""
        look = _Look(observation, log_odds, is_full)
        weight = 1.0 - max((_correlation(one, look) for one in self._looks), default=0.0)
        self._log_odds += weight * log_odds
        self._looks.append(look)
        if self.probability > CALIBRATION.watch.localized:
            self.has_jumped = False
        return weight


def _correlation(one: _Look, look: _Look) -> float:
    """Return the correlation of the errors of two looks, 0 to 1."""
    terms = CALIBRATION.watch
    then, now = one.observation, look.observation
    if then.odom_from_camera is None or now.odom_from_camera is None:
        away = abs(now.stamp_ns - then.stamp_ns) / NS_PER_S / terms.correlated_s
    else:
        way_m, turn_deg = pose_error(then.odom_from_camera, now.odom_from_camera)
        away = way_m / terms.correlated_m + turn_deg / terms.correlated_deg
    # looks that say the opposite are no repetition: the robot was carried away, or back
    return terms.correlated * math.exp(-away - abs(one.log_odds - look.log_odds) / terms.most)
