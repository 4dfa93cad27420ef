# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The landmarks of an edited map, and the edits, which return a change and modify nothing.

The relocalizer refuses a map with unknown fields, because a misspelled field would silently have
no effect. The studio opens such a map, keeps the fields, and notes that they are refused.

A look is the image embeddings of a landmark. It is a part of the landmark, so that merge, split,
delete, undo and redo apply to it, too.

A change contains the changed landmarks after the edit. The change that undoes it contains them
before the edit.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map import landmark_details
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.mapping.labelling import choose_medoids
from cliploc_ros.offline.mapping.landmarks import Landmarks as Ellipsoids
from cliploc_ros.offline.mapping.landmarks import unused_ids

KNOWN_FIELDS = ('label', 'class_id', 'center', 'semi_axes', 'orientation',
                *landmark_details.OPTIONAL_FIELDS)
# Edited numbers are rounded to these decimals, so that the file has the numbers that are shown.
_DECIMALS = 6
# The least semi-axis that an edit may set [m]; the file format allows less.
_LEAST_SEMI_AXIS_M = 1e-3
# Fields measured from a recording. They are invalid for an ellipsoid that a person placed.
_NO_EVIDENCE = {'position_sigma': None, 'support': None, 'seen_ratio': None, 'baseline_deg': None}
_MEASURED = (*_NO_EVIDENCE, 'last_seen')
# The name of the edit of each field, and the field that the edit invalidates.
_FIELDS = {'label': ('label', 'labels'), 'class_id': ('class', 'class_weights'),
           'center': ('move', 'position_sigma'), 'semi_axes': ('resize', 'position_sigma'),
           'orientation': ('rotate', 'position_sigma')}


class EditError(CliplocError):
    """An edit that the map does not allow; the message says what to do."""


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
    def details(self) -> landmark_details.LandmarkDetails:
        """The optional fields."""
        return landmark_details.read_details(self.fields, 'landmark')

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
    return [round(float(value), _DECIMALS) + 0.0 for value in values]


def shape_fields(center: NDArray[np.float64], basis: NDArray[np.float64]) -> dict[str, Any]:
    """Return the fields of an ellipsoid with a centre (3,) and a basis (3, 3) in the map.

    The basis' columns are orthogonal semi-axes [m].
    """
    (lengths,), (quat_xyzw,) = Ellipsoids.none()._replace(bases=basis[None]).axes_and_quats()
    return {'center': rounded(center),
            'semi_axes': rounded(np.maximum(lengths, _LEAST_SEMI_AXIS_M)),
            'orientation': rounded(quat_xyzw)}


class Change(NamedTuple):
    """The effect of an edit."""

    what: str  #: Description for the user
    after: Mapping[str, Landmark | None]  #: Landmarks by id, None for a deleted landmark

    def apply(self, landmarks: Landmarks) -> dict[str, Landmark]:
        """Return the landmarks after the change."""
        return {key: landmark for key, landmark in {**landmarks, **self.after}.items()
                if landmark is not None}

    def undoing(self, landmarks: Landmarks) -> 'Change':
        """Return the change that undoes this change of the landmarks."""
        return Change(self.what, {key: landmarks.get(key) for key in self.after})

    def to_json(self) -> dict[str, Any]:
        """Return the change as JSON, without looks and marks."""
        return {'what': self.what, 'after': {key: one and one.fields
                                             for key, one in self.after.items()}}


def change_from_json(tree: Mapping[str, Any], landmarks: Landmarks) -> Change:
    """Return a change of the landmarks from JSON; their looks and marks stay.

    LookupError, TypeError, AttributeError, ValueError or MapError: it is not a change, or a
    landmark is invalid.
    """
    after = {key: fields and replace(landmarks.get(key, Landmark({})), fields=fields)
             for key, fields in tree['after'].items()}
    if valid := {key: landmark for key, landmark in after.items() if landmark is not None}:
        map_of(valid)
    return Change(str(tree['what']), after)


