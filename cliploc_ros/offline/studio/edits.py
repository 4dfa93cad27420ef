# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a person can do to a map. Each edit returns a change as a value and alters nothing.

A change holds landmarks before and after; undo exchanges the two.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import join_details
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio.landmark import (
    LEAST_SEMI_AXIS_M,
    Encoded,
    Landmark,
    Marks,
    map_of,
    merge_looks,
    rounded,
    shape_fields,
)

Landmarks = Mapping[str, Landmark]
Vector = Sequence[float] | NDArray[np.float64]

# What a recording said of a landmark is not known of an ellipsoid that a person placed.
_NOT_MEASURED = {'position_sigma': None}
_NO_EVIDENCE = {**_NOT_MEASURED, 'support': None, 'seen_ratio': None, 'baseline_deg': None}
_MEASURED = ('position_sigma', 'support', 'seen_ratio', 'baseline_deg', 'last_seen')


class EditError(CliplocError):
    """An edit that the map does not allow; the message says what to do."""


@dataclass(frozen=True)
class Change:
    """What an edit does."""

    what: str  #: For the person who edits
    #: By id; None where there is none
    before: Mapping[str, Landmark | None]
    after: Mapping[str, Landmark | None]

    def reversed(self) -> 'Change':
        """Return the change that undoes this one."""
        return Change(self.what, self.after, self.before)

    def then(self, later: 'Change') -> 'Change':
        """Return this change and a later one as one."""
        return Change(later.what, {**later.before, **self.before}, {**self.after, **later.after})

    def apply(self, landmarks: Landmarks) -> dict[str, Landmark]:
        """Return the landmarks after the change.

        EditError: they are not those that the change starts from.
        """
        for landmark_id, landmark in self.before.items():
            if landmarks.get(landmark_id) != landmark:
                raise EditError(f"{self.what}: landmark '{landmark_id}' is not what it was when "
                                'the edit was made; nothing was changed')
        return {**{key: one for key, one in landmarks.items()
                   if self.after.get(key, one) is not None},
                **{key: one for key, one in self.after.items() if one is not None}}

    def to_json(self) -> dict[str, Any]:
        """Return the change as JSON holds it; looks are named by their keys."""
        def side(landmarks: Mapping[str, Landmark | None]) -> dict[str, Any]:
            return {key: one and {'fields': one.fields, 'marks': asdict(one.marks),
                                  **({'look': one.look.key} if one.look else {})}
                    for key, one in landmarks.items()}

        return {'what': self.what, 'before': side(self.before), 'after': side(self.after)}


def change_from_json(tree: Any, looks: Mapping[str, Encoded]) -> Change:
    """Return a change from JSON; looks are found by key, and missing ones are left out.

    ValueError, MapError: it is none, or a landmark is invalid.
    """
    try:
        what = tree['what']
        before, after = ({key: None if one is None else
                          Landmark(dict(one['fields']), Marks.from_json(one.get('marks')),
                                   looks.get(str(one.get('look'))))
                          for key, one in tree[side].items()} for side in ('before', 'after'))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError('not a change') from error
    if not isinstance(what, str) or before.keys() != after.keys():
        raise ValueError('not a change')
    for landmark_id, landmark in after.items():
        if landmark is not None:
            map_of({landmark_id: landmark}, 'map', 'journal')
    return Change(what, before, after)


def _change_of(what: str, landmarks: Landmarks, after: Mapping[str, Landmark | None]) -> Change:
    """Return the change to other landmarks; refuse locked and invalid ones."""
    changed = {key: one for key, one in after.items() if one != landmarks.get(key)}
    for landmark_id, landmark in changed.items():
        old = landmarks.get(landmark_id)
        if old is not None and old.marks.is_locked and (
                landmark is None or landmark.fields != old.fields):
            raise EditError(f"landmark '{landmark_id}' is locked: unlock it first")
        if landmark is not None:
            map_of({landmark_id: landmark}, 'map', what)
    return Change(what, {key: landmarks.get(key) for key in changed}, changed)


