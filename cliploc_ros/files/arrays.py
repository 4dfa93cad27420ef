# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The schema of an npz file: its arrays, with their types, shapes and values.

A reader is a table of fields. An untrusted file ends in an error that names file, array and row:
pickles are refused, check sums are compared, and no array is larger than the file says.
"""

import math
import os
import struct
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

# Kinds of numpy's types; any other type of a field is the name of one.
_KINDS = {'text': 'U', 'numbers': 'fiu', 'floats': 'f', 'integers': 'iu', 'booleans': 'b'}
_ROWS_AT_ONCE = 10_000
# Offsets in a member of a zip file: the lengths of its name and of a further field, and the name.
_ZIP_LENGTHS, _ZIP_HEAD = 26, 30
# Arrays may take this much memory [bytes], or this many times what the file takes on the disk: a
# small file may declare any size, and so may one with holes.
_MOST_BYTES, _MOST_GROWTH = 512 * 2**20, 8
# Beyond any pixel, coordinate [m] and time [s].
_MOST = 1e10


class ArrayError(Exception):
    """A fault of an array; the schema adds the file's name."""


@dataclass(frozen=True)
class Check:
    """A condition that each row of an array meets."""

    what: str  #: The fault of a row that fails, such as 'is not finite'
    #: Takes the array (n, ...), returns whether each row (n,) fails
    is_wrong: Callable[[NDArray[Any]], NDArray[np.bool_]]

    def __call__(self, name: str, arrays: Arrays) -> None:
        """Raise ArrayError if a row fails."""
        wrong = self.is_wrong(arrays[name])
        if wrong.any():
            raise ArrayError(f'array {name} {self.what} in row {int(np.argmax(wrong))}')


@dataclass(frozen=True)
class Offsets:
    """A check of offsets: where the rows of each part begin in another array, and its end."""

    counted: str
    what: str

    def __call__(self, name: str, arrays: Arrays) -> None:
        """Raise ArrayError if they do not count all rows in their order."""
        offsets, count = arrays[name].astype(np.int64), len(arrays[self.counted])
        if offsets[0] != 0 or offsets[-1] != count:
            raise ArrayError(f'array {name} goes from {offsets[0]} to {offsets[-1]}, expected 0 '
                             f'to {count}, the number of {self.what}')
        Check('decreases', lambda all_: np.diff(offsets, prepend=0) < 0)(name, arrays)


