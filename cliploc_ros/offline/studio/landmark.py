# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A landmark of the studio: its fields of the map file, its look, and its marks.

The relocalizer refuses a map with unknown fields, because a misspelled field would silently have
no effect. The studio opens such a map, keeps the fields, and notes that they are refused.

A look is the image embeddings of a landmark. It is a part of the landmark, so that merge, split,
delete, undo and redo apply to it, too.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import OPTIONAL_FIELDS, LandmarkDetails, read_details
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.labelling import choose_medoids
from cliploc_ros.offline.mapping.landmarks import Landmarks as Ellipsoids

KNOWN_FIELDS = ('label', 'class_id', 'center', 'semi_axes', 'orientation', *OPTIONAL_FIELDS)
#: Edited numbers are rounded to these decimals, so that the file has the numbers that are shown.
DECIMALS = 6
#: The least semi-axis that an edit may set [m]; the file format allows less.
LEAST_SEMI_AXIS_M = 1e-3


def merge_looks(looks: Sequence[LandmarkEmbeddings | None], weights: Sequence[float]
                ) -> LandmarkEmbeddings | None:
    """Merge the looks of several landmarks, of one encoder; None if no look is known.

    The weights are, for example, the numbers of boxes.
    """
    known = [(look, weight) for look, weight in zip(looks, weights, strict=True)
             if look is not None]
    if len(known) < 2:
        return known[0][0] if known else None
    mean = np.sum([weight * look.means.astype(np.float32) for look, weight in known], axis=0)
    crops = np.concatenate([look.medoids for look, _ in known]).astype(np.float32)
    shares = np.concatenate([np.full(len(look.medoids), weight / max(1, len(look.medoids)))
                             for look, weight in known])
    chosen = crops[choose_medoids(crops, shares)].astype(np.float16)
    return replace(known[0][0], medoids=chosen, medoid_offsets=np.array([0, len(chosen)]), means=(
        mean / max(float(np.linalg.norm(mean)), 1e-9)).astype(np.float16))


@dataclass(frozen=True)
class Landmark:
    """A landmark of the edited map. It equals one of equal fields; no file stores the marks."""

    fields: Mapping[str, Any]  #: As in the map file, below the landmark's id
    #: From the file next to the map: the embeddings of this landmark alone
    look: LandmarkEmbeddings | None = field(default=None, compare=False)
    #: Edits are refused
    is_locked: bool = field(default=False, compare=False)
    #: The landmark is not shown in the scene and the views
    is_hidden: bool = field(default=False, compare=False)
    #: Decision in the review: accepted, fixed; '' without a decision
    decision: str = field(default='', compare=False)

    @cached_property
    def details(self) -> LandmarkDetails:
        """The optional fields."""
        return read_details(self.fields, 'landmark')

    @property
    def label(self) -> str:
        """The label, or the label with the greatest weight."""
        if 'label' in self.fields:
            return str(self.fields['label'])
        return max(self.details.labels or (('', 0.0),), key=lambda pair: pair[1])[0]

    @property
    def class_id(self) -> str:
        """The detector class."""
        return str(self.fields['class_id'])

    @cached_property
    def center(self) -> NDArray[np.float64]:
        """The centre (3,) [m]."""
        return np.array(self.fields['center'], dtype=np.float64)

    @cached_property
    def semi_axes(self) -> NDArray[np.float64]:
        """The semi-axes (3,) [m]."""
        return np.array(self.fields['semi_axes'], dtype=np.float64)

    @cached_property
    def quat_xyzw(self) -> NDArray[np.float64]:
        """The unit quaternion (4,) from landmark axes to map axes."""
        quat_xyzw = np.array(self.fields['orientation'], dtype=np.float64)
        return np.asarray(quat_xyzw / np.linalg.norm(quat_xyzw))

    @property
    def basis(self) -> NDArray[np.float64]:
        """The basis (3, 3), whose columns are the semi-axes in the map [m]."""
        return np.asarray(Rotation.from_quat(self.quat_xyzw).as_matrix() * self.semi_axes)

    def changed(self, **fields: Any) -> 'Landmark':
        """Return the landmark with changed fields; None removes a field."""
        together = {**self.fields, **fields}
        return replace(self, fields={name: value for name, value in together.items()
                                     if value is not None or name not in fields})


Landmarks = Mapping[str, Landmark]


def map_of(landmarks: Landmarks, frame_id: Any = 'map', source: str = 'studio') -> LandmarkMap:
    """Return landmarks as a map of the relocalizer, without unknown fields.

    MapError: there are no landmarks, or one is invalid; the message names the source, the
    landmark and the field.
    """
    known = {landmark_id: {name: value for name, value in landmark.fields.items()
                           if name in KNOWN_FIELDS} for landmark_id, landmark in landmarks.items()}
    return LandmarkMap.from_mapping({'frame_id': frame_id, 'landmarks': known}, source)


def rounded(values: Iterable[float]) -> list[float]:
    """Round numbers as edits write them."""
    return [round(float(value), DECIMALS) + 0.0 for value in values]


def shape_fields(center: NDArray[np.float64], basis: NDArray[np.float64]) -> dict[str, Any]:
    """Return the fields of an ellipsoid with a centre (3,) and a basis (3, 3) in the map.

    The basis' columns are orthogonal semi-axes [m].
    """
    (lengths,), (quat_xyzw,) = Ellipsoids.none()._replace(bases=basis[None]).axes_and_quats()
    return {'center': rounded(center),
            'semi_axes': rounded(np.maximum(lengths, LEAST_SEMI_AXIS_M)),
            'orientation': rounded(quat_xyzw)}
