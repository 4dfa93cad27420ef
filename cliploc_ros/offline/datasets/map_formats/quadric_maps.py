# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read maps of dual quadrics: those of GOReloc, and both formats of OA-SLAM.

| file | content |
|---|---|
| NAME.objects (GOReloc) | protocol buffers: repeated object = 1 |
| object | ellipsoid = 1, object_id = 2, cat_ids = 3, cat_counts = 4, mappoint_id = 5 |
| ellipsoid | 16 floats = 1: a dual quadric, row by row |
| map_objects_NAME.txt (both) | a line for each object: track id, category, dual quadric |
| map_NAME.mapobjects (OA-SLAM) | repeated mapobject = 1 {ellipsoid = 1, track id = 2} |
| map_NAME.objecttracks | next to it: repeated track = 1 {id = 1, category = 2, boxes = 8} |

The format of OA-SLAM is taken from its source code; no saved map was available. A monocular map
has no metric scale, and its coordinate frame is that of the first camera: z forward, y down.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.map_formats import given_map
from cliploc_ros.offline.datasets.parsing import naming, parse_all

_MAX_ASYMMETRY = 1e-3
_LEAST_SCALE = 1e-9
_NOTE = ('a monocular map of OA-SLAM has no metric scale, and its axes are those of the first '
         'camera: give its scale and transform')
_NUMBERS_IN_A_LINE = 18
_NO_DETAILS = LandmarkDetails()
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10


class QuadricError(Exception):
    """A dual quadric is not an ellipsoid; the text gives the reason."""


class WireError(Exception):
    """A protocol buffer is invalid; the caller adds the name of the file."""


def read_goreloc(path: Path, class_names: Sequence[str]) -> given_map.GivenMap:
    """Read the objects of a GOReloc map, NAME.objects.

    Class weights are proportional to the counts of an object's categories. Objects without a
    category, or that are not ellipsoids, are left out. `class_names` has the name of each category
    index. DatasetError: the message names the file and its fault.
    """
    given = given_map.GivenMap([], [], [])
    with naming(path, WireError, what='is not a complete NAME.objects of GOReloc: '):
        for item in _messages(path):
            number, quadric = _integer(item, 2), _quadric(item)
            categories, counts = _integers(item, 3), _integers(item, 4)
            if len(categories) != len(counts) or not sum(counts):
                given.left_out.append(given_map.Skipped(
                    f'object {number}',
                    f'it has {len(categories)} categories with the counts {counts[:5]}'))
                continue
            votes: Counter[str] = Counter()
            for category, count in zip(categories, counts, strict=True):
                votes[given_map.class_name(class_names, category)] += count
            weights = given_map.shares(votes)
            _add(given, weights[0][0], number, quadric, LandmarkDetails(
                class_weights=weights if len(weights) > 1 else None), f'object {number}')
    return given


def read_oaslam(path: Path, class_names: Sequence[str]) -> given_map.GivenMap:
    """Read the objects of an OA-SLAM map.

    DatasetError: the message names the file and its fault.

    Parameters
    ----------
    path : Path
        map_objects_NAME.txt, or map_NAME.mapobjects next to map_NAME.objecttracks.
    class_names : sequence of str
        Names of the category indices.
    """
    if path.suffix == '.mapobjects':
        return _read_saved_map(path, class_names)
    given = given_map.GivenMap([], [], [_NOTE])
    with naming(path, UnicodeDecodeError, what='is neither a map_objects_NAME.txt of OA-SLAM nor '
                'a saved map, which ends in .mapobjects: '):
        lines = given_map.read_bytes(path).decode('ascii').splitlines()
    for line_number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        where = f'{path}: line {line_number}: expected track id, category and the 16 numbers of ' \
                'a dual quadric'
        if len(words) != _NUMBERS_IN_A_LINE:
            raise DatasetError(f'{where}, not {line[:40]!r}')
        track, category = parse_all(words[:2], int, where)
        _add(given, given_map.class_name(class_names, category), track,
             parse_all(words[2:], float, where))
    return given


def _read_saved_map(path: Path, class_names: Sequence[str]) -> given_map.GivenMap:
    tracks_path = path.with_suffix('.objecttracks')
    if not tracks_path.is_file():
        raise DatasetError(f'{tracks_path} is missing: it holds the classes of {path.name}')
    given = given_map.GivenMap([], [], [_NOTE])
    broken = 'is not a complete map of OA-SLAM: '
    with naming(tracks_path, WireError, what=broken):
        # category and number of keyframes of each track
        tracks = {_integer(item, 1): (_integer(item, 2), len(item.get(8, ())))
                  for item in _messages(tracks_path, is_strict=False)}
    with naming(path, WireError, what=broken):
        for item in _messages(path):
            track, quadric = _integer(item, 2), _quadric(item)
            if track not in tracks:
                given.left_out.append(given_map.Skipped(
                    f'track {track}', f'{tracks_path.name} has no such track, so the class is '
                    'unknown'))
                continue
            category, support = tracks[track]
            _add(given, given_map.class_name(class_names, category), track, quadric,
                 LandmarkDetails(support=support))
    return given