def _change_of(what: str, landmarks: Landmarks, after: Mapping[str, Landmark | None]) -> Change:
    """Return the change to the landmarks `after`; raise for locked and invalid landmarks."""
    changed = {key: landmark for key, landmark in after.items()
               if landmark is not landmarks.get(key)}
    for landmark_id, landmark in changed.items():
        old = landmarks.get(landmark_id)
        if old is not None and old.is_locked and landmark != old:
            raise EditError(f"landmark '{landmark_id}' is locked: unlock it first")
        if landmark is not None:
            map_of({landmark_id: landmark}, source=what)
    return Change(what[:80], changed)


def numbers(value: Any, count: int, what: str) -> list[float]:
    """Return `count` finite numbers of a page's message; EditError: the value is anything else.

    ``what`` names the value in the error.
    """
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise EditError(f'{what}: expected {count} finite numbers, not {value!r:.60}')
    return list(found.tolist())


# ---- edits; EditError: a landmark is unknown or locked; MapError: a value is invalid ------------

def set_fields(landmarks: Landmarks, landmark_ids: Iterable[str], **fields: Any) -> Change:
    """Set fields of landmarks: label, class_id, center, semi_axes, or orientation.

    A quaternion may have any length except 0, a semi-axis is at least a millimetre. A label
    replaces all weighted phrases, a class replaces all class weights.
    """
    ids = list(landmark_ids)
    if (quat_xyzw := fields.get('orientation')) is not None:
        norm = float(np.linalg.norm(quat_xyzw))
        if not 1e-6 <= norm < np.inf:
            raise EditError(f'rotate {", ".join(ids)}: the quaternion {list(quat_xyzw)} has no '
                            'direction; at least one of x, y, z, w must not be 0')
        fields['orientation'] = np.divide(quat_xyzw, norm)
    fields = {name: ' '.join(value.split()) if isinstance(value, str) else rounded(value)
              for name, value in fields.items()}
    if not min(fields.get('semi_axes', [np.inf])) >= _LEAST_SEMI_AXIS_M:
        raise EditError(f'resize {", ".join(ids)}: semi-axes {fields["semi_axes"]} must each be '
                        f'at least {_LEAST_SEMI_AXIS_M:g} m')
    untrue = {_FIELDS[name][1]: None for name in fields}
    names = ' and '.join(_FIELDS[name][0] for name in fields)
    texts = [f"'{value[:40]}'" for value in fields.values() if isinstance(value, str)]
    chosen = {key: _get(landmarks, key) for key in ids}
    return _change_of(f'{names} {", ".join(texts or ids)}', landmarks, {
        key: old.changed(**fields, **untrue) for key, old in chosen.items()
        if any(old.fields.get(name) != value for name, value in fields.items())})


def delete(landmarks: Landmarks, landmark_ids: Iterable[str]) -> Change:
    """Delete landmarks."""
    after = {key: None for key in landmark_ids if _get(landmarks, key)}
    return _change_of(f'delete {", ".join(after)}', landmarks, after)


def mark(landmarks: Landmarks, landmark_ids: Iterable[str], what: str, **marks: Any) -> Change:
    """Set marks of landmarks, also of locked landmarks."""
    chosen = {key: _get(landmarks, key) for key in landmark_ids}
    return _change_of(f'{what} {", ".join(chosen)}', landmarks, {
        key: replace(landmark, **marks) for key, landmark in chosen.items()})


def create(landmarks: Landmarks, label: str, class_id: str, center: NDArray[np.float64],
           basis: NDArray[np.float64], look: LandmarkEmbeddings | None = None) -> Change:
    """Add a landmark with a centre (3,) and a basis (3, 3), whose columns are the semi-axes [m].

    The change contains only the new landmark.
    """
    fields = {'label': ' '.join(label.split()), 'class_id': ' '.join(class_id.split()),
              **shape_fields(center, basis), 'source': 'studio'}
    (landmark_id,) = unused_ids([fields['class_id']], landmarks)
    return _change_of(f'create {landmark_id}', landmarks,
                      {landmark_id: Landmark(fields, look=look)})


