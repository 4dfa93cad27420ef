# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several maps, such as the floors of a building, searched as one.

The maps are placed side by side, so far apart that no camera sees landmarks of two maps. Search,
look-alikes and confidence then treat places on different maps like distant places of one map.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError

#: Maximum number of maps in a request: each map adds candidates, which share the time budget.
MAX_MAPS = 100
# Distance between joined maps, in multiples of the largest semi-axis. At half that distance, a
# landmark cannot match even a box one pixel wide, at focal lengths below 10,000 px (IoU above .2).
_APART = 100_000.0


class MapPart(NamedTuple):
    """One of several maps."""

    landmark_map: LandmarkMap  #: In its own coordinate frame
    first: int  #: Row of its first landmark in the joined map
    shift: NDArray[np.float64]  #: (3,): horizontal shift from this map to the joined map [m]


class Place(NamedTuple):
    """A pose in one of several maps."""

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
        """Compute the indices in advance, including those of the single maps."""
        super().prepare()
        for part in self.parts:
            _ = part.landmark_map.classes

    @cached_property
    def starts(self) -> NDArray[np.float64]:
        """Return the x (M,) where the range of each map begins, halfway between two maps [m]."""
        columns = [part.landmark_map.centers[:, 0] + part.shift[0] for part in self.parts]
        ends, begins = [x.max() for x in columns[:-1]], [x.min() for x in columns[1:]]
        return np.concatenate([[-np.inf], np.add(ends, begins) / 2])


def join_maps(maps: Sequence[LandmarkMap], sources: Sequence[str]) -> LandmarkMap:
    """Join maps; a single map is returned unchanged.

    Parameters
    ----------
    maps : sequence of LandmarkMap
        At least one map, each with a different coordinate frame.

    Raises
    ------
    MapError
        Two maps have the same frame_id, a map has no landmarks, or there are too many maps.
    """
    if len(maps) == 1:
        return maps[0]
    if len(maps) > MAX_MAPS:
        raise MapError(f'{len(maps)} maps: at most {MAX_MAPS} can be searched at once')
    for each, source in zip(maps, sources, strict=True):
        if not len(each):
            raise MapError(f'{source}: a map of keyframes alone cannot be joined with other maps: '
                           'search it alone')
    for frame_id, count in Counter(each.frame_id for each in maps).items():
        if count > 1:
            alike = [source for each, source in zip(maps, sources, strict=True)
                     if each.frame_id == frame_id]
            raise MapError(f"{' and '.join(alike[:2])}: both have frame_id '{frame_id}', so poses "
                           'would be ambiguous; give each map a different frame_id')
    gap = _APART * max(float(each.semi_axes.max()) for each in maps)
    parts: list[MapPart] = []
    first, begin = 0, 0.0
    for each in maps:
        low, high = each.centers.min(axis=0), each.centers.max(axis=0)
        shift = np.zeros(3)
        if parts:
            shift[0] = begin - low[0]
            shift[1] = maps[0].centers[:, 1].min() - low[1]
        parts.append(MapPart(each, first, shift))
        first, begin = first + len(each), float(high[0] + shift[0]) + gap
    whole = reduce(LandmarkMap.with_more, [
        replace(each, centers=each.centers + shift, landmark_ids=tuple(
            f'{each.frame_id}/{name}' for name in each.landmark_ids), tags=tuple(
                replace(tag, center=tuple(tag.center + shift)) for tag in each.tags))
        for each, _, shift in parts])
    return JoinedMap(**{field.name: getattr(whole, field.name) for field in fields(LandmarkMap)},
                     parts=tuple(parts))


def parts_of(landmark_map: LandmarkMap) -> tuple[MapPart, ...]:
    """Return the parts of a joined map, or a single map as the only part."""
    if isinstance(landmark_map, JoinedMap):
        return landmark_map.parts
    return (MapPart(landmark_map, 0, np.zeros(3)),)


def place_of(landmark_map: LandmarkMap, map_from_camera: NDArray[np.float64]) -> Place:
    """Transform a pose (4, 4) of the joined map into the map that contains it."""
    if not isinstance(landmark_map, JoinedMap):
        return Place(parts_of(landmark_map)[0], map_from_camera, '')
    number = int(np.searchsorted(landmark_map.starts, map_from_camera[0, 3], side='right')) - 1
    part, own = landmark_map.parts[max(number, 0)], map_from_camera.copy()
    # R R^T deviates from the identity by rounding; this form keeps the large shift from adding it
    own[:3, 3] -= own[:3, :3] @ (own[:3, :3].T @ part.shift)
    return Place(part, own, part.landmark_map.frame_id)
