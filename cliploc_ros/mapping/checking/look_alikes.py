# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The places of a map that look alike to a relocalizer, see core.acceptance.look_alikes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.look_alikes import find_alike
from cliploc_ros.core.map.landmark_map import LandmarkMap

#: Places are so far apart: each is the surroundings of a landmark [m].
RADIUS_M = 2.0
# Places that repeat fewer of each other's landmarks do so by chance; labels tell them apart. The
# share of find_alike, which only proposes rivals of a pose, would report most offices and shops.
_LEAST_SHARE = 0.6


@dataclass(frozen=True)
class LookAlike:
    """A pair of places that look alike."""

    #: The middles of the places [m]
    first: tuple[float, float, float]
    second: tuple[float, float, float]
    #: Landmarks of the first place, and those of the second place that they look like
    matched: tuple[tuple[str, str], ...]
    landmarks: int  #: The landmarks of the first place
    share: float  #: Share of these that are matched, 0 to 1
    same_labels: int  #: Matched landmarks whose labels are equal, so that no crop tells them apart
    turn_deg: float  #: About the vertical, from the first place to the second [deg]


def find_look_alikes(landmark_map: LandmarkMap) -> list[LookAlike]:
    """Return the pairs of places that look alike, the most alike first.

    A place that a turn by more than 45 degrees lays on itself counts, too.
    """
    found: list[LookAlike] = []
    left = np.ones(len(landmark_map), dtype=np.bool_)
    for row, position in enumerate(landmark_map.centers):
        if left[row]:
            left[landmark_map.tree.query_ball_point(position, RADIUS_M)] = False
            found += _look_alikes(landmark_map, position)
    kept: list[LookAlike] = []
    for one in sorted(found, key=lambda one: (-len(one.matched) * one.share, -one.share)):
        if not any((_near(one.first, other.first) and _near(one.second, other.second))
                   or (_near(one.first, other.second) and _near(one.second, other.first))
                   for other in kept):
            kept.append(one)
    return kept


def _look_alikes(landmark_map: LandmarkMap, position: NDArray[np.float64]
                 ) -> Iterator[LookAlike]:
    alike = find_alike(landmark_map, position)
    ids, labels = landmark_map.landmark_ids, landmark_map.labels
    for move, others, found in zip(alike.moves, alike.others, alike.found, strict=True):
        if found.mean() < _LEAST_SHARE:
            continue
        pairs = list(zip(alike.landmarks[found].tolist(), others[found].tolist(), strict=True))
        yield LookAlike(
            tuple(position.tolist()), tuple((move[:3, :3] @ position + move[:3, 3]).tolist()),
            tuple((ids[one], ids[other]) for one, other in pairs), len(alike.landmarks),
            float(found.mean()), sum(labels[one] == labels[other] for one, other in pairs),
            float(np.degrees(np.arctan2(move[1, 0], move[0, 0]))))


def _near(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    return float(np.hypot(first[0] - second[0], first[1] - second[1])) < RADIUS_M