def merge(landmarks: Landmarks, landmark_ids: Sequence[str],
          fit: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None) -> Change:
    """Merge two or more landmarks. The result has the first id and label, and all classes.

    `fit` is the centre (3,) and basis (3, 3) that fit the boxes of all landmarks. Without it, the
    ellipsoid has the mean and the second moments of their total volume.
    """
    ids = list(dict.fromkeys(landmark_ids))
    if len(ids) < 2:
        raise EditError('merge: select two landmarks or more')
    parts = [_get(landmarks, key) for key in ids]
    if fit is None:
        # A solid ellipsoid with the shape matrix S has the covariance S / 5.
        centers, bases = (np.array([getattr(part, name) for part in parts])
                          for name in ('center', 'basis'))
        weights = np.array([part.semi_axes.prod() for part in parts])
        weights = weights / weights.sum()
        center = weights @ centers
        offsets = np.sqrt(5.0) * (centers - center)[:, :, None]
        halves = np.concatenate([bases, offsets], axis=2)
        squares, directions = np.linalg.eigh(np.einsum('n,nij,nkj->ik', weights, halves, halves))
        fit = center, directions * np.sqrt(squares)
    classes = landmark_details.join_details([(part.label, part.class_id, part.details)
                                             for part in parts]).class_weights
    merged = replace(
        parts[0].changed(**shape_fields(*fit), **_NO_EVIDENCE,
                         class_weights=None if classes is None else dict(classes)),
        look=_merge_looks([part.look for part in parts],
                          [part.details.support or 1 for part in parts]))
    return _change_of(f'merge {", ".join(ids)}', landmarks,
                      {ids[0]: merged, **dict.fromkeys(ids[1:])})


def split(landmarks: Landmarks, landmark_id: str) -> Change:
    """Split a landmark into two along its longest axis."""
    old = _get(landmarks, landmark_id)
    axes = old.semi_axes.copy()
    longest = int(np.argmax(axes))
    half_way = 0.5 * old.basis[:, longest]
    axes[longest] = max(0.5 * axes[longest], _LEAST_SEMI_AXIS_M)
    first, second = (old.changed(center=rounded(old.center + sign * half_way),
                                 semi_axes=rounded(axes), **_NO_EVIDENCE) for sign in (-1, 1))
    return _change_of(f'split {landmark_id}', landmarks,
                      {landmark_id: first, unused_ids([old.class_id], landmarks)[0]: second})


def take_fits(landmarks: Landmarks, landmark_ids: Iterable[str], fitted: LandmarkMap) -> Change:
    """Replace the ellipsoids of landmarks by those of a fitted map, with optional fields."""
    rows = {key: row for row, key in enumerate(fitted.landmark_ids)}
    after = {}
    for key in landmark_ids:
        row = rows[key]
        known = {name: value if isinstance(value, int) else rounded([value])[0]
                 for name in _MEASURED
                 if (value := getattr(fitted.details[row], name)) is not None}
        after[key] = _get(landmarks, key).changed(
            center=rounded(fitted.centers[row]), semi_axes=rounded(fitted.semi_axes[row]),
            orientation=rounded(fitted.quats_xyzw[row]), **known)
    return _change_of(f'refit {len(after)} landmarks', landmarks, after)


def _merge_looks(looks: Sequence[LandmarkEmbeddings | None], weights: Sequence[float]
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


def _get(landmarks: Landmarks, landmark_id: str) -> Landmark:
    try:
        return landmarks[landmark_id]
    except KeyError:
        raise EditError(f"there is no landmark '{landmark_id}'") from None
