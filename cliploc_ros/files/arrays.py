# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The schema of an npz file: its arrays, with their types, shapes and values.

A reader is defined by a table of fields. Files are untrusted: an invalid file causes an error that
names the file, the array and the row. Pickles are refused, checksums are verified, and no array
takes more memory than the file declares. Large arrays may stay in the file.
"""

import math
import os
import weakref
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.files.storage import MAKE_ROOM, open_file, replace_file

#: Arrays by name.
Arrays = Mapping[str, NDArray[Any]]

# Groups of NumPy types by their kind codes. A field may also name a single NumPy type.
_KINDS = {'text': 'U', 'numbers': 'fiu', 'floats': 'f', 'integers': 'iu', 'booleans': 'b'}
_ROWS_AT_ONCE = 10_000
# A larger array may stay in the file; its checksum is verified in blocks of this size.
_STORED_BYTES, _BLOCK_BYTES = 16 * 2**20, 2**20
# Maximum memory of the arrays: this number of bytes, or this multiple of the file's size on disk.
# A small or sparse file may declare arrays of any size.
_MOST_BYTES, _MOST_GROWTH = 512 * 2**20, 8
# Larger than any pixel coordinate, coordinate [m] or time [s].
_MOST = 1e10


class ArrayError(Exception):
    """A fault of an array; the schema adds the file's name."""


@dataclass(frozen=True)
class Check:
    """A condition that each row of an array must meet."""

    what: str  #: Fault of a row that fails the check, such as 'is not finite'
    #: Takes the array (n, ...); returns a mask (n,) of the rows that fail
    is_wrong: Callable[[NDArray[Any]], NDArray[np.bool_]]

    def __call__(self, name: str, arrays: Arrays) -> None:
        """Raise ArrayError if a row fails."""
        wrong = self.is_wrong(arrays[name])
        if wrong.any():
            raise ArrayError(f'array {name} {self.what} in row {int(np.argmax(wrong))}')


@dataclass(frozen=True)
class Offsets:
    """A check of offsets, which divide the rows of another array into consecutive parts."""

    counted: str
    what: str

    def __call__(self, name: str, arrays: Arrays) -> None:
        """Raise ArrayError if the offsets do not cover all rows in ascending order."""
        offsets, count = arrays[name].astype(np.int64), len(arrays[self.counted])
        if offsets[0] != 0 or offsets[-1] != count:
            raise ArrayError(f'array {name} ranges from {offsets[0]} to {offsets[-1]}, expected 0 '
                             f'to {count}, the number of {self.what}')
        Check('decreases', lambda all_: np.diff(offsets, prepend=0) < 0)(name, arrays)


