# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of the last frames are asked about together: a few, from places that differ."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.search.frame_search import Searched

# A camera that moved less sees the same again: such a frame takes the place of the one before.
_MOVED_M = 0.05
_MOVED_DEG = 3.0
# Looks agree on a pose to this.
_AGREEING_M = 0.5
_AGREEING_DEG = 20.0
# A camera is to notice in time when what was in its way is gone.
_MAX_LOOKS = 20


class _Look(NamedTuple):
    """What the best pose, believed or not, made of odometry each time somebody asked."""

    stamp_ns: int
    map_from_odom: NDArray[np.float64]


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
        self._looks: list[_Look] = []
        self._run = -1

    def __len__(self) -> int:
        """Return how many frames are kept."""
        return len(self._kept)

    def clear(self) -> None:
        """Forget all frames, and what they led to."""
        self._kept.clear()
        self._looks.clear()

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
            self.clear()
            self._run = run
        place = observation.odom_from_camera
        assert place is not None
        lasting_ns = range(observation.stamp_ns - round(length_s * 1e9), observation.stamp_ns)
        self._looks = [one for one in self._looks if one.stamp_ns in lasting_ns]
        # with a frame that shows nothing there is nothing to join
        kept = [one for one in self._kept if len(one.observation.detections)
                and one.observation.stamp_ns in lasting_ns]
        anchor = place
        if kept and not _has_moved(kept[-1].anchor, place):
            anchor = kept.pop().anchor
        kept.append(Kept(observation, anchor))
        while len(kept) > limit:
            _drop_one(kept)
        self._kept = kept
        return list(kept)

    def judge(self, found: Relocalization) -> Relocalization:
        """Refuse a pose that most of the last looks, carried by odometry, do not lead to.

        Who asks until a pose is believed gives chance as many chances. What is right is found
        again and again, what chance finds is not.

        Parameters
        ----------
        found : Relocalization
            By the frames that were last joined.
        """
        if found.map_from_camera is None:
            return found
        newest = self._kept[-1].observation
        assert newest.odom_from_camera is not None
        look = _Look(newest.stamp_ns,
                     found.map_from_camera @ invert_transform(newest.odom_from_camera))
        self._looks = [*self._looks, look][-_MAX_LOOKS:]
        agreeing = sum(_agree(look.map_from_odom @ newest.odom_from_camera, found.map_from_camera)
                       for look in self._looks)
        if not found.accepted or 2 * agreeing > len(self._looks):
            return found
        return replace(found, accepted=False, reason=(
            f'unsure: only {agreeing} of the last {len(self._looks)} images lead to this pose: '
            'turn to where more objects are in view'))


def _has_moved(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    distance_m, angle_deg = pose_error(before, after)
    return distance_m > _MOVED_M or angle_deg > _MOVED_DEG


def _agree(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    distance_m, angle_deg = pose_error(one, other)
    return distance_m < _AGREEING_M and angle_deg < _AGREEING_DEG


def _way(before: Kept, after: Kept) -> float:
    """Return how far a camera moved, in the steps that make a frame a new one."""
    distance_m, angle_deg = pose_error(before.anchor, after.anchor)
    return distance_m / _MOVED_M + angle_deg / _MOVED_DEG


def _drop_one(kept: list[Kept]) -> None:
    """Drop the frame that is nearest to those before and after it; neither end where possible."""
    ways = [_way(kept[row - 1], kept[row]) + _way(kept[row], kept[row + 1])
            for row in range(1, len(kept) - 1)]
    del kept[1 + int(np.argmin(ways)) if ways else 0]
