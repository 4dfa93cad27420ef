# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An append-only file of entries, which survives a kill of its process."""

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
from cliploc_ros.files.storage import open_file, parse_json, replace_file

# While the user drags a landmark, a hundred entries a second must not each wait for the disk.
_SYNC_INTERVAL_S = 0.5


class Log:
    """A file of JSON entries, one per line, which one process at a time can open.

    Parameters
    ----------
    error : type of CliplocError
        Exception to raise, here and in other methods.
    advice : str
        Advice to the user if the file cannot be written.
    parse : callable
        Converts a line to an entry, or raises any Exception if it is damaged.
    """

    def __init__(self, path: Path, error: type[CliplocError], advice: str,
                 parse: Callable[[bytes], Any] = parse_json) -> None:
        self.path = path
        self._error, self._advice, self._parse = error, advice, parse
        self._synced_s = 0.0
        try:
            if path.exists():
                open_file(path).close()  # for a message if it is not a regular file
            self._file = path.open('a+b', buffering=0)
        except OSError as problem:
            raise self._unwritable(problem) from problem
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as problem:
            self.close()
            raise error(f'{path}: open in another studio or run; close that first') from problem
        except OSError:
            pass  # some file systems do not support locks
        self._end = self._file.seek(0, os.SEEK_END)

    def read(self) -> tuple[list[Any], bool]:
        """Return the entries before the first damaged line, and whether there is a damaged line.

        A partial last line, as left by a kill, is not damage. The next entry overwrites everything
        after the returned entries.
        """
        entries: list[Any] = []
        self._end = 0
        with self.path.open('rb') as file:
            for line in file:
                if not line.endswith(b'\n'):
                    break
                try:
                    entries.append(self._parse(line))
                except Exception:  # damaged content may cause any exception
                    return entries, True
                self._end += len(line)
        return entries, False

    def append(self, entry: Any) -> None:
        """Add an entry; the file is flushed to disk at most every half second.

        Raises CliplocError if the disk is full or gone; the entry is then not in the file.
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
        """Replace all entries at once; CliplocError: the disk is full or gone, they are kept."""
        try:
            with replace_file(self.path) as partial:
                partial.write_text(''.join(f'{json.dumps(entry)}\n' for entry in entries))
                file = partial.open('a+b', buffering=0)
                # shared, as replace_file holds it too; it still excludes the lock of __init__
                with suppress(OSError):
                    fcntl.flock(file, fcntl.LOCK_SH)
        except OSError as problem:
            raise self._unwritable(problem) from problem
        self._file.close()
        self._file, self._end = file, file.seek(0, os.SEEK_END)

    def set_aside(self) -> Path:
        """Copy the file to a new file, without overwriting any file; return its path."""
        for number in itertools.count(1):
            path = self.path.with_name(f'{self.path.name}.{number}')
            try:
                with path.open('xb') as copy, self.path.open('rb') as content:
                    shutil.copyfileobj(content, copy)
                break
            except FileExistsError:
                pass
            except OSError as problem:
                path.unlink(missing_ok=True)
                raise self._error(f'{path}: cannot be written: {problem.strerror}') from problem
        return path

    def close(self) -> None:
        """Close the file, without deleting it."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        with suppress(OSError):
            self.path.unlink()
        self._file.close()

    def _unwritable(self, problem: OSError) -> CliplocError:
        return self._error(f'{self.path}: cannot be written: {problem.strerror}; {self._advice}')