def _is_not_finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Look at some rows at once: the array may stay in its file."""
    within_row = tuple(range(1, values.ndim))
    return np.concatenate([~(np.abs(rows.astype(float)) <= _MOST).all(axis=within_row)
                           for rows in np.array_split(values, len(values) // _ROWS_AT_ONCE + 1)])


def _is_repeated(values: NDArray[Any]) -> NDArray[np.bool_]:
    repeated = np.ones(len(values), dtype=np.bool_)
    repeated[np.unique(values, return_index=True)[1]] = False
    return repeated


FINITE = Check('is beyond any measure or not finite', _is_not_finite)
UNIQUE = Check('repeats an id', _is_repeated)
BOX = Check('is not left, top, right, bottom',
            lambda boxes: (boxes[:, :2] >= boxes[:, 2:]).any(axis=1))
SHARE = Check('is outside 0 to 1', lambda shares: (shares < 0) | (shares > 1))


@dataclass(frozen=True)
class Field:
    """One array of a file."""

    #: 'text', 'numbers', 'floats', 'integers', 'booleans', or the name of one type, as 'uint8'
    type: str
    #: Lengths, or their names, such as 'n'. The first field with a name determines its length;
    #: 'n+1' is one more.
    shape: tuple[int | str, ...] = ()
    #: Each takes the name and all arrays, and raises ArrayError
    checks: tuple[Callable[[str, Arrays], None], ...] = ()
    is_optional: bool = False
    #: Whether it stays in the file, so that memory holds only the rows in use. A compressed array
    #: is read nevertheless.
    stays: bool = False


@dataclass(frozen=True)
class Schema:
    """The arrays of a kind of npz file."""

    kind: str  #: Names the file, as in 'no such query file'
    fields: Mapping[str, Field]  #: Other arrays of a file are not read
    error: type[CliplocError]  #: The exception to raise
    advice: str = ''  #: Advice about an invalid file
    #: Lengths that must be above 0, and what they count
    not_empty: Mapping[str, str] = field(default_factory=dict)
    #: Arrays of other kinds of files, and what a file is that has one where a field is missing
    others: Mapping[str, str] = field(default_factory=dict)
    is_stored: bool = False  #: Whether compressed arrays are refused
    #: In files up to this size all arrays are read [bytes]: a program that writes over a mapped
    #: file in place would kill this process
    largest_read: int = 0

    def read(self, path: Path) -> dict[str, NDArray[Any]]:
        """Return the arrays of a file, validated, without the optional arrays that it lacks.

        CliplocError: names the file, the array, what is wrong with it, and what to do.
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
        """Return the error of an invalid file."""
        return self.error(f'{path}: {what}; {self.advice}' if self.advice else f'{path}: {what}')

    def write(self, path: Path, arrays: Arrays, compress: bool = False) -> None:
        """Write a file in one step: an existing file is replaced complete, or stays.

        CliplocError: the arrays are invalid, or the file cannot be written.
        """
        save: Any = np.savez_compressed if compress else np.savez
        try:
            self.check(arrays)
            with replace_file(path) as partial, partial.open('wb') as file:
                save(file, **arrays)
        except ArrayError as error:
            raise self.error(f'{path}: cannot be written: {error}') from error
        except OSError as error:
            raise self.error(f'{path}: cannot be written: {error.strerror}; nothing was changed: '
                             f'{MAKE_ROOM}') from error

    def check(self, arrays: Arrays) -> None:
        """Raise ArrayError if a type, a shape or a value is wrong."""
        sizes: dict[str, int] = {}
        fields = {name: one for name, one in self.fields.items() if name in arrays}
        for name, one in fields.items():
            array = arrays[name]
            if array.ndim == 0 and one.shape:
                raise ArrayError(f'array {name} is a single value')
            if array.ndim == len(one.shape):
                for letter, length in zip(one.shape, array.shape, strict=True):
                    if isinstance(letter, str) and letter not in sizes and '+' not in letter:
                        sizes |= {letter: length, f'{letter}+1': length + 1}
        for name, one in fields.items():
            array, shape = arrays[name], tuple(sizes.get(str(one), one) for one in one.shape)
            if array.shape != shape:
                expected = str(shape).replace("'", '')
                raise ArrayError(f'array {name} has shape {array.shape}, expected {expected}')
            if (array.dtype.kind not in _KINDS[one.type] if one.type in _KINDS
                    else array.dtype != one.type):
                raise ArrayError(f'array {name} has type {array.dtype}, expected {one.type}')
        for letter, what in self.not_empty.items():
            if sizes[letter] == 0:
                raise ArrayError(f'holds no {what}')
        for name, one in fields.items():
            for check in one.checks:
                check(name, arrays)

    def _arrays(self, path: Path) -> dict[str, NDArray[Any]]:
        try:
            file = open_file(path)
        except OSError as error:
            raise ArrayError(f'cannot be read: {error.strerror}') from error
        with file:
            try:
                archive = zipfile.ZipFile(file)
            except Exception as error:  # whatever zipfile meets in a broken file
                with suppress(OSError):
                    file.seek(0)
                    if file.read(6) == b'\x93NUMPY':
                        raise ArrayError('is a single array, not an npz file of named arrays'
                                         ) from error
                raise ArrayError(f'is not a complete npz file ({error})') from error
            with archive:
                try:
                    for member in archive.infolist():
                        archive.open(member).close()  # a damaged name would hide an array
                except Exception as error:  # as above
                    raise ArrayError(f'is damaged ({error})') from error
                return self._arrays_of(file, archive)

    def _arrays_of(self, file: BinaryIO, archive: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
        members = {member.filename.removesuffix('.npy'): member for member in archive.infolist()
                   if member.filename.endswith('.npy')}
        for name, one in self.fields.items():
            if name not in members and not one.is_optional:
                hints = [f' ({what})' for other, what in self.others.items() if other in members]
                raise ArrayError(f'array {name} is missing{"".join(hints)}')
        status = os.fstat(file.fileno())
        is_large = status.st_size > self.largest_read
        # each with whether it stays in the file
        wanted = {name: (members[name], one.stays and is_large
                         and members[name].compress_type == zipfile.ZIP_STORED)
                  for name, one in self.fields.items() if name in members}
        unpacked = sum(member.file_size for member, stays in wanted.values() if not stays)
        on_disk = 512 * status.st_blocks or status.st_size  # some network file systems count none
        if unpacked > max(_MOST_BYTES, _MOST_GROWTH * on_disk):
            raise ArrayError(f'unpacks to {unpacked >> 20} MiB, much more than the file takes')
        arrays = {}
        for name, (member, stays) in wanted.items():
            if self.is_stored and member.compress_type != zipfile.ZIP_STORED:
                raise ArrayError(f'array {name} is compressed')
            try:
                arrays[name] = (_mapped(file, archive, member) if stays
                                else _array(archive, member))
            except Exception as error:  # whatever numpy and zipfile meet in a broken file
                raise ArrayError(f'array {name} cannot be read: {error}') from error
        return arrays


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Return an array of a file, whose memory is not more than what the archive declares."""
    _header(archive, member)
    with archive.open(member) as stream:
        array = np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
    return np.char.decode(array, 'utf-8') if array.dtype.kind == 'S' else array


def _mapped(file: BinaryIO, archive: zipfile.ZipFile, member: zipfile.ZipInfo
            ) -> NDArray[Any]:
    """Return an array that stays in its file, whose check sum was compared."""
    shape, by_columns, dtype, start = _header(archive, member)
    with archive.open(member) as stream:
        while stream.read(1 << 20):
            pass  # to the end, where zipfile compares the check sum
    # the local header repeats name and a further field, whose length may be another one
    file.seek(member.header_offset + _ZIP_LENGTHS)
    start += member.header_offset + _ZIP_HEAD + sum(struct.unpack('<HH', file.read(4)))
    if 0 in shape:
        return np.empty(shape, dtype)
    return np.memmap(file, dtype, 'r', start, shape, 'F' if by_columns else 'C')


def _header(archive: zipfile.ZipFile, member: zipfile.ZipInfo
            ) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, whether columns come first, type, and where the values begin in a member."""
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = (np.lib.format.read_array_header_1_0 if version == (1, 0)
                else np.lib.format.read_array_header_2_0)
        shape, by_columns, dtype = read(stream)
        start = stream.tell()
    if dtype.hasobject:
        raise ValueError('it holds objects')
    if (size := math.prod(shape) * dtype.itemsize) != member.file_size - start:
        raise ValueError(f'its values take {size} bytes, the file has {member.file_size - start}')
    return shape, by_columns, dtype, start
