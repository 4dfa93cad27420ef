# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The document: a map that is edited, with undo, a selection, a journal, and saving.

All threads share one document. Each method holds its lock; a caller that needs several steps at
once holds it, too.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from threading import RLock
from typing import Any

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError, DatasetError, MapError
from cliploc_ros.files.log import Log
from cliploc_ros.offline.studio.edits import Change, EditError, Landmarks, change_from_json
from cliploc_ros.offline.studio.landmark import (
    KNOWN_FIELDS,
    Encoded,
    Landmark,
    Marks,
    look_from_json,
    map_of,
)
from cliploc_ros.offline.studio.map_file import (
    NO_FILE,
    ChangedOnDiskError,
    LookFile,
    read_look_file,
    read_map_file,
)

_MAX_HISTORY = 10_000


class Document:
    """A map that is edited. Its file may not exist yet.

    Attributes
    ----------
    landmarks : mapping of str to Landmark
        By id. An edit makes a new mapping and leaves this one alone.
    revision : int
        Counts the changes of map, selection and file.
    notes : tuple of str
        What a person should know of the files.

    CliplocError: the file is no map, another studio edits it, or its folder is not writable.
    """

    def __init__(self, path: Path):
        self.lock = RLock()
        self.revision = 0
        self.notes: tuple[str, ...] = ()
        self.selection: tuple[str, ...] = ()
        self._listeners: list[Callable[[], None]] = []
        self._done: list[Change] = []
        self._undone: list[Change] = []
        self._gesture: object = None
        self._file = read_map_file(path)
        self._look_file = self._read_looks()
        self.landmarks: Landmarks = self._landmarks_of_file()
        self._saved: Landmarks = self.landmarks
        # Edits that the file does not hold yet. Before the map is written, the journal gets the
        # digest of its next content: replay starts at the right edit with either content.
        self._journal = Log(self.path.with_name(f'.{self.path.name}.studio'), DatasetError,
                            "make room, and the map's folder writable", _parse_entry)
        try:
            entries, is_damaged = self._journal.read()
            if is_damaged:
                self._journal.set_aside()
            self._replay(entries)
        except BaseException:
            self._journal.close()
            raise
        self._note_unknown_fields()

    # ---- what it holds --------------------------------------------------------------------------

    @property
    def path(self) -> Path:
        """The map file."""
        return self._file.path

    @property
    def frame_id(self) -> str:
        """The coordinate frame of the map."""
        return self._file.frame_id

    @property
    def encoder_key(self) -> str:
        """The encoder of the landmarks' looks; '' where the map has none."""
        return self._look_file.encoder_key

    def take_encoder(self, encoder_key: str) -> None:
        """Let a map that starts empty have looks of an encoder; any other map stays as it is."""
        with self.lock:
            if not self._file.landmarks and self._look_file.state is None:
                self._look_file = self._look_file._replace(encoder_key=encoder_key)

    @property
    def selected(self) -> tuple[str, Landmark] | None:
        """Id and landmark of a selection of exactly one."""
        with self.lock:
            if len(self.selection) != 1:
                return None
            return self.selection[0], self.landmarks[self.selection[0]]

    @property
    def is_saved(self) -> bool:
        """Whether the file holds all edits."""
        return fields_of(self._saved) == fields_of(self.landmarks)

    @property
    def to_undo(self) -> str | None:
        """The edit that the next undo takes back."""
        return self._done[-1].what if self._done else None

    @property
    def to_redo(self) -> str | None:
        """The edit that the next redo does again."""
        return self._undone[-1].what if self._undone else None

    @property
    def is_in_gesture(self) -> bool:
        """Whether the last edit may go on, as a drag does."""
        return self._gesture is not None

    def to_map(self) -> LandmarkMap:
        """Return the map as the relocalizer knows it; MapError where it has no landmarks."""
        return map_of(self.landmarks, self.frame_id, self.path.name)

    # ---- edits ----------------------------------------------------------------------------------

    def apply(self, change: Change, gesture: object = None) -> None:
        """Make a change; successive ones of one gesture, as of a drag, are undone together.

        CliplocError: the landmarks are not those the change starts from, or the journal cannot be
        written.
        """
        with self.lock:
            if not change.after:
                return
            joins = gesture is not None and gesture == self._gesture and bool(self._done)
            self._do('join' if joins else 'edit', change)
            self._gesture = gesture

    def undo(self) -> bool:
        """Undo the last edit; return whether there was one."""
        with self.lock:
            if self._done:
                self._do('undo', self._done[-1].reversed())
                return True
            return False

    def redo(self) -> bool:
        """Do again the edit that was undone last; return whether there was one."""
        with self.lock:
            if self._undone:
                self._do('redo', self._undone[-1])
                return True
            return False

    def select(self, landmark_ids: Iterable[str]) -> None:
        """Select landmarks; unknown ids are left out."""
        with self.lock:
            self.selection = tuple(dict.fromkeys(
                key for key in landmark_ids if key in self.landmarks))
            self._tell()

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Call a function after each change of map, selection or file, with the lock held."""
        self._listeners.append(listener)

    def _tell(self) -> None:
        self.revision += 1
        for listener in self._listeners:
            listener()

    def _do(self, kind: str, change: Change) -> None:
        landmarks = change.apply(self.landmarks)
        for one in change.after.values():
            if one is not None and one.look is not None and one.look.key not in self._kept_looks:
                self._journal.append(one.look.to_json())
                self._kept_looks.add(one.look.key)
        self._journal.append({'do': kind, **change.to_json()})
        self._take(kind, change, landmarks)
        self._tell()

    def _take(self, kind: str, change: Change, landmarks: Landmarks) -> None:
        """Take over a change that was applied, and write history."""
        self.landmarks = landmarks
        self._gesture = None
        if kind == 'join' and self._done:
            self._done[-1] = self._done[-1].then(change)
        elif kind == 'undo':
            self._undone.append(change.reversed())
            del self._done[-1:]
        else:
            self._done.append(change)
            del self._done[:-_MAX_HISTORY]
            if kind == 'redo':
                del self._undone[-1:]
        if kind in ('edit', 'join'):
            self._undone.clear()
        self.selection = tuple(key for key in self.selection if key in landmarks)

    # ---- the files ------------------------------------------------------------------------------

    def save(self, over: str = NO_FILE) -> None:
        """Write the map file in one step, over a foreign content only if ``over`` is its digest.

        Raises
        ------
        ChangedOnDiskError
            Another program changed the file.
        CliplocError
            The map is empty, or a file cannot be written; that one is as it was.
        """
        with self.lock:
            if not self.landmarks:
                raise EditError(f'{self.path}: a map without landmarks is not saved; create one, '
                                'or delete the file')
            self.to_map()
            found = self._file.digest_on_disk()
            if found not in (NO_FILE, self._file.digest, over):
                raise ChangedOnDiskError(self.path, found)
            file = self._file.with_landmarks(self.landmarks)
            self._journal.append({'writing': file.digest, 'looks': self._changed_looks()})
            file.write()
            self._file = file
            self._write_looks()
            self._saved = self.landmarks
            self._gesture = None
            self._restart_journal()
            self._tell()

    def reload(self) -> None:
        """Take the map from the file; this is an edit that undo takes back.

        CliplocError: the file is no map.
        """
        with self.lock:
            self._file = read_map_file(self.path)
            self._look_file = self._read_looks()
            before = self.landmarks
            found = {key: replace(one, marks=before[key].marks if key in before else Marks())
                     for key, one in self._landmarks_of_file().items()}
            after = {**dict.fromkeys(before), **found}
            self._take('edit', Change('reload the file', {key: before.get(key) for key in after},
                                      after), found)
            self._saved = found
            self._restart_journal()
            self._note_unknown_fields()
            self._tell()

    def close(self) -> None:
        """Release the journal, which stays if it holds edits or marks."""
        with self.lock:
            is_needed = not self.is_saved or self._marks()
            self._journal.close() if is_needed else self._journal.remove()

    def _landmarks_of_file(self) -> dict[str, Landmark]:
        return {key: replace(one, look=self._look_file.looks.get(key))
                for key, one in self._file.landmarks.items()}

    def _note_unknown_fields(self) -> None:
        unknown = {name: key for key, one in self.landmarks.items()
                   for name in one.fields if name not in KNOWN_FIELDS}
        for name, landmark_id in list(unknown.items())[:5]:
            self.notes += (f"field '{name}' (landmark '{landmark_id}') is kept, but the "
                           'relocalizer refuses a map with unknown fields',)

    def _read_looks(self) -> LookFile:
        found, fault = read_look_file(self.path)
        self.notes += (fault,) if fault else ()
        self._kept_looks = {look.key for look in found.looks.values()}
        return found

    def _write_looks(self) -> None:
        self._look_file, fault = self._look_file.write(self.landmarks)
        self.notes += (fault,) if fault and fault not in self.notes else ()

    def _changed_looks(self) -> dict[str, str]:
        """Return the keys of looks that the file holds otherwise, '' for none."""
        old, new = ({key: '' if one.look is None else one.look.key
                     for key, one in landmarks.items()}
                    for landmarks in (self._landmarks_of_file(), self.landmarks))
        return {key: look for key, look in new.items() if look != old.get(key, '')}

    # ---- the journal ----------------------------------------------------------------------------

    def _restart_journal(self) -> None:
        self._kept_looks = {look.key for look in self._look_file.looks.values()}
        self._journal.restart([self._header()])

    def _header(self) -> dict[str, Any]:
        return {'base': self._file.digest, 'marks': self._marks()}

    def _marks(self) -> dict[str, Any]:
        return {key: asdict(one.marks) for key, one in self.landmarks.items()
                if one.marks != Marks()}

    def _replay(self, entries: list[dict[str, Any]]) -> None:
        """Do again the edits in the journal, from the content that the file has."""
        digest = self._file.digest
        starts = [row for row, entry in enumerate(entries)
                  if digest in (entry.get('base'), entry.get('writing'))]
        edits = [entry for entry in entries if 'do' in entry]
        if not starts:
            if edits:
                aside = self._journal.set_aside()
                self.notes += (f'{len(edits)} edits of an earlier session do not fit the file, '
                               f'which another program changed; they lie in {aside.name}',)
            self._journal.restart([self._header()])
            return
        kept = [*self._look_file.looks.values(), *map(look_from_json, entries)]
        looks = {look.key: look for look in kept if look is not None}
        self._kept_looks = set(looks)
        start = starts[-1]
        self._restore_start(entries[:start + 1], looks)
        edits = [entry for entry in entries[start + 1:] if 'do' in entry]
        count = 0
        try:
            for entry in edits:
                change = change_from_json(entry, looks)
                self._take(str(entry['do']), change, change.apply(self.landmarks))
                count += 1
        except (ValueError, CliplocError) as error:
            aside = self._journal.set_aside()
            in_file = {look.key for look in self._look_file.looks.values()}
            self._journal.restart([
                self._header(), *(look.to_json() for key, look in looks.items()
                                  if key not in in_file), *edits[:count]])
            self.notes += (f'the last {len(edits) - count} edits of an earlier session cannot be '
                           f'restored ({error}); they lie in {aside.name}',)
        if count and not self.is_saved:
            self.notes += (f'restored {count} edits that were not saved; undo takes them back',)

    def _restore_start(self, entries: list[dict[str, Any]], looks: Mapping[str, Encoded]) -> None:
        """Restore the state that belongs to the file's content: its marks and looks.

        Marks before a content that was written come from the header and the edits up to it. A
        save that ended between the map and its image embeddings is finished.
        """
        marks: dict[str, Any] = {}
        for entry in entries:
            if isinstance(kept := entry.get('marks'), dict):
                marks |= kept
            if isinstance(after := entry.get('after'), dict):
                marks |= {key: one.get('marks') for key, one in after.items()
                          if isinstance(one, dict)}
        keys = entries[-1].get('looks')
        keys = keys if isinstance(keys, dict) else {}
        self.landmarks = self._saved = {
            key: replace(one, marks=Marks.from_json(marks.get(key)),
                         look=looks.get(str(keys[key])) if key in keys else one.look)
            for key, one in self.landmarks.items()}
        if keys:
            try:
                self._write_looks()
            except MapError as error:
                self.notes += (str(error),)


def fields_of(landmarks: Landmarks) -> dict[str, Mapping[str, Any]]:
    """Return the fields of landmarks, which tell whether a map was edited; locks do not."""
    return {key: one.fields for key, one in landmarks.items()}


def _parse_entry(line: bytes) -> dict[str, Any]:
    entry = json.loads(line)
    if not isinstance(entry, dict):
        raise ValueError('an entry is a mapping')
    return entry
