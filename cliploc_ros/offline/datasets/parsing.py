# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read and check texts, tables and JSON of other programs, and the cameras of recordings.

Every error is a DatasetError that names the file and the line or field.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from decimal import Decimal, InvalidOperation, Overflow
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.errors import CameraError, DatasetError
from cliploc_ros.files.storage import parse_json, read_file
from cliploc_ros.units import NS_PER_S

#: builtin_interfaces/Time holds seconds in an int32.
MAX_STAMP_S = 2**31 - 1


class FieldError(DatasetError):
    """A field of a mapping is missing or invalid."""


@contextmanager
def naming(where: object, *kinds: type[Exception], what: str = '') -> Iterator[None]:
    """Convert exceptions of some kinds to a DatasetError that names a file or a place in it."""
    try:
        yield
    except kinds as error:
        reason = getattr(error, 'strerror', None) or error
        raise DatasetError(f'{where}: {what}{reason}') from error


def read_text(path: Path) -> str:
    """Return the text of a file; DatasetError: it cannot be read."""
    with naming(path, OSError, ValueError, what='cannot be read: '):
        return read_file(path).decode('utf-8')


def read_lines(path: Path, header: int = 0) -> Iterator[tuple[str, str]]:
    """Yield 'file:line' and the text of each line that is neither blank nor a comment.

    The first `header` lines are skipped.
    """
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        stripped = line.strip()
        if number > header and stripped and not stripped.startswith('#'):
            yield f'{path}:{number}', stripped


def read_cells(path: Path, expected: str, header: int = 0) -> Iterator[tuple[str, list[str]]]:
    """Yield 'file:line' and the cells of each line after a header, split at spaces or commas.

    `expected` lists the names of the cells; a final '...' stands for any number of cells.
    DatasetError: the file cannot be read, a line has the wrong number of cells, or a cell between
    commas is empty.
    """
    names = expected.split()
    for where, line in read_lines(path, header):
        between_commas = line.removesuffix(',').split(',')
        if not all(map(str.strip, between_commas)):
            raise DatasetError(f'{where}: a cell between its commas is empty: {line[:60]!r}')
        cells = ' '.join(between_commas).split()
        if len(cells) < len(names) - 1 or (names[-1] != '...' and len(cells) != len(names)):
            raise DatasetError(f'{where}: expected {expected}, got {len(cells)} fields: '
                               f'{line[:60]!r}')
        yield where, cells


def read_numbers(path: Path, expected: str) -> list[list[float]]:
    """Read the numbers of each line of a table, see read_cells; they may be infinite or NaN."""
    return [parse_all(cells, float, where) for where, cells in read_cells(path, expected)]


def parse_all[T](cells: Sequence[str], kind: Callable[[str], T], where: str) -> list[T]:
    """Convert cells to numbers of a type; DatasetError: a cell is not a number."""
    numbers = []
    for cell in cells:
        try:
            numbers.append(kind(cell))
        except ValueError:
            raise DatasetError(f'{where}: {cell[:40]!r} is not a number') from None
    return numbers


def unit_of_stamps(texts: Iterable[str]) -> Decimal:
    """Return the unit of the times of a file [s]: the largest of s, ms, us, ns that is possible.

    A unit is possible if all times are within MAX_STAMP_S. Texts that are not numbers are ignored.
    """
    greatest = 0.0
    for text in texts:
        with suppress(ValueError):
            greatest = max(greatest, float(text))
    powers = (power for power in (0, 3, 6, 9) if greatest * 10.0**-power <= MAX_STAMP_S)
    return Decimal(10) ** -next(powers, 0)


def parse_stamp_ns(text: str, where: str, unit_s: Decimal = Decimal(1)) -> int:
    """Convert a decimal time to nanoseconds exactly, without a float.

    DatasetError: the text is not a number, or outside the range of a ROS time.

    Parameters
    ----------
    text : str
        Such as ``1341847980.722988`` or ``1.341847980722988e9``.
    where : str
        File and line, for the message.
    unit_s : Decimal, optional
        The unit of the time [s].
    """
    try:
        seconds = Decimal(text) * unit_s
    except Overflow:
        seconds = Decimal('inf')
    except InvalidOperation:
        raise DatasetError(f'{where}: {text!r} is not a timestamp in seconds') from None
    if not seconds.is_finite() or not 0 <= seconds <= MAX_STAMP_S:
        raise DatasetError(f'{where}: timestamp {text} is outside 0 to {MAX_STAMP_S} s')
    return int((seconds * NS_PER_S).to_integral_value())


def unit_quaternion(quat: Sequence[float], where: str, tolerance: float) -> NDArray[np.float64]:
    """Normalize a quaternion (4,); DatasetError: its norm is not 1 within the tolerance."""
    norm = math.hypot(*quat)
    if not abs(norm - 1.0) <= tolerance:
        raise DatasetError(f'{where}: quaternion {list(quat)} has norm {norm:.3g}, not 1')
    return np.array(quat, dtype=np.float64) / norm


def pose_of(position: Sequence[float], quat_xyzw: Sequence[float], where: str
            ) -> NDArray[np.float64] | None:
    """Make a transform (4, 4) of a position and a quaternion; None if they are not finite.

    DatasetError: the norm of the quaternion is not 1.
    """
    if not np.isfinite([*position, *quat_xyzw]).all():
        return None
    unit_quaternion(quat_xyzw, where, 1e-2)
    return transform_from_pose(np.array(position), np.array(quat_xyzw))


def camera_of(where: str, *values: Any) -> Camera:
    """Make a camera; DatasetError: the values are invalid."""
    with naming(where, CameraError):
        return Camera(*values)