def _is_not_finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Check blocks of rows: their copies as floats take up to eight times the memory."""
    within_row = tuple(range(1, values.ndim))
    return np.concatenate([
        ~(np.abs(values[first:first + _ROWS_AT_ONCE].astype(float)) <= _MOST).all(axis=within_row)
        for first in range(0, len(values) or 1, _ROWS_AT_ONCE)])


FINITE = Check(f'is beyond {_MOST:g} or not finite', _is_not_finite)
UNIQUE = Check('repeats an id', lambda ids: np.isin(
    np.arange(len(ids)), np.unique(ids, return_index=True)[1], invert=True))
BOX = Check('is not in the order left, top, right, bottom',
            lambda boxes: (boxes[:, :2] >= boxes[:, 2:]).any(axis=1))
SHARE = Check('is outside 0 to 1', lambda shares: (shares < 0) | (shares > 1))


class StoredArray:
    """An array in a file: its rows are read when they are used.

    They are not mapped: a mapped file that is overwritten ends the process.
    """

    def __init__(self, file: BinaryIO, overwritten: CliplocError, start: int,
                 shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._file, self._overwritten, self._start = os.dup(file.fileno()), overwritten, start
        self.shape, self.dtype, self.ndim = shape, dtype, len(shape)
        self._state = self._written()
        weakref.finalize(self, os.close, self._file)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def __getitem__(self, rows: Any) -> NDArray[Any]:
        """Read rows, given as a slice or as numbers; error of the schema: it was overwritten."""
        if not isinstance(rows, slice):
            first = int(np.min(rows, initial=len(self)))
            return self[first:int(np.max(rows, initial=first)) + 1][rows - first]
        first, last, step = rows.indices(len(self))
        size = self.dtype.itemsize * math.prod(self.shape[1:])
        with suppress(OSError):  # of a network file system
            content = os.pread(self._file, size * max(0, last - first), self._start + size * first)
            if self._written() == self._state:
                return np.frombuffer(content, self.dtype).reshape(-1, *self.shape[1:])[::step]
        raise self._overwritten.with_traceback(None)

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[Any]:
        """Read all rows."""
        return np.asarray(self[:], dtype)

    def __reduce__(self) -> Any:
        """Copy all rows, for another process."""
        return np.asarray, (self[:],)

    def _written(self) -> tuple[int, int]:
        status = os.fstat(self._file)
        return status.st_size, status.st_mtime_ns


@dataclass(frozen=True)
class Field:
    """One array of a file."""

    #: 'text', 'numbers', 'floats', 'integers', 'booleans', or a NumPy type such as 'uint8'
    type: str
    #: Lengths, or names of lengths such as 'n'. The first field with a name determines the length;
    #: 'n+1' is one more.
    shape: tuple[int | str, ...] = ()
    #: Checks that take the name and all arrays, and raise ArrayError
    checks: tuple[Callable[[str, Arrays], None], ...] = ()
    is_optional: bool = False
    is_stored: bool = False  #: Whether a large array stays in the file, see StoredArray


@dataclass(frozen=True)
class Schema:
    """The arrays of a kind of npz file."""

    kind: str  #: Kind of file in messages: 'query file' gives 'no such query file'
    fields: Mapping[str, Field]  #: The arrays to read; other arrays of a file are ignored
    error: type[CliplocError]  #: The exception to raise
    advice: str = ''  #: Advice to the user if a file is invalid
    #: Lengths that must be above 0, and the items that they count
    not_empty: Mapping[str, str] = field(default_factory=dict)
    #: Arrays of other kinds of files, and hints for the message if a file has them instead
    others: Mapping[str, str] = field(default_factory=dict)

    def read(self, path: Path) -> dict[str, NDArray[Any]]:
        """Read and validate the arrays of a file; missing optional arrays are omitted.

        Raises CliplocError if the file is invalid; the message names the file, the array, the
        fault and what to do.
        """
        if not path.is_file():
            raise self.error(f'{path}: no such {self.kind}')
        try:
            arrays = self._arrays(path)
            self.check(arrays)
        except ArrayError as error:
            raise self.invalid(path, error) from error
        return arrays

    def invalid(self, path: Path, what: object) -> CliplocError:
        """Return the exception for an invalid file."""
        return self.error(f'{path}: {what}; {self.advice}' if self.advice else f'{path}: {what}')

    def write(self, path: Path, arrays: Arrays, compress: bool = False) -> None:
        """Write a file atomically.

        Raises CliplocError if the arrays are invalid or the file cannot be written.
        """
        save: Any = np.savez_compressed if compress else np.savez
        try:
            self.check(arrays)
            with replace_file(path) as partial, partial.open('wb') as file:
                save(file, **arrays)
        except ArrayError as error:
            raise self.error(f'{path}: cannot be written: {error}') from error
        except OSError as error:
            raise self.error(f'{path}: cannot be written: {error.strerror}; nothing was changed; '
                             f'{MAKE_ROOM}') from error

    def check(self, arrays: Arrays) -> None:
        """Raise ArrayError if a type, a shape or a value is invalid."""
        sizes: dict[str, int] = {}
        fields = {name: entry for name, entry in self.fields.items() if name in arrays}
        for name, entry in fields.items():
            array = arrays[name]
            if array.ndim == 0 and entry.shape:
                raise ArrayError(f'array {name} is a single value')
            if array.ndim == len(entry.shape):
                for letter, length in zip(entry.shape, array.shape, strict=True):
                    if isinstance(letter, str) and letter not in sizes and '+' not in letter:
                        sizes |= {letter: length, f'{letter}+1': length + 1}
        for name, entry in fields.items():
            array = arrays[name]
            shape = tuple(sizes.get(str(length), length) for length in entry.shape)
            if array.shape != shape:
                expected = str(shape).replace("'", '')
                raise ArrayError(f'array {name} has shape {array.shape}, expected {expected}')
            if (array.dtype.kind not in _KINDS[entry.type] if entry.type in _KINDS
                    else array.dtype != entry.type):
                raise ArrayError(f'array {name} has type {array.dtype}, expected {entry.type}')
        for letter, what in self.not_empty.items():
            if sizes[letter] == 0:
                raise ArrayError(f'contains no {what}')
        for name, entry in fields.items():
            for check in entry.checks:
                check(name, arrays)

    def _arrays(self, path: Path) -> dict[str, NDArray[Any]]:
        try:
            with open_file(path) as file, zipfile.ZipFile(file) as archive:
                for member in archive.infolist():
                    archive.open(member).close()  # a damaged name would hide an array
                return self._arrays_of(file, archive, self.error(
                    f'{path}: overwritten while it is used: replace it with mv, and load the map '
                    'again'))
        except ArrayError:
            raise
        except OSError as error:
            raise ArrayError(f'cannot be read: {error.strerror or error}') from error
        except Exception as error:  # zipfile may raise any exception for a damaged file
            raise ArrayError(f'is not a complete npz file ({error})') from error

    def _arrays_of(self, file: BinaryIO, archive: zipfile.ZipFile, overwritten: CliplocError
                   ) -> dict[str, NDArray[Any]]:
        members = {member.filename.removesuffix('.npy'): member for member in archive.infolist()
                   if member.filename.endswith('.npy')}
        for name, entry in self.fields.items():
            if name not in members and not entry.is_optional:
                hints = [f' ({what})' for other, what in self.others.items() if other in members]
                raise ArrayError(f'array {name} is missing{"".join(hints)}')
        status = os.fstat(file.fileno())
        wanted = {name: members[name] for name in self.fields if name in members}
        unpacked = sum(member.file_size for member in wanted.values())
        # some network file systems report 0 blocks
        on_disk = 512 * status.st_blocks or status.st_size
        if unpacked > max(_MOST_BYTES, _MOST_GROWTH * on_disk):
            raise ArrayError(f'unpacks to {unpacked >> 20} MiB, more than {_MOST_GROWTH} times '
                             'its size on disk')
        arrays = {}
        for name, member in wanted.items():
            try:
                arrays[name] = _array(
                    archive, member, (file, overwritten) if self.fields[name].is_stored else None)
            except Exception as error:  # NumPy and zipfile may raise any exception, see above
                raise ArrayError(f'array {name} cannot be read: {error}') from error
        return arrays


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo,
           stored: tuple[BinaryIO, CliplocError] | None) -> Any:
    """Read an array of a file; it takes no more memory than the archive declares.

    A large array stays in the file if the file and its error are given, see StoredArray.
    """
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = (np.lib.format.read_array_header_1_0 if version == (1, 0)
                else np.lib.format.read_array_header_2_0)
        shape, is_by_columns, dtype = read(stream)
        size, expected = member.file_size - stream.tell(), math.prod(shape) * dtype.itemsize
        if dtype.hasobject:
            raise ValueError('it contains Python objects')
        if size != expected:
            raise ValueError(f'it has {size} bytes, expected {expected}')
        if stored is not None and size > _STORED_BYTES and not (
                is_by_columns or member.compress_type):
            # the values follow the local header (30 bytes and two texts) and that of NumPy
            lengths = np.frombuffer(os.pread(
                stored[0].fileno(), 4, member.header_offset + 26), '<u2')
            start = member.header_offset + 30 + int(lengths.sum()) + stream.tell()
            while stream.read(_BLOCK_BYTES):
                pass  # the last block verifies the checksum
            return StoredArray(*stored, start, shape, dtype)
        stream.seek(0)
        array = np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
    return np.char.decode(array, 'utf-8') if array.dtype.kind == 'S' else array
