# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of the last frames are asked about together: a few, from places that differ."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.frame_search import Searched
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.transforms import pose_error

# A camera that moved less sees the same again: such a frame takes the place of the one before.
_MOVED_M = 0.05
_MOVED_DEG = 3.0


@dataclass
class Kept:
    """A frame whose camera odometry places.

    Parameters
    ----------
    observation : Observation
    anchor : ndarray (4, 4)
        Where the camera was in the first of the frames that this one took the place of: one that
        creeps is to get away from it.
    searched : Searched or None
        What was found in it, once it was searched.
    """

    observation: Observation
    anchor: NDArray[np.float64]
    searched: Searched | None = None


class FrameWindow:
    """The frames of the last seconds, of which each shows something new."""

    def __init__(self) -> None:
        self._kept: list[Kept] = []
        self._run = -1

    def __len__(self) -> int:
        """Return how many frames are kept."""
        return len(self._kept)

    def clear(self) -> None:
        """Forget all frames."""
        self._kept.clear()

    def forget_searches(self) -> None:
        """Forget what was found in the frames: it would be found in another way now."""
        for one in self._kept:
            one.searched = None

    def join(self, observation: Observation, run: int, limit: int, length_s: float) -> list[Kept]:
        """Take a frame in; return the frames to ask about, in the order of time, it last.

        Of too many those stay that are furthest apart, so that a camera that turns is asked
        about all that it saw on its way.

        Parameters
        ----------
        observation : Observation
            With odom_from_camera.
        run : int
            Of odometry: frames of another run are forgotten.
        limit : int
            How many frames at most.
        length_s : float
            Older ones than this are forgotten, and those that are not older, too: time went
            back.
        """
        if run != self._run:
            self._kept.clear()
            self._run = run
        place = observation.odom_from_camera
        assert place is not None
        oldest_ns = observation.stamp_ns - round(length_s * 1e9)
        # with a frame that shows nothing there is nothing to join
        kept = [one for one in self._kept if len(one.observation.detections)
                and oldest_ns <= one.observation.stamp_ns < observation.stamp_ns]
        anchor = place
        if kept and not _has_moved(kept[-1].anchor, place):
            anchor = kept.pop().anchor
        kept.append(Kept(observation, anchor))
        while len(kept) > limit:
            _drop_one(kept)
        self._kept = kept
        return list(kept)


def _has_moved(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    distance_m, angle_deg = pose_error(before, after)
    return distance_m > _MOVED_M or angle_deg > _MOVED_DEG


def _way(before: Kept, after: Kept) -> float:
    """Return how far a camera moved, in the steps that make a frame a new one."""
    distance_m, angle_deg = pose_error(before.anchor, after.anchor)
    return distance_m / _MOVED_M + angle_deg / _MOVED_DEG


def _drop_one(kept: list[Kept]) -> None:
    """Drop the frame that is nearest to those before and after it; neither end where possible."""
    ways = [_way(kept[row - 1], kept[row]) + _way(kept[row], kept[row + 1])
            for row in range(1, len(kept) - 1)]
    del kept[1 + int(np.argmin(ways)) if ways else 0]
