# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tags: printed squares (AprilTag, ArUco) that name themselves, and their part of the map file."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.map.landmark_details import check_id, check_keys, checked_place
from cliploc_ros.errors import MapError, did_you_mean

#: Number of ids of each family. ArUco's families have OpenCV's names.
FAMILIES = {'tag16h5': 30, 'tag25h9': 35, 'tag36h10': 2320, 'tag36h11': 587,
            **{f'DICT_{side}X{side}_{count}': count for side in (4, 5, 6, 7)
               for count in (50, 100, 250, 1000)}, 'DICT_ARUCO_ORIGINAL': 1024}
#: Corners (4, 3) of a tag of size 1, in the order of the detection: top left, then clockwise.
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


@dataclass(frozen=True)
class Tag:
    """A tag of the map. Its axes: x right, y up, z out of the tag; the origin is its centre."""

    tag_id: str  #: Its name in the map
    family: str
    number: int  #: The id that its pattern encodes
    size: float  #: Side of the black square [m]
    center: tuple[float, ...]  #: x, y, z in the map [m]
    quat_xyzw: tuple[float, ...]  #: Rotates tag axes into map axes

    @property
    def name(self) -> str:
        """Return the name that the pattern gives, see SeenTags."""
        return f'{self.family}_{self.number}'

    @cached_property
    def map_from_tag(self) -> NDArray[np.float64]:
        """Return the pose (4, 4)."""
        return transform_from_pose(np.array(self.center), np.array(self.quat_xyzw))

    @property
    def corners(self) -> NDArray[np.float64]:
        """Return the corners (4, 3) in the map: top left, then clockwise [m]."""
        return self.size * SQUARE @ self.map_from_tag[:3, :3].T + self.map_from_tag[:3, 3]


def read_tags(tree: Any, source: str) -> tuple[Tag, ...]:
    """Read the tags of a map; MapError: the message names the source, the tag and the field."""
    if not isinstance(tree, Mapping):
        raise MapError(f'{source}: map: tags: expected tags by name, not {tree!r:.60}')
    tags = tuple(_tag(tag_id, fields, source) for tag_id, fields in tree.items())
    for tag, other in combinations(tags, 2):
        if tag.name == other.name:
            raise MapError(f"{source}: tag '{other.tag_id}': family and id are those of "
                           f"'{tag.tag_id}': give each tag of a place its own id")
    return tags


def _tag(tag_id: Any, fields: Any, source: str) -> Tag:
    """Validate a tag."""
    where = f"{source}: tag '{tag_id}'"
    check_id(tag_id, where)
    check_keys(fields, ('family', 'id', 'size', 'center', 'orientation'), where)
    family, number, size = fields['family'], fields['id'], fields['size']
    if not isinstance(family, str) or family not in FAMILIES:
        raise MapError(f'{where}: family: {family!r}{did_you_mean(str(family), FAMILIES)} is none '
                       f'of {", ".join(FAMILIES)}')
    if isinstance(number, bool) or not isinstance(number, int) or not (
            0 <= number < FAMILIES[family]):
        raise MapError(f'{where}: id: {number!r} must be from 0 to {FAMILIES[family] - 1}')
    if isinstance(size, bool) or not isinstance(size, int | float) or not 1e-3 <= size <= 1e2:
        raise MapError(f'{where}: size: {size!r} must be between 0.001 and 100 m')
    return Tag(tag_id, family, number, float(size), *checked_place(fields, where))
