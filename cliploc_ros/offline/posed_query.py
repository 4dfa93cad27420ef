# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame of known pose, which a localizer is asked about in the same way as on a robot.

All offline programs use this module: `evaluate`, `check_map` and the studio. A localizer that gets
the frames of a recording in order gathers the same evidence about cameras and depth as on a robot.
A frame that gets a new localizer is an independent question.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization
from cliploc_ros.units import NS_PER_S


@dataclass(frozen=True)
class PosedQuery:
    """A frame to localize, and its true pose."""

    number: int  #: Number of the frame in its recording, from 0
    observation: Observation
    map_from_camera: NDArray[np.float64]  #: (4, 4): ground truth
    #: Frames of other cameras at the same stamp, or frames of the same camera at other stamps;
    #: odom_from_camera links them to the frame
    neighbours: tuple[Observation, ...] = ()
    #: Returns the undistorted image (h, w, 3), RGB, for keyframes
    image: Callable[[], NDArray[np.uint8]] | None = None
    group: int = 0  #: Number of the group of frames that it belongs to
    is_main: bool = True  #: Whether it is asked about, or is only a neighbour of others
    #: (n,): index into the landmarks, -1 where unknown; None if unknown for all. For studies only.
    true_landmark: NDArray[np.int64] | None = None

    def in_order(self) -> Iterator[Query]:
        """Yield the queries of a robot with this input, oldest first; the last one is the frame's.

        The cameras of one instant are one query, linked by their mounts. Frames of other instants
        are earlier queries of one run of odometry, without images. If a frame is later than the
        frame to localize, the robot goes back in the same time: all stamps are shifted.
        """
        images = () if self.image is None else (self.image(),)
        stamp_ns = self.observation.stamp_ns
        if all(frame.stamp_ns == stamp_ns for frame in self.neighbours):
            yield Query((*self.neighbours, self.observation), images, run=None)
            return
        earlier = sorted(self.neighbours, key=lambda frame: frame.stamp_ns)
        shift_ns = max(0, 2 * (earlier[-1].stamp_ns - stamp_ns))
        length_s = 1.0 + (stamp_ns + shift_ns - earlier[0].stamp_ns) / NS_PER_S
        for frame in [*(replace(frame, stamp_ns=frame.stamp_ns - shift_ns) for frame in earlier),
                      self.observation]:
            yield Query((frame,), images if frame is self.observation else (), self.number,
                        len(earlier) + 1, length_s)


def ask(localizer: Localizer, query: PosedQuery,
        begin_stage: Callable[[str], None] = lambda stage: None) -> Relocalization:
    """Return the answer about a frame, after the answers about earlier frames of its run.

    Those earlier answers change looks and evidence, as in continuous mode, but do not count.
    """
    for part in query.in_order():
        found = localizer.answer(part, begin_stage=begin_stage)
    return found
