# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An append-only file of entries, which survives the end of its process."""

import errno
import fcntl
import itertools
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from cliploc_ros.errors import CliplocError
from cliploc_ros.files.storage import open_file, parse_json

# During a drag, a hundred entries a second need not each wait for the disk.
_SYNC_INTERVAL_S = 0.5


class Log:
    """Entries of JSON, one a line, in a file that one process at a time has open.

    Parameters
    ----------
    error : type of CliplocError
        What is raised, here and when an entry is added.
    advice : str
        What to do about a file that cannot be written.
    parse : callable
        Returns the entry of a line, or raises any Exception for a damaged one.
    """

    def __init__(self, path: Path, error: type[CliplocError], advice: str,
                 parse: Callable[[bytes], Any] = parse_json) -> None:
        self.path = path
        self._error, self._advice, self._parse = error, advice, parse
        self._synced_s = 0.0
        try:
            if path.exists():
                open_file(path).close()  # to say what else it is
            self._file = path.open('a+b', buffering=0)
        except OSError as problem:
            raise self._unwritable(problem) from problem
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as problem:
            self.close()
            raise error(f'{path}: another studio or run has it open; close it first') from problem
        except OSError:
            pass  # some file systems have no locks
        self._end = self._file.seek(0, os.SEEK_END)

    def read(self) -> tuple[list[Any], bool]:
        """Return the entries before the first damaged line, and whether that is a whole line.

        A kill leaves a part of a line, which is not damage. The next entry replaces the rest.
        """
        entries: list[Any] = []
        self._end = 0
        with self.path.open('rb') as file:
            for line in file:
                if not line.endswith(b'\n'):
                    break
                try:
                    entries.append(self._parse(line))
                except Exception:  # whatever the content causes
                    return entries, True
                self._end += len(line)
        return entries, False

    def append(self, entry: Any) -> None:
        """Add an entry; it is on the disk after at most half a second of further entries.

        CliplocError: the disk is full or gone, and the entry is not there.
        """
        line = json.dumps(entry).encode() + b'\n'
        try:
            if self._file.seek(0, os.SEEK_END) != self._end:
                self._file.truncate(self._end)
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            now_s = time.monotonic()
            if now_s - self._synced_s > _SYNC_INTERVAL_S:
                os.fsync(self._file.fileno())
                self._synced_s = now_s
        except OSError as problem:
            with suppress(OSError):
                self._file.truncate(self._end)
            raise self._unwritable(problem) from problem
        self._end += len(line)

    def restart(self, entries: Sequence[Any]) -> None:
        """Replace all entries; CliplocError: the disk is full or gone."""
        self._end = 0
        for entry in entries:
            self.append(entry)

    def set_aside(self) -> Path:
        """Copy the file to another one, which is never overwritten; return its path."""
        for number in itertools.count(1):
            path = self.path.with_name(f'{self.path.name}.{number}')
            try:
                with self.path.open('rb') as content, path.open('xb') as copy:
                    shutil.copyfileobj(content, copy)
                break
            except FileExistsError:
                pass
            except OSError as problem:
                raise self._error(f'{path}: cannot be written: {problem.strerror}') from problem
        return path

    def close(self) -> None:
        """Close the file; it stays."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        with suppress(OSError):
            self.path.unlink()
        self._file.close()

    def _unwritable(self, problem: OSError) -> CliplocError:
        return self._error(
            f'{self.path}: cannot be written: {problem.strerror}; {self._advice}')
