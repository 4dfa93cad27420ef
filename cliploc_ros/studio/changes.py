# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A change of the map as a value: landmarks before and after. Undo exchanges the two."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cliploc_ros.errors import CliplocError
from cliploc_ros.studio.landmark import Landmark, check_landmark
from cliploc_ros.studio.looks import Look

Landmarks = Mapping[str, Landmark]


class EditError(CliplocError):
    """An edit that the map does not allow; the message says what to do."""


@dataclass(frozen=True)
class Change:
    """What an edit does.

    Parameters
    ----------
    what : str
        For the person who edits.
    before, after : mapping of str to Landmark
        By id; None where there is none.
    """

    what: str
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

        Raises
        ------
        EditError
            They are not those that the change starts from.
        """
        for landmark_id, landmark in self.before.items():
            if landmarks.get(landmark_id) != landmark:
                raise EditError(f"{self.what}: landmark '{landmark_id}' is not what it was when "
                                'the edit was made; nothing was changed')
        return {**{key: one for key, one in landmarks.items()
                   if self.after.get(key, one) is not None},
                **{key: one for key, one in self.after.items() if one is not None}}


def change_of(what: str, landmarks: Landmarks, after: Mapping[str, Landmark | None]) -> Change:
    """Return the change to other landmarks, without those that stay as they are.

    Raises
    ------
    EditError
        A landmark is locked.
    MapError
        A landmark would be invalid.
    """
    changed = {key: one for key, one in after.items() if one != landmarks.get(key)}
    for landmark_id, landmark in changed.items():
        old = landmarks.get(landmark_id)
        if old is not None and old.is_locked and (landmark is None or landmark.is_locked):
            raise EditError(f"landmark '{landmark_id}' is locked: unlock it first")
        if landmark is not None:
            check_landmark(landmark_id, landmark, what)
    return Change(what, {key: landmarks.get(key) for key in changed}, changed)


def to_json(change: Change) -> dict[str, Any]:
    """Return a change as JSON holds it."""
    def side(landmarks: Mapping[str, Landmark | None]) -> dict[str, Any]:
        return {key: None if one is None else _landmark_to_json(one)
                for key, one in landmarks.items()}
    return {'what': change.what, 'before': side(change.before), 'after': side(change.after)}


def _landmark_to_json(landmark: Landmark) -> dict[str, Any]:
    look = {} if landmark.look is None else {'look': landmark.look.key}
    return {'fields': landmark.fields, 'locked': landmark.is_locked, **look}


def from_json(tree: Any, looks: Mapping[str, Look]) -> Change:
    """Return a change from JSON.

    Parameters
    ----------
    tree : object
    looks : mapping of str to Look
        By key. A landmark whose look is missing has none.

    Raises
    ------
    ValueError, MapError
        It is none, or a landmark is invalid.
    """
    try:
        what = tree['what']
        before, after = ({key: None if one is None else
                          Landmark(dict(one['fields']), bool(one['locked']),
                                   looks.get(str(one.get('look'))))
                          for key, one in tree[side].items()} for side in ('before', 'after'))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError('not a change') from error
    if not isinstance(what, str) or before.keys() != after.keys():
        raise ValueError('not a change')
    for landmark_id, landmark in after.items():
        if landmark is not None:
            check_landmark(landmark_id, landmark, 'journal')
    return Change(what, before, after)
