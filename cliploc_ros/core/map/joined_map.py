# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several maps, such as the floors of a building, searched as one.

The maps lie side by side, so far apart that no camera sees landmarks of two of them. Then search,
look-alikes and confidence treat places on different maps as they treat distant places of one map.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError

#: The most maps of a request: each adds candidates, which share the time budget.
MAX_MAPS = 100
# Distance between joined maps, in multiples of the largest semi-axis. A landmark half that far
# away cannot match even a box one pixel wide, at focal lengths below 10,000 px (IoU above .2).
_APART = 100_000.0


class MapPart(NamedTuple):
    """One of several maps."""

    landmark_map: LandmarkMap  #: In its own coordinate frame
    first: int  #: Row of its first landmark among those of all maps
    shift: NDArray[np.float64]  #: (3,): from its own coordinates to those of all maps, level [m]


class Place(NamedTuple):
    """A pose in the map that it belongs to."""

    part: MapPart
    map_from_camera: NDArray[np.float64]  #: (4, 4): in the coordinate frame of that map
    name: str  #: Name of the map; empty if there is only one

    @property
    def position(self) -> tuple[float, float, float]:
        """Return the camera's position in that map [m]."""
        x, y, z = self.map_from_camera[:3, 3].tolist()
        return x, y, z


@dataclass(frozen=True)
class JoinedMap(LandmarkMap):
    """The landmarks of several maps in one coordinate frame, that of the first map."""

    parts: tuple[MapPart, ...] = ()  #: Along the x axis

    def prepare(self) -> None:
        """Compute the indices now, those of the single maps, too."""
        super().prepare()
        for part in self.parts:
            _ = part.landmark_map.classes

    @cached_property
    def starts(self) -> NDArray[np.float64]:
        """Return the x where the stretch of each map begins (M,), halfway between two maps [m]."""
        columns = [part.landmark_map.centers[:, 0] + part.shift[0] for part in self.parts]
        ends, begins = [x.max() for x in columns[:-1]], [x.min() for x in columns[1:]]
        return np.concatenate([[-np.inf], np.add(ends, begins) / 2])


def join_maps(maps: Sequence[LandmarkMap], sources: Sequence[str]) -> LandmarkMap:
    """Return one map of several; a single map stays as it is.

    Parameters
    ----------
    maps : sequence of LandmarkMap
        At least one, each in a coordinate frame of its own.

    Raises
    ------
    MapError
        Two maps have the same frame_id, one has no landmarks, or there are too many maps.
    """
    if len(maps) == 1:
        return maps[0]
    if len(maps) > MAX_MAPS:
        raise MapError(f'{len(maps)} maps: at most {MAX_MAPS} are searched at once')
    for one, source in zip(maps, sources, strict=True):
        if not len(one):
            raise MapError(f'{source}: is a map of keyframes alone, which is searched alone: '
                           'take the others away')
    for frame_id, count in Counter(one.frame_id for one in maps).items():
        if count > 1:
            alike = [source for one, source in zip(maps, sources, strict=True)
                     if one.frame_id == frame_id]
            raise MapError(f"{' and '.join(alike[:2])}: both have frame_id '{frame_id}', so poses "
                           'would not say in which map they are; give each its own frame_id')
    gap = _APART * max(float(one.semi_axes.max()) for one in maps)
    parts: list[MapPart] = []
    first, begin = 0, 0.0
    for one in maps:
        low, high = one.centers.min(axis=0), one.centers.max(axis=0)
        shift = np.zeros(3)
        if parts:
            shift[0] = begin - low[0]
            shift[1] = maps[0].centers[:, 1].min() - low[1]
        parts.append(MapPart(one, first, shift))
        first, begin = first + len(one), float(high[0] + shift[0]) + gap
    details = [one.details or (LandmarkDetails(),) * len(one)
               for one in maps] if any(one.details for one in maps) else []
    return JoinedMap(
        maps[0].frame_id,
        tuple(f'{one.frame_id}/{name}' for one in maps for name in one.landmark_ids),
        tuple(label for one in maps for label in one.labels),
        tuple(name for one in maps for name in one.class_ids),
        np.concatenate([part.landmark_map.centers + part.shift for part in parts]),
        np.concatenate([one.semi_axes for one in maps]),
        np.concatenate([one.quats_xyzw for one in maps]),
        tuple(chain.from_iterable(details)), parts=tuple(parts))


def parts_of(landmark_map: LandmarkMap) -> tuple[MapPart, ...]:
    """Return the maps that a map joins; the map itself if it is a single one."""
    if isinstance(landmark_map, JoinedMap):
        return landmark_map.parts
    return (MapPart(landmark_map, 0, np.zeros(3)),)


def place_of(landmark_map: LandmarkMap, map_from_camera: NDArray[np.float64]) -> Place:
    """Return a pose (4, 4) in the map to which it belongs."""
    if not isinstance(landmark_map, JoinedMap):
        return Place(parts_of(landmark_map)[0], map_from_camera, '')
    number = int(np.searchsorted(landmark_map.starts, map_from_camera[0, 3], side='right')) - 1
    part, own = landmark_map.parts[max(number, 0)], map_from_camera.copy()
    # R R^T is 1 but for rounding, which the length of the shift would magnify
    own[:3, 3] -= own[:3, :3] @ (own[:3, :3].T @ part.shift)
    return Place(part, own, part.landmark_map.frame_id)
