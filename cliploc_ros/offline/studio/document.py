# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The document: an edited map with undo, selection, journal and file.

All threads share one document. Each method holds its lock. Callers that need several steps to be
atomic hold it, too.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, RLock
from typing import Any

from cliploc_ros.core.map.landmark_embeddings import embeddings_path
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError, DatasetError, MapError
from cliploc_ros.files.log import Log
from cliploc_ros.files.storage import parse_json
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.map_file import MapFile, read_map_file, text_on_disk

_MAX_HISTORY = 10_000


class Document:
    """An edited map. Its file may not exist yet.

    Attributes
    ----------
    landmarks : mapping of str to Landmark
        By id. Edits replace the mapping and do not modify it.
    changed : Event
        Set after each change of map, selection or file.
    notes : tuple of str
        Remarks about the files, for the user.

    CliplocError: the file is not a map, another studio edits it, or its folder is not writable.
    """

    ACTIONS = ('save', 'overwrite', 'reload', 'undo', 'redo')

    def __init__(self, path: Path):
        self.lock = RLock()
        self.changed = Event()
        #: Whether another program changed the file, until the user decides
        self.has_conflict = False
        self.selection: tuple[str, ...] = ()
        self._done: list[edits.Change] = []
        self._undone: list[edits.Change] = []
        #: The gesture of the last edit, such as a drag, if it may continue
        self.gesture: object = None
        self.file = read_map_file(path)
        self.notes = self.file.notes
        self.landmarks: edits.Landmarks = self.file.landmarks
        self._saved: edits.Landmarks = self.landmarks
        # Edits that are not yet in the file. Before the map is written, the digest of its new
        # content is added to the journal, so that replay works with the old and the new file.
        self._journal = Log(self.path.with_name(f'.{self.path.name}.studio'), DatasetError,
                            "free disk space, and make the map's folder writable",
                            lambda line: dict(parse_json(line)))
        try:
            entries, is_damaged = self._journal.read()
            if is_damaged:
                self._journal.set_aside()
            self._replay(entries)
        except BaseException:
            self._journal.close()
            raise

    # ---- content --------------------------------------------------------------------------------

    @property
    def path(self) -> Path:
        """The map file."""
        return self.file.path

    def take_encoder(self, encoder_key: str) -> None:
        """Set the encoder of the embeddings of a new, empty map; ignored for other maps."""
        with self.lock:
            if not self.file.landmarks and not embeddings_path(self.path).exists():
                self.file = replace(self.file, encoder_key=encoder_key)

    @property
    def selected(self) -> tuple[str, edits.Landmark] | None:
        """Id and landmark of the selection; None unless it is exactly one landmark."""
        with self.lock:
            one = self.selection[0] if len(self.selection) == 1 else None
            return None if one is None else (one, self.landmarks[one])

    def chosen(self) -> tuple[str, ...]:
        """Return the selection; EditError: it is empty."""
        if not self.selection:
            raise edits.EditError('select a landmark first')
        return self.selection

    def only_chosen(self) -> tuple[str, edits.Landmark]:
        """Return id and landmark of the selection; EditError: it is not exactly one landmark."""
        if (selected := self.selected) is None:
            raise edits.EditError('select exactly one landmark first')
        return selected

    @property
    def is_saved(self) -> bool:
        """Return whether the file contains all edits."""
        return self._saved == self.landmarks

    @property
    def to_undo(self) -> str | None:
        """The edit that the next undo reverts."""
        return self._done[-1].what if self._done else None

    @property
    def to_redo(self) -> str | None:
        """The edit that the next redo repeats."""
        return self._undone[-1].what if self._undone else None

    def to_map(self) -> LandmarkMap:
        """Return the map of the relocalizer; MapError: there are no landmarks."""
        return replace(edits.map_of(self.landmarks, self.file.frame_id, self.path.name),
                       map_set=self.file.map_set)

    # ---- edits ----------------------------------------------------------------------------------

    def apply(self, change: edits.Change, gesture: object = None) -> None:
        """Apply a change. Successive changes of one gesture, such as a drag, are undone together.

        CliplocError: the journal cannot be written.
        """
        with self.lock:
            if not change.after:
                return
            joins = gesture is not None and gesture == self.gesture and bool(self._done)
            self._do('join' if joins else 'edit', change)
            self.gesture = gesture

    def edit(self, edit: Callable[..., edits.Change], *arguments: Any, gesture: object = None,
             **values: Any) -> edits.Change:
        """Apply an edit to the current landmarks; return its change.

        Errors: see `edit` and `apply`.
        """
        with self.lock:
            change = edit(self.landmarks, *arguments, **values)
            self.apply(change, gesture)
            return change

    def undo(self) -> str | None:
        """Undo the last edit; return a report, None without an edit."""
        with self.lock:
            if not self._done:
                return None
            before = self.landmarks
            self._do('undo', self._done[-1])
            self.select([key for key in self.landmarks if key not in before] or self.selection)
            return f'undid: {self.to_redo}'

    def redo(self) -> str | None:
        """Redo the edit that was undone last; return a report, None without an edit."""
        with self.lock:
            if not self._undone:
                return None
            self._do('redo', self._undone[-1])
            return f'redid: {self.to_undo}'

    def select(self, landmark_ids: Iterable[str]) -> None:
        """Select landmarks; unknown ids are ignored."""
        with self.lock:
            self.selection = tuple(dict.fromkeys(
                key for key in landmark_ids if key in self.landmarks))
            self.changed.set()

    def _do(self, kind: str, change: edits.Change) -> None:
        self._journal.append({'do': kind, **change.to_json()})
        self._take(kind, change)
        self.changed.set()

    def _take(self, kind: str, change: edits.Change) -> None:
        """Apply a change, and update the history."""
        back, self.landmarks = change.undoing(self.landmarks), change.apply(self.landmarks)
        self.gesture = None
        if kind == 'undo':
            self._undone.append(back)
            del self._done[-1:]
        else:
            if kind == 'join' and self._done:
                back = back._replace(after={**back.after, **self._done.pop().after})
            self._done = [*self._done[1 - _MAX_HISTORY:], back]
            self._undone = self._undone[:-1] if kind == 'redo' else []
        self.selection = tuple(key for key in self.selection if key in self.landmarks)

    # ---- the files ------------------------------------------------------------------------------

    def save(self) -> str:
        """Write the map file atomically; return a report.

        CliplocError: another program changed the file, the map is empty, or a file cannot be
        written. The file is then unchanged.
        """
        with self.lock:
            if text_on_disk(self.path) not in ('', self.file.text):
                self.has_conflict = True
                raise MapError(f'{self.path}: another program changed this file after the studio '
                               'read it; overwrite it, or reload it')
            return self.overwrite()

    def overwrite(self) -> str:
        """Save the map over the content of another program."""
        with self.lock:
            if not self.landmarks:
                raise edits.EditError(f'{self.path}: a map without landmarks is not saved; create '
                                      'one, or delete the file')
            base = self.file
            if self.has_conflict:
                with suppress(CliplocError):  # the set of the other program stays
                    base = read_map_file(self.path)
            file = base.with_landmarks(self.landmarks)
            self._journal.append({'writing': file.digest})
            file.write(self.file)
            self._take_file(file, self.landmarks)
            return f'saved {self.path.name}'

    def reload(self) -> str:
        """Read the map from the file again, as an edit that can be undone.

        CliplocError: the file is not a map, or does not exist.
        """
        with self.lock:
            file = read_map_file(self.path)
            if not file.text:
                raise MapError(f'{self.path}: no such file; saving writes it')
            before = self.landmarks
            found = {key: replace(before.get(key, one), fields=one.fields, look=one.look)
                     for key, one in file.landmarks.items()}
            self._take('edit', edits.Change('reload the file', {**dict.fromkeys(before), **found}))
            self.notes += (*file.notes, *[
                'views and keyframes are those from before: start the studio again'
            ] * (file.map_set != self.file.map_set))
            self._take_file(file, found)
            return f'reloaded {self.path.name}; undo reverts this'

    def _take_file(self, file: MapFile, landmarks: edits.Landmarks) -> None:
        """Note that a file contains the landmarks, and begin a new journal."""
        self.file, self._saved = file, landmarks
        self.gesture, self.has_conflict = None, False
        self._journal.restart([{'base': file.digest}])
        self.changed.set()

    def close(self) -> None:
        """Close the journal; remove it if the file contains all edits."""
        with self.lock:
            self._journal.remove() if self.is_saved else self._journal.close()

    def _replay(self, entries: list[dict[str, Any]]) -> None:
        """Repeat the edits of the journal that are not in the file."""
        digest, done = self.file.digest, list[dict[str, Any]]()
        starts = [row for row, entry in enumerate(entries)
                  if digest in (entry.get('base'), entry.get('writing'))]
        unsaved = [entry for entry in entries[starts[-1] + 1 if starts else 0:] if 'do' in entry]
        is_whole = bool(starts)
        try:
            if unsaved and not starts:
                raise edits.EditError('another program changed the file, so they do not match it')
            for entry in unsaved:
                self._take(str(entry['do']), edits.change_from_json(entry, self.landmarks))
                done.append(entry)
        except (LookupError, TypeError, AttributeError, ValueError, CliplocError) as error:
            is_whole, aside = False, self._journal.set_aside()
            self.notes += (f'could not restore the last {len(unsaved) - len(done)} edits of an '
                           f'earlier session ({error}); they are kept in {aside.name}',)
        if not is_whole:
            self._journal.restart([{'base': digest}, *done])
        if done and not self.is_saved:
            self.notes += (f'restored {len(done)} edits that were not saved; undo reverts '
                           'them',)