def _add(given: given_map.GivenMap, name: str, number: int, quadric: list[float],
         details: LandmarkDetails = _NO_DETAILS, shown: str = '') -> None:
    """Add an object to a map, or to the objects left out if it is not an ellipsoid."""
    landmark_id = given_map.make_id(name, number)
    try:
        ellipsoid = decompose(quadric)
    except QuadricError as error:
        given.left_out.append(given_map.Skipped(shown or landmark_id, str(error)))
    else:
        given.landmarks.append(
            given_map.GivenLandmark(landmark_id, name, name, *ellipsoid, details))


def decompose(numbers: list[float]) -> tuple[list[float], list[float], list[float]]:
    """Convert a dual quadric, 16 numbers by rows, to centre, semi-axes and quaternion x, y, z, w.

    QuadricError: it is not an ellipsoid.
    """
    if len(numbers) != 16:
        raise QuadricError(f'its dual quadric has {len(numbers)} numbers, not 16')
    quadric = np.array(numbers, dtype=np.float64).reshape(4, 4)
    size = np.abs(quadric).max()
    if not np.isfinite(size):
        raise QuadricError('it has numbers that are not finite')
    if np.abs(quadric - quadric.T).max() > _MAX_ASYMMETRY * size:
        raise QuadricError('its dual quadric is not symmetric')
    if abs(quadric[3, 3]) <= _LEAST_SCALE * size:
        raise QuadricError('its dual quadric has no finite centre')
    quadric = 0.5 * (quadric + quadric.T) / -quadric[3, 3]
    center = -quadric[:3, 3]
    squares, axes = np.linalg.eigh(quadric[:3, :3] + np.outer(center, center))
    if squares[0] <= 0.0:
        shown = ' '.join(f'{square:.3g}' for square in squares)
        raise QuadricError(f'its dual quadric is not an ellipsoid: squared semi-axes {shown}')
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    return (center.tolist(), np.sqrt(squares).tolist(),
            Rotation.from_matrix(axes).as_quat().tolist())


# ---- protocol buffers ---------------------------------------------------------------------------
#
# A message is a sequence of fields. A field begins with a varint, 8 * number + wire type; the wire
# type determines the content: protobuf.dev/programming-guides/encoding. The package protobuf would
# be a new dependency, and needs compiled schemas.

_Fields = Mapping[int, list[int | memoryview]]


def _messages(path: Path, is_strict: bool = True) -> Iterator[_Fields]:
    """Yield the messages in field 1 of a file; WireError: a strict file has other fields."""
    fields = _fields(memoryview(given_map.read_bytes(path)))
    for number in fields:
        if is_strict and number != 1:
            raise WireError(f'field {number} is unknown')
    for values in fields.values():
        for value in values:
            yield _fields(_message(value))


def _quadric(item: _Fields) -> list[float]:
    """Return the numbers of an object's ellipsoid, field 1."""
    numbers: list[float] = []
    for ellipsoid in item.get(1, ()):
        for value in _fields(_message(ellipsoid)).get(1, ()):
            if isinstance(value, int) or len(value) % 4:
                raise WireError('field 1 does not hold 32-bit floats')
            numbers += np.frombuffer(value, dtype='<f4').tolist()
    return numbers


def _message(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise WireError('a field is a number where a message was expected')
    return value


def _integer(item: _Fields, number: int) -> int:
    """Return an integer field of a message; 0 if it is missing, as zeros are not stored."""
    value = item.get(number, [0])[-1]
    if not isinstance(value, int):
        raise WireError(f'field {number} is a message where a number was expected')
    return value


def _integers(item: _Fields, number: int) -> list[int]:
    """Return the integers of a repeated field, packed or not."""
    numbers = []
    for value in item.get(number, ()):
        if isinstance(value, int):
            numbers.append(value)
            continue
        place = 0
        while place < len(value):
            found, place = _read_varint(value, place)
            numbers.append(found)
    return numbers


def _fields(data: memoryview) -> _Fields:
    """Return the values of a message by field number, without copying.

    WireError: the bytes are not a message, or end too early.
    """
    fields: dict[int, list[int | memoryview]] = defaultdict(list)
    place = 0
    while place < len(data):
        tag, place = _read_varint(data, place)
        number, wire_type = tag >> 3, tag & 7
        if number == 0:
            raise WireError(f'byte {place}: field 0 does not exist')
        if wire_type == _VARINT:
            value, place = _read_varint(data, place)
            fields[number].append(value)
            continue
        if wire_type == _BYTES:
            size, place = _read_varint(data, place)
        elif wire_type in (_FIXED32, _FIXED64):
            size = 4 if wire_type == _FIXED32 else 8
        else:
            raise WireError(f'byte {place}: wire type {wire_type} does not exist')
        if size > len(data) - place:
            raise WireError(f'byte {place}: field {number} has {size} bytes, but only '
                            f'{len(data) - place} follow')
        fields[number].append(data[place:place + size])
        place += size
    return fields


def _read_varint(data: memoryview, place: int) -> tuple[int, int]:
    """Read the varint at an index; also return the index after it."""
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