class WrittenFloat(float):
    """A float that keeps its text in the file, for stamps that a float would round."""

    def __new__(cls, text: str) -> Self:
        """Convert the text and keep it."""
        made = super().__new__(cls, text)
        made.text = text
        return made

    text: str

    def __str__(self) -> str:
        """Return the text."""
        return self.text


class Fields:
    """A JSON mapping whose fields are checked as they are read.

    FieldError: a field without a default is missing, or has the wrong type or shape.
    """

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise FieldError(f'{where}: expected a mapping, got {str(values)[:40]!r}')
        self.values: dict[str, Any] = values
        self.where = where

    @classmethod
    def of_file(cls, path: Path, read: Callable[[Path], str | bytes] = read_text) -> 'Fields':
        """Read the mapping in a file."""
        text = read(path)
        with naming(path, ValueError, what='is not JSON: '):
            return cls(parse_json(text, parse_float=WrittenFloat), str(path))

    def __contains__(self, name: str) -> bool:
        """Return whether a field exists."""
        return name in self.values

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number."""
        return float(self.numbers(name, (), default))

    def numbers(self, name: str, shape: tuple[int, ...], default: Any = None
                ) -> NDArray[np.float64]:
        """Return an array of finite numbers; a length of -1 in the shape stands for any length."""
        value = self._value(name, default)
        try:
            found = np.array(value)
            # NumPy converts a boolean among numbers to a number
            if found.size and (found.dtype.kind not in 'iuf' or any(
                    isinstance(number, bool) for number in np.array(value, dtype=object).flat)):
                raise ValueError
            found = found.astype(np.float64)
        except (ValueError, OverflowError, TypeError):
            found = np.array([np.nan])
        fits = len(found.shape) == len(shape) and all(
            length in (-1, there) for length, there in zip(shape, found.shape, strict=True))
        if not fits or not np.isfinite(found).all():
            raise FieldError(f'{self.where}: {name} is {str(value)[:60]}, not ' + (
                f'numbers of shape {shape}' if shape else 'a finite number'))
        return found

    def written(self, name: str) -> str:
        """Return a number or a text as it is written in the file."""
        value = self._value(name, None)
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise FieldError(f'{self.where}: field {name!r} is {str(value)[:40]!r}, neither a '
                             'number nor a text')
        return str(value)

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text."""
        return self._typed(name, str, 'a text', default)

    def entries(self, name: str) -> list[Any]:
        """Return a list."""
        return self._typed(name, list, 'a list')

    def size(self, width: str, height: str) -> tuple[int, int]:
        """Return width and height [px]."""
        return round(self.number(width)), round(self.number(height))

    def _typed[T](self, name: str, kind: type[T], what: str, default: T | None = None) -> T:
        value = self._value(name, default)
        if not isinstance(value, kind):
            raise FieldError(f'{self.where}: field {name!r} is {str(value)[:40]!r}, not {what}')
        return value

    def _value(self, name: str, default: Any) -> Any:
        value = self.values.get(name, default)
        if value is None:
            raise FieldError(f'{self.where}: field {name!r} is missing')
        return value


def _tum_camera(fx: float, fy: float, cx: float, cy: float, *distortion: float) -> Camera:
    return Camera(640, 480, fx, fy, cx, cy, 'plumb_bob', distortion)


#: The published values of the dataset (ROS calibration of the colour cameras).
PRESETS: Mapping[str, Camera] = {
    'fr1': _tum_camera(517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    'fr2': _tum_camera(520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    'fr3': _tum_camera(535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}

_SEQUENCE_NAME = re.compile(r'(?<![a-z])(?:freiburg|fr)([123])(?![0-9])', re.IGNORECASE)


def find_camera(choice: str | None, folder: Path) -> tuple[Camera, str]:
    """Return the camera of a sequence, and the source of its intrinsics, as a text for the user.

    DatasetError: neither choice nor folder determines the camera, or the file is invalid.

    Parameters
    ----------
    choice : str or None
        A preset's name (fr1, fr2, fr3), a camera.json, or None for the folder's
        ``camera.json`` or, without one, the TUM camera that the folder's name contains.
    folder : Path
        The sequence's folder.
    """
    if choice is not None and choice in PRESETS:
        return PRESETS[choice], f'preset {choice}'
    if choice is not None:
        return read_camera(choice), choice
    if (folder / 'camera.json').exists():
        return read_camera(folder / 'camera.json'), str(folder / 'camera.json')
    match = _SEQUENCE_NAME.search(folder.resolve().name)
    if match is None:
        raise DatasetError(f'{folder}: has no camera.json, and its name contains no TUM camera; '
                           'give `intrinsics`: a camera.json, or fr1, fr2, fr3')
    return PRESETS[f'fr{match[1]}'], f"preset fr{match[1]}, from the folder's name"


def read_camera(path: str | Path) -> Camera:
    """Read a camera.json.

    The file is a mapping of ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` [px] and, for a
    lens with distortion, ``distortion_model`` and its coefficients ``d``. DatasetError: a field is
    missing, unknown or invalid; the message names file and field.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f'{path}: no such camera file; give fr1, fr2, fr3 or a camera.json')
    fields = Fields.of_file(path)
    numbers = ('fx', 'fy', 'cx', 'cy')
    if unknown := sorted(set(fields.values) - {
            'width', 'height', *numbers, 'distortion_model', 'd'}):
        raise DatasetError(f'{path}: unknown field {unknown[0]!r}')
    return camera_of(str(path), *fields.size('width', 'height'), *map(fields.number, numbers),
                     fields.text('distortion_model', 'plumb_bob'),
                     tuple(fields.numbers('d', (-1,), []).tolist()))
