# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One landmark as the studio holds it: the fields of the map file, unknown ones included.

The relocalizer refuses a map with unknown fields, since a misspelled field would be silently
without effect. The studio opens such a map, keeps these fields, and says that they are refused.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import OPTIONAL_FIELDS, LandmarkDetails, read_details
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.studio.looks import Look

REQUIRED_FIELDS = ('label', 'class_id', 'center', 'semi_axes', 'orientation')
KNOWN_FIELDS = REQUIRED_FIELDS + OPTIONAL_FIELDS
#: Edited numbers are rounded to these, so that the file holds exactly what the studio shows.
DECIMALS = 6
#: Limits of a semi-axis that an edit may set [m]; the file format allows more.
LEAST_SEMI_AXIS_M = 1e-3


@dataclass(frozen=True)
class Landmark:
    """A landmark of the map that is edited.

    Parameters
    ----------
    fields : mapping
        As in the map file, below the landmark's id.
    is_locked : bool
        Edits are refused. The map file does not hold it.
    look : Look, optional
        What an image encoder saw of it, from the file next to the map.
    """

    fields: Mapping[str, Any]
    is_locked: bool = False
    look: Look | None = field(default=None, compare=False)

    @cached_property
    def details(self) -> LandmarkDetails:
        """Return the optional fields."""
        return read_details(self.fields, 'landmark')

    @property
    def label(self) -> str:
        """Return the label; of several, the one with the greatest weight."""
        if 'label' in self.fields:
            return str(self.fields['label'])
        return max(self.details.labels or (('', 0.0),), key=lambda pair: pair[1])[0]

    @property
    def class_id(self) -> str:
        """Return the detector class."""
        return str(self.fields['class_id'])

    @cached_property
    def center(self) -> NDArray[np.float64]:
        """Return the centre (3,) [m]."""
        return _fixed(np.array(self.fields['center'], dtype=np.float64))

    @cached_property
    def semi_axes(self) -> NDArray[np.float64]:
        """Return the semi-axes (3,) [m]."""
        return _fixed(np.array(self.fields['semi_axes'], dtype=np.float64))

    @cached_property
    def quat_xyzw(self) -> NDArray[np.float64]:
        """Return the unit quaternion (4,) from landmark axes to map axes."""
        quat_xyzw = np.array(self.fields['orientation'], dtype=np.float64)
        return _fixed(quat_xyzw / np.linalg.norm(quat_xyzw))

    @property
    def basis(self) -> NDArray[np.float64]:
        """Return the basis (3, 3), whose columns are the semi-axes in the map [m]."""
        return np.asarray(Rotation.from_quat(self.quat_xyzw).as_matrix() * self.semi_axes)

    @property
    def volume(self) -> float:
        """Return the volume [m^3]."""
        return float(4.0 / 3.0 * math.pi * self.semi_axes.prod())

    @property
    def unknown_fields(self) -> tuple[str, ...]:
        """Return the fields that the relocalizer refuses."""
        return tuple(name for name in self.fields if name not in KNOWN_FIELDS)

    def changed(self, **fields: Any) -> 'Landmark':
        """Return the landmark with other values; a field that is None is left out."""
        together = {**self.fields, **fields}
        return replace(self, fields={name: value for name, value in together.items()
                                     if value is not None or name not in fields})


def _fixed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    values.setflags(write=False)
    return values


def check_landmark(landmark_id: str, landmark: Landmark, source: str) -> None:
    """Refuse a landmark that no map may hold, unknown fields excepted.

    Raises
    ------
    MapError
        Names the source, the landmark and the field.
    """
    map_of({landmark_id: landmark}, 'map', source)


def map_of(landmarks: Mapping[str, Landmark], frame_id: Any, source: str) -> LandmarkMap:
    """Return landmarks as the relocalizer knows them, without unknown fields.

    Raises
    ------
    MapError
        There are none, or one is invalid.
    """
    known = {landmark_id: {name: value for name, value in one.fields.items()
                           if name in KNOWN_FIELDS} for landmark_id, one in landmarks.items()}
    return LandmarkMap.from_mapping({'frame_id': frame_id, 'landmarks': known}, source)


def rounded(values: Iterable[float]) -> list[float]:
    """Return numbers as an edit writes them."""
    return [round(float(value), DECIMALS) + 0.0 for value in values]


def shape_fields(center: NDArray[np.float64], basis: NDArray[np.float64]) -> dict[str, Any]:
    """Return the fields of an ellipsoid.

    Parameters
    ----------
    center, basis : ndarray (3,), (3, 3)
        In the map; the basis' columns are orthogonal semi-axes [m].
    """
    lengths = np.maximum(np.linalg.norm(basis, axis=0), LEAST_SEMI_AXIS_M)
    rotation = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-12)
    if np.linalg.det(rotation) < 0.0:
        rotation = rotation * (1.0, 1.0, -1.0)
    quat_xyzw = Rotation.from_matrix(rotation).as_quat()
    if quat_xyzw[3] < 0.0:
        quat_xyzw = -quat_xyzw
    return {'center': rounded(center), 'semi_axes': rounded(lengths),
            'orientation': rounded(quat_xyzw)}
