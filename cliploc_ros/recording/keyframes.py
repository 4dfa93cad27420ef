# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which frames of a recording are worth a look: those from a new viewpoint."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.errors import OptionsError


@dataclass(frozen=True)
class KeyframeOptions:
    """How far apart keyframes are: either is enough.

    Parameters
    ----------
    distance_m, angle_deg : float
        [m] [deg]. 0 takes every frame with a pose.
    """

    distance_m: float = 0.1
    angle_deg: float = 5.0

    def __post_init__(self) -> None:
        """Refuse negative values."""
        if not (self.distance_m >= 0.0 and self.angle_deg >= 0.0):
            raise OptionsError(f'keyframes {self.distance_m} m or {self.angle_deg} degrees apart: '
                               'give 0 or more')


#: Every frame with a pose.
EVERY_FRAME = KeyframeOptions(0.0, 0.0)


class KeyframeFilter:
    """Asked once for each frame of a recording in order, tells whether it is a keyframe."""

    def __init__(self, options: KeyframeOptions) -> None:
        self._options = options
        self._last: NDArray[np.float64] | None = None
        self.asked = self.without_pose = self.keyframes = 0

    def __call__(self, place: int, stamp_ns: int, pose: NDArray[np.float64] | None) -> bool:
        """Tell whether the frame with this pose is a keyframe."""
        self.asked += 1
        if pose is None:
            self.without_pose += 1
            return False
        if self._last is not None:
            distance, angle = pose_error(pose, self._last)
            if distance < self._options.distance_m and angle < self._options.angle_deg:
                return False
        self._last = pose
        self.keyframes += 1
        return True
