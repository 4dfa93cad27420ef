# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Partial results of a run on disk, so that a run that was stopped can go on.

A file of chunks, to which only is appended: each is its length and check sum, then its bytes. A
chunk that was cut off is dropped when the file is opened again. The first chunk says what run it
is: partial results of another run are thrown away.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from cliploc_ros.errors import DatasetError

_HEAD = struct.Struct('<QI')  # length and CRC-32 of what follows


class Journal:
    """A context manager: an open file of chunks.

    Parameters
    ----------
    run : bytes
        Says what run it is.

    Raises
    ------
    DatasetError
        On entry and when a chunk is added, if the file cannot be written.
    """

    def __init__(self, path: Path, run: bytes) -> None:
        self.path = path
        self._run = run
        self._first_record = 0

    def __enter__(self) -> Self:
        """Open the file, and drop what was cut off or belongs to another run."""
        try:
            self._file = self.path.open('a+b')
            end, first = 0, b''
            for number, (chunk, after) in enumerate(self._chunks(0)):
                if number == 0:
                    first, self._first_record = chunk, after
                end = after
            if first == self._run:
                self._file.truncate(end)
            else:
                self._file.truncate(0)
        except OSError as error:
            raise self._unwritable(error) from error
        if first != self._run:
            self.add(self._run)
            self._first_record = self._file.tell()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the file; it stays."""
        with suppress(OSError):  # of a full disk, which was reported when it happened
            self._file.close()

    def chunks(self) -> Iterator[bytes]:
        """Yield what was added, one at a time, in this run and in earlier ones."""
        for chunk, _ in self._chunks(self._first_record):
            yield chunk

    def add(self, chunk: bytes) -> None:
        """Append a chunk."""
        try:
            self._file.seek(0, os.SEEK_END)
            self._file.write(_HEAD.pack(len(chunk), zlib.crc32(chunk)))
            self._file.write(chunk)
            self._file.flush()
        except OSError as error:
            raise self._unwritable(error) from error

    def remove(self) -> None:
        """Remove the file: the run is finished."""
        self.path.unlink(missing_ok=True)

    def _chunks(self, start: int) -> Iterator[tuple[bytes, int]]:
        """Yield the whole chunks from a position on, each with the position after it."""
        position = start
        while True:
            self._file.seek(position)
            head = self._file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return
            length, check_sum = _HEAD.unpack(head)
            remaining = self.path.stat().st_size - position - _HEAD.size
            if length > remaining:
                return
            chunk = self._file.read(length)
            if zlib.crc32(chunk) != check_sum:
                return
            position += _HEAD.size + length
            yield chunk, position

    def _unwritable(self, error: OSError) -> DatasetError:
        return DatasetError(f'{self.path}: cannot be written: {error.strerror}; make room or name '
                            'another file with --record-to, then run again: it goes on from here')
