# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The wire format of protocol buffers, as far as maps need it.

A message is a sequence of fields. Each begins with a varint, 8 * number + wire type; what follows
depends on the wire type. See protobuf.dev/programming-guides/encoding. The package protobuf
would do the same with a compiled schema, and is one more dependency for two short schemas.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10


class WireError(Exception):
    """What is wrong with a message; the caller adds the file's name."""


class Field(NamedTuple):
    """A field of a message: its number, and an int or the bytes that it holds."""

    number: int
    value: int | memoryview

    def message(self) -> memoryview:
        """Return the bytes of a message within a message."""
        if isinstance(self.value, int):
            raise WireError(f'field {self.number} is a number where a message was expected')
        return self.value

    def integer(self) -> int:
        """Return a number."""
        if not isinstance(self.value, int):
            raise WireError(f'field {self.number} is a message where a number was expected')
        return self.value

    def integers(self) -> list[int]:
        """Return the numbers of a repeated field, packed or not."""
        if isinstance(self.value, int):
            return [self.value]
        numbers, place = [], 0
        while place < len(self.value):
            number, place = _read_varint(self.value, place)
            numbers.append(number)
        return numbers

    def floats(self) -> list[float]:
        """Return the 32-bit floats of a repeated field, packed or not."""
        if isinstance(self.value, int) or len(self.value) % 4:
            raise WireError(f'field {self.number} holds no 32-bit floats')
        return np.frombuffer(self.value, dtype='<f4').tolist()


def read_fields(data: memoryview) -> Iterator[Field]:
    """Yield the fields of a message in their order; nothing is copied.

    Raises
    ------
    WireError
        The bytes are no message, or end too early.
    """
    place = 0
    while place < len(data):
        tag, place = _read_varint(data, place)
        number, wire_type = tag >> 3, tag & 7
        if number == 0:
            raise WireError(f'byte {place}: field 0 does not exist')
        if wire_type == _VARINT:
            value, place = _read_varint(data, place)
            yield Field(number, value)
            continue
        if wire_type == _BYTES:
            size, place = _read_varint(data, place)
        elif wire_type in (_FIXED32, _FIXED64):
            size = 4 if wire_type == _FIXED32 else 8
        else:
            raise WireError(f'byte {place}: wire type {wire_type} does not exist')
        if size > len(data) - place:
            raise WireError(f'byte {place}: field {number} has {size} bytes, and only '
                            f'{len(data) - place} are left')
        yield Field(number, data[place:place + size])
        place += size


def _read_varint(data: memoryview, place: int) -> tuple[int, int]:
    """Return the number that begins at a place, and the place after it."""
    value = 0
    for count in range(_MAX_VARINT_BYTES):
        if place >= len(data):
            raise WireError(f'byte {place}: the data ends within a number')
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, place
    raise WireError(f'byte {place}: a number has more than {_MAX_VARINT_BYTES} bytes')