# ---- edits; EditError: a landmark is unknown or locked; MapError: a value is invalid ------------

def move(landmarks: Landmarks, landmark_id: str, center: Vector) -> Change:
    """Put a landmark's centre (3,) somewhere [m]."""
    return _shape(f'move {landmark_id}', landmarks, landmark_id, center=rounded(center))


def rotate(landmarks: Landmarks, landmark_id: str, quat_xyzw: Vector) -> Change:
    """Turn a landmark's axes to a quaternion of any length but 0."""
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(quat))
    if not np.isfinite(norm) or norm < 1e-6:
        raise EditError(f'rotate {landmark_id}: the quaternion {quat.tolist()} has no direction; '
                        'give x, y, z, w that are not all 0')
    return _shape(f'rotate {landmark_id}', landmarks, landmark_id,
                  orientation=rounded(quat / norm))


def place(landmarks: Landmarks, landmark_id: str, center: Vector, quat_xyzw: Vector) -> Change:
    """Move and turn a landmark at once, as a gizmo does."""
    return _shape(f'place {landmark_id}', landmarks, landmark_id, center=rounded(center),
                  orientation=rounded(quat_xyzw))


def set_axes(landmarks: Landmarks, landmark_id: str, semi_axes: Vector) -> Change:
    """Set a landmark's semi-axes (3,) [m], a millimetre or more each."""
    if not min(semi_axes) >= LEAST_SEMI_AXIS_M:
        raise EditError(f'resize {landmark_id}: semi-axes {rounded(semi_axes)} must each be at '
                        f'least {LEAST_SEMI_AXIS_M:g} m')
    return _shape(f'resize {landmark_id}', landmarks, landmark_id, semi_axes=rounded(semi_axes))


def _shape(what: str, landmarks: Landmarks, landmark_id: str, **fields: Any) -> Change:
    old = _get(landmarks, landmark_id)
    if all(old.fields[name] == value for name, value in fields.items()):
        return Change(what, {}, {})
    return _change_of(what, landmarks, {landmark_id: old.changed(**fields, **_NOT_MEASURED)})


def relabel(landmarks: Landmarks, landmark_ids: Iterable[str], label: str) -> Change:
    """Describe landmarks by a text, which takes the place of all weighted phrases."""
    text = ' '.join(label.split())
    after = {key: _get(landmarks, key).changed(label=text, labels=None) for key in landmark_ids
             if _get(landmarks, key).label != text}
    return _change_of(f"label '{text[:40]}'", landmarks, after)


def reclass(landmarks: Landmarks, landmark_ids: Iterable[str], class_id: str) -> Change:
    """Give landmarks a detector class, which takes the place of all class weights."""
    name = ' '.join(class_id.split())
    after = {key: _get(landmarks, key).changed(class_id=name, class_weights=None)
             for key in landmark_ids if _get(landmarks, key).class_id != name}
    return _change_of(f"class '{name[:40]}'", landmarks, after)


def delete(landmarks: Landmarks, landmark_ids: Iterable[str]) -> Change:
    """Delete landmarks."""
    after = {key: None for key in landmark_ids if _get(landmarks, key)}
    return _change_of(f'delete {", ".join(after)}'[:80], landmarks, after)


def mark(landmarks: Landmarks, landmark_ids: Iterable[str], what: str, **marks: Any) -> Change:
    """Set marks of landmarks, locked ones included."""
    chosen = {key: _get(landmarks, key) for key in landmark_ids}
    after = {key: replace(one, marks=replace(one.marks, **marks)) for key, one in chosen.items()}
    return _change_of(f'{what} {", ".join(after)}'[:80], landmarks, after)


def create(landmarks: Landmarks, label: str, class_id: str, center: NDArray[np.float64],
           basis: NDArray[np.float64], look: Encoded | None = None) -> Change:
    """Add a landmark of a centre (3,) and a basis (3, 3), whose columns are the semi-axes [m].

    The change has one id, that of the new landmark.
    """
    landmark_id = _new_id(landmarks, class_id)
    fields = {'label': ' '.join(label.split()), 'class_id': ' '.join(class_id.split()),
              **shape_fields(center, basis), 'source': 'studio'}
    return _change_of(f'create {landmark_id}', landmarks,
                      {landmark_id: Landmark(fields, look=look)})


