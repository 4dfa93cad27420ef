# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a person can do to a map: each function returns a change and alters nothing."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.studio.changes import Change, EditError, Landmarks, change_of
from cliploc_ros.studio.landmark import LEAST_SEMI_AXIS_M, Landmark, rounded, shape_fields
from cliploc_ros.studio.looks import Look, merge_looks

_SOURCE = 'studio'
# What a recording said of a landmark is not known of an ellipsoid that a person placed.
_NOT_MEASURED = {'position_sigma': None}
_MEASURED = ('position_sigma', 'support', 'seen_ratio', 'baseline_deg', 'last_seen')
_NO_EVIDENCE = {**_NOT_MEASURED, 'support': None, 'seen_ratio': None, 'baseline_deg': None}


def move(landmarks: Landmarks, landmark_id: str, center: Sequence[float] | NDArray[np.float64]
         ) -> Change:
    """Put a landmark's centre (3,) somewhere [m]."""
    return _shape(f'move {landmark_id}', landmarks, landmark_id, center=rounded(center))


def rotate(landmarks: Landmarks, landmark_id: str,
           quat_xyzw: Sequence[float] | NDArray[np.float64]) -> Change:
    """Turn a landmark's axes.

    Raises
    ------
    EditError
        The quaternion is zero or not finite.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(quat))
    if not np.isfinite(norm) or norm < 1e-6:
        raise EditError(f'rotate {landmark_id}: the quaternion {quat.tolist()} has no direction; '
                        'give x, y, z, w that are not all 0')
    return _shape(f'rotate {landmark_id}', landmarks, landmark_id,
                  orientation=rounded(quat / norm))


def place(landmarks: Landmarks, landmark_id: str, center: NDArray[np.float64],
          quat_xyzw: NDArray[np.float64]) -> Change:
    """Move and turn a landmark at once, as a gizmo does."""
    return _shape(f'place {landmark_id}', landmarks, landmark_id, center=rounded(center),
                  orientation=rounded(quat_xyzw))


def set_axes(landmarks: Landmarks, landmark_id: str,
             semi_axes: Sequence[float] | NDArray[np.float64]) -> Change:
    """Set a landmark's semi-axes (3,) [m].

    Raises
    ------
    EditError
        One is shorter than a millimetre.
    """
    if not min(semi_axes) >= LEAST_SEMI_AXIS_M:
        raise EditError(f'resize {landmark_id}: semi-axes {rounded(semi_axes)} must each be at '
                        f'least {LEAST_SEMI_AXIS_M:g} m')
    return _shape(f'resize {landmark_id}', landmarks, landmark_id, semi_axes=rounded(semi_axes))


def _shape(what: str, landmarks: Landmarks, landmark_id: str, **fields: Any) -> Change:
    old = _get(landmarks, landmark_id)
    if all(old.fields[name] == value for name, value in fields.items()):
        return Change(what, {}, {})
    return change_of(what, landmarks, {landmark_id: old.changed(**fields, **_NOT_MEASURED)})


def relabel(landmarks: Landmarks, landmark_ids: Iterable[str], label: str) -> Change:
    """Describe landmarks by a text, which takes the place of all weighted phrases."""
    text = ' '.join(label.split())
    after = {key: _get(landmarks, key).changed(label=text, labels=None) for key in landmark_ids
             if _get(landmarks, key).label != text}
    return change_of(f"label '{text[:40]}'", landmarks, after)


def reclass(landmarks: Landmarks, landmark_ids: Iterable[str], class_id: str) -> Change:
    """Give landmarks a detector class, which takes the place of all class weights."""
    name = ' '.join(class_id.split())
    after = {key: _get(landmarks, key).changed(class_id=name, class_weights=None)
             for key in landmark_ids if _get(landmarks, key).class_id != name}
    return change_of(f"class '{name[:40]}'", landmarks, after)


def delete(landmarks: Landmarks, landmark_ids: Iterable[str]) -> Change:
    """Delete landmarks."""
    after = {key: None for key in landmark_ids if _get(landmarks, key)}
    return change_of(f'delete {", ".join(after)}'[:80], landmarks, after)


def lock(landmarks: Landmarks, landmark_ids: Iterable[str]) -> Change:
    """Refuse further edits of landmarks."""
    after = {key: replace(_get(landmarks, key), is_locked=True) for key in landmark_ids}
    return change_of(f'lock {", ".join(after)}'[:80], landmarks, after)


def unlock(landmarks: Landmarks, landmark_ids: Iterable[str]) -> Change:
    """Allow edits of landmarks again."""
    after = {key: replace(_get(landmarks, key), is_locked=False) for key in landmark_ids}
    return change_of(f'unlock {", ".join(after)}'[:80], landmarks, after)


def create(landmarks: Landmarks, label: str, class_id: str, center: NDArray[np.float64],
           basis: NDArray[np.float64], look: Look | None = None) -> Change:
    """Add a landmark. The change has one id, that of the new landmark.

    Parameters
    ----------
    landmarks : mapping
    label, class_id : str
    center, basis : ndarray (3,), (3, 3)
        The basis' columns are the semi-axes [m].
    look : Look, optional
    """
    landmark_id = new_id(landmarks, class_id)
    fields = {'label': ' '.join(label.split()), 'class_id': ' '.join(class_id.split()),
              **shape_fields(center, basis), 'source': _SOURCE}
    return change_of(f'create {landmark_id}', landmarks,
                     {landmark_id: Landmark(fields, look=look)})


def merge(landmarks: Landmarks, landmark_ids: Sequence[str],
          fit: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None) -> Change:
    """Make one landmark of several; the first one's id, label and class stay.

    Parameters
    ----------
    landmarks : mapping
    landmark_ids : sequence of str
        Two or more.
    fit : tuple of ndarray (3,), (3, 3), optional
        Centre and basis that fit the boxes of all. Without it, the ellipsoid has the mean and
        the second moments of the volume of all.
    """
    ids = list(dict.fromkeys(landmark_ids))
    if len(ids) < 2:
        raise EditError('merge: select two landmarks or more')
    parts = [_get(landmarks, key) for key in ids]
    center, basis = fit or _together(parts)
    merged = replace(
        parts[0].changed(**shape_fields(center, basis), **_NO_EVIDENCE),
        look=merge_looks([one.look for one in parts],
                         [one.details.support or 1 for one in parts]))
    return change_of(f'merge {", ".join(ids)}'[:80], landmarks,
                     {ids[0]: merged, **dict.fromkeys(ids[1:])})


def _together(parts: Sequence[Landmark]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centre and basis of the ellipsoid with the moments of all parts' volume.

    A solid ellipsoid with the shape matrix S has the covariance S / 5.
    """
    weights = np.array([one.volume for one in parts])
    weights = weights / weights.sum()
    centers = np.array([one.center for one in parts])
    center = weights @ centers
    shape = np.zeros((3, 3))
    for weight, one in zip(weights, parts, strict=True):
        offset = one.center - center
        shape += weight * (one.basis @ one.basis.T + 5.0 * np.outer(offset, offset))
    squares, directions = np.linalg.eigh(shape)
    return center, directions * np.sqrt(np.maximum(squares, 0.0))


def split(landmarks: Landmarks, landmark_id: str) -> Change:
    """Make two landmarks of one: halves of its longest axis."""
    old = _get(landmarks, landmark_id)
    axes = old.semi_axes.copy()
    longest = int(np.argmax(axes))
    half_way = 0.5 * old.basis[:, longest]
    axes[longest] = max(0.5 * axes[longest], LEAST_SEMI_AXIS_M)
    first, second = (old.changed(center=rounded(old.center + sign * half_way),
                                 semi_axes=rounded(axes), **_NO_EVIDENCE) for sign in (-1, 1))
    return change_of(f'split {landmark_id}', landmarks,
                     {landmark_id: first, new_id(landmarks, old.class_id): second})


def take_fits(landmarks: Landmarks, landmark_ids: Iterable[str], fitted: LandmarkMap) -> Change:
    """Give landmarks the ellipsoids, and what is known of them, of a fitted map.

    Parameters
    ----------
    landmarks : mapping
    landmark_ids : iterable of str
        Those to change.
    fitted : LandmarkMap
    """
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
    return change_of(f'refit {len(after)} landmarks', landmarks, after)


def new_id(landmarks: Landmarks, class_id: str) -> str:
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
