# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The journal of a map: edits that the file does not hold yet, one line of JSON each.

It lies beside the map. A studio that was killed replays it. Before the map is written, the journal
gets the digest of its next content: replay starts at the right edit with either content.
"""

import errno
import fcntl
import itertools
import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from cliploc_ros.errors import DatasetError

# During a drag, a hundred edits a second need not each wait for the disk.
_SYNC_INTERVAL_S = 0.5


class Journal:
    """An append-only file that one process at a time has open; it is created where it is missing.

    DatasetError: another studio has it open, or it cannot be written.
    """

    def __init__(self, path: Path):
        self.path = path
        self._synced_s = 0.0
        try:
            self._file = path.open('a+b', buffering=0)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.close()
            raise DatasetError(f'{path}: another studio edits this map; close it first') from error
        except OSError as error:
            raise DatasetError(f'{path}: edits cannot be kept here: {error.strerror}; make the '
                               'folder of the map writable') from error

    def read(self) -> list[dict[str, Any]]:
        """Return the entries, and cut off the rest after the last valid one.

        A kill leaves half a line. Anything more is copied to another file first.
        """
        content = self._content()
        entries: list[dict[str, Any]] = []
        end = 0
        for line in content.split(b'\n')[:-1]:
            try:
                entry = json.loads(line)
            except (ValueError, RecursionError):
                break
            if not isinstance(entry, dict):
                break
            entries.append(entry)
            end += len(line) + 1
        if b'\n' in content[end:]:
            self.set_aside()
        self._file.truncate(end)
        return entries

    def append(self, entry: dict[str, Any]) -> None:
        """Add an entry; it is on the disk after at most half a second of further edits.

        DatasetError: the disk is full or gone, and the entry is not there.
        """
        line = json.dumps(entry).encode() + b'\n'
        end = self._file.seek(0, os.SEEK_END)
        try:
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            now_s = time.monotonic()
            if now_s - self._synced_s > _SYNC_INTERVAL_S:
                os.fsync(self._file.fileno())
                self._synced_s = now_s
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(end)
            raise DatasetError(f'{self.path}: the edit cannot be kept: {error.strerror}; make '
                               'room and repeat it') from error

    def restart(self, entries: Sequence[dict[str, Any]]) -> None:
        """Replace all entries; DatasetError: the disk is full or gone."""
        try:
            self._file.truncate(0)
        except OSError as error:
            raise DatasetError(f'{self.path}: cannot be written: {error.strerror}') from error
        for entry in entries:
            self.append(entry)

    def set_aside(self) -> Path:
        """Copy the entries to another file, which is never overwritten; return its path."""
        content = self._content()
        for number in itertools.count(1):
            path = self.path.with_name(f'{self.path.name}.{number}')
            try:
                with path.open('xb') as file:
                    file.write(content)
                break
            except FileExistsError:
                pass
            except OSError as error:
                raise DatasetError(f'{path}: cannot be written: {error.strerror}') from error
        return path

    def _content(self) -> bytes:
        self._file.seek(0)
        return self._file.readall()

    def close(self) -> None:
        """Close the file; it stays."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        with suppress(OSError):
            self.path.unlink()
        self._file.close()