def merge(landmarks: Landmarks, landmark_ids: Sequence[str],
          fit: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None) -> Change:
    """Make one landmark of two or more, with the classes of all; the first id and label stay.

    A fit is the centre (3,) and basis (3, 3) that fit the boxes of all. Without it, the ellipsoid
    has the mean and the second moments of the volume of all.
    """
    ids = list(dict.fromkeys(landmark_ids))
    if len(ids) < 2:
        raise EditError('merge: select two landmarks or more')
    parts = [_get(landmarks, key) for key in ids]
    if fit is None:
        # A solid ellipsoid with the shape matrix S has the covariance S / 5.
        weights = np.array([one.semi_axes.prod() for one in parts])
        weights = weights / weights.sum()
        center = weights @ np.array([one.center for one in parts])
        shape = np.zeros((3, 3))
        for weight, one in zip(weights, parts, strict=True):
            offset = one.center - center
            shape += weight * (one.basis @ one.basis.T + 5.0 * np.outer(offset, offset))
        squares, directions = np.linalg.eigh(shape)
        fit = center, directions * np.sqrt(np.maximum(squares, 0.0))
    classes = join_details([(one.label, one.class_id, one.details) for one in parts]).class_weights
    merged = replace(
        parts[0].changed(**shape_fields(*fit), **_NO_EVIDENCE,
                         class_weights=None if classes is None else dict(classes)),
        look=merge_looks([one.look for one in parts],
                         [one.details.support or 1 for one in parts]))
    return _change_of(f'merge {", ".join(ids)}'[:80], landmarks,
                      {ids[0]: merged, **dict.fromkeys(ids[1:])})


def split(landmarks: Landmarks, landmark_id: str) -> Change:
    """Make two landmarks of one: halves of its longest axis."""
    old = _get(landmarks, landmark_id)
    axes = old.semi_axes.copy()
    longest = int(np.argmax(axes))
    half_way = 0.5 * old.basis[:, longest]
    axes[longest] = max(0.5 * axes[longest], LEAST_SEMI_AXIS_M)
    first, second = (old.changed(center=rounded(old.center + sign * half_way),
                                 semi_axes=rounded(axes), **_NO_EVIDENCE) for sign in (-1, 1))
    return _change_of(f'split {landmark_id}', landmarks,
                      {landmark_id: first, _new_id(landmarks, old.class_id): second})


def take_fits(landmarks: Landmarks, landmark_ids: Iterable[str], fitted: LandmarkMap) -> Change:
    """Give landmarks the ellipsoids, and what is known of them, of a fitted map."""
    rows = {key: row for row, key in enumerate(fitted.landmark_ids)}
    after = {}
    for key in landmark_ids:
        row = rows[key]
        known = {name: rounded([value])[0] for name in _MEASURED
                 if (value := getattr(fitted.details[row], name)) is not None}
        if 'support' in known:
            known['support'] = int(known['support'])
        after[key] = _get(landmarks, key).changed(
            center=rounded(fitted.centers[row]), semi_axes=rounded(fitted.semi_axes[row]),
            orientation=rounded(fitted.quats_xyzw[row]), **known)
    return _change_of(f'refit {len(after)} landmarks', landmarks, after)


def _new_id(landmarks: Landmarks, class_id: str) -> str:
    """Return an id that no landmark has: the class and a number."""
    stem = re.sub(r'\W+', '_', class_id).strip('_') or 'landmark'
    number = 1
    while f'{stem}_{number}' in landmarks:
        number += 1
    return f'{stem}_{number}'


def _get(landmarks: Landmarks, landmark_id: str) -> Landmark:
    try:
        return landmarks[landmark_id]
    except KeyError:
        raise EditError(f"there is no landmark '{landmark_id}'") from None
