# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Import a map of GOReloc, OA-SLAM or MSG-Loc: ``python -m studies.foreign_maps --help``.

| file | content |
|---|---|
| NAME.objects (GOReloc) | protocol buffers: repeated object = 1 |
| object | ellipsoid = 1, object_id = 2, cat_ids = 3, cat_counts = 4, mappoint_id = 5 |
| ellipsoid | 16 floats = 1: a dual quadric, row by row |
| map_objects_NAME.txt (both) | a line for each object: track id, category, dual quadric |
| map_NAME.mapobjects (OA-SLAM) | repeated mapobject = 1 {ellipsoid = 1, track id = 2} |
| map_NAME.objecttracks | next to it: repeated track = 1 {id = 1, category = 2, boxes = 8} |
| NAME.json (MSG-Loc) | a list of nodes, see read_msgloc |

The format of OA-SLAM is taken from its source code; no saved map was available. A monocular map
has no metric scale, and its coordinate frame is that of the first camera: z forward, y down.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.cli import import_map
from cliploc_ros.command import option, run_main
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.given_map import (
    MAX_LENGTH,
    GivenLandmark,
    GivenMap,
    Skipped,
    make_id,
    read_bytes,
)
from cliploc_ros.offline.datasets.parsing import FieldError, Fields, naming, parse_all
from cliploc_ros.offline.vocabulary.vocabulary import shipped_classes

COCO = shipped_classes()[:80]
_MAX_ASYMMETRY = 1e-3
_LEAST_SCALE = 1e-9
_NOTE = ('a monocular map of OA-SLAM has no metric scale, and its axes are those of the first '
         'camera: give its scale and transform')
_NUMBERS_IN_A_LINE = 18
_NO_DETAILS = LandmarkDetails()
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10
# A map file holds four decimals of a weight; classes with a smaller share are dropped.
_LEAST_SHARE = 0.001
_NUMBER_OF_SYMBOL = (1 << 56) - 1
# Where a node has only likelihoods, classes below this share of the greatest are left out. Not
# measured.
_LEAST_LIKELIHOOD = 0.5
_MOST_SHARE = 1e300  # sums of larger numbers are infinite


class QuadricError(Exception):
    """A dual quadric is not an ellipsoid; the text gives the reason."""


class WireError(Exception):
    """A protocol buffer is invalid; the caller adds the name of the file."""


def read_goreloc(path: Path, class_names: Sequence[str]) -> GivenMap:
    """Read the objects of a GOReloc map, NAME.objects.

    Class weights are proportional to the counts of an object's categories. Objects without a
    category, or that are not ellipsoids, are left out. `class_names` has the name of each category
    index. DatasetError: the message names the file and its fault.
    """
    given = GivenMap([], [], [])
    with naming(path, WireError, what='is not a complete NAME.objects of GOReloc: '):
        for item in _messages(path):
            number, quadric = _integer(item, 2), _quadric(item)
            categories, counts = _integers(item, 3), _integers(item, 4)
            if len(categories) != len(counts) or not sum(counts):
                given.left_out.append(Skipped(
                    f'object {number}',
                    f'it has {len(categories)} categories with the counts {counts[:5]}'))
                continue
            votes: Counter[str] = Counter()
            for category, count in zip(categories, counts, strict=True):
                votes[class_name(class_names, category)] += count
            weights = shares(votes)
            _add(given, weights[0][0], number, quadric, LandmarkDetails(
                class_weights=weights if len(weights) > 1 else None), f'object {number}')
    return given


def read_oaslam(path: Path, class_names: Sequence[str]) -> GivenMap:
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
    given = GivenMap([], [], [_NOTE])
    with naming(path, UnicodeDecodeError, what='is neither a map_objects_NAME.txt of OA-SLAM nor '
                'a saved map, which ends in .mapobjects: '):
        lines = read_bytes(path).decode('ascii').splitlines()
    for line_number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        where = f'{path}: line {line_number}: expected track id, category and the 16 numbers of ' \
                'a dual quadric'
        if len(words) != _NUMBERS_IN_A_LINE:
            raise DatasetError(f'{where}, not {line[:40]!r}')
        track, category = parse_all(words[:2], int, where)
        _add(given, class_name(class_names, category), track,
             parse_all(words[2:], float, where))
    return given


def _read_saved_map(path: Path, class_names: Sequence[str]) -> GivenMap:
    tracks_path = path.with_suffix('.objecttracks')
    if not tracks_path.is_file():
        raise DatasetError(f'{tracks_path} is missing: it holds the classes of {path.name}')
    given = GivenMap([], [], [_NOTE])
    broken = 'is not a complete map of OA-SLAM: '
    with naming(tracks_path, WireError, what=broken):
        # category and number of keyframes of each track
        tracks = {_integer(item, 1): (_integer(item, 2), len(item.get(8, ())))
                  for item in _messages(tracks_path, is_strict=False)}
    with naming(path, WireError, what=broken):
        for item in _messages(path):
            track, quadric = _integer(item, 2), _quadric(item)
            if track not in tracks:
                given.left_out.append(Skipped(
                    f'track {track}', f'{tracks_path.name} has no such track, so the class is '
                    'unknown'))
                continue
            category, support = tracks[track]
            _add(given, class_name(class_names, category), track, quadric,
                 LandmarkDetails(support=support))
    return given


def _add(given: GivenMap, name: str, number: int, quadric: list[float],
         details: LandmarkDetails = _NO_DETAILS, shown: str = '') -> None:
    """Add an object to a map, or to the objects left out if it is not an ellipsoid."""
    landmark_id = make_id(name, number)
    try:
        ellipsoid = decompose(quadric)
    except QuadricError as error:
        given.left_out.append(Skipped(shown or landmark_id, str(error)))
    else:
        given.landmarks.append(
            GivenLandmark(landmark_id, name, name, *ellipsoid, details))


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


def read_class_names(path: Path) -> tuple[str, ...]:
    """Read a text file with one class name per line.

    DatasetError: the message names the file and the line to correct.
    """
    with naming(path, UnicodeDecodeError, what='not a text file in UTF-8: '):
        lines = read_bytes(path).decode('utf-8-sig').splitlines()
    names = tuple(line.strip() for line in lines)
    for number, name in enumerate(names, 1):
        if not name or len(name) > MAX_LENGTH:
            raise DatasetError(f'{path}: line {number} must be a class name; give one per line')
    return names


def class_name(names: Sequence[str], index: int) -> str:
    """Return the name of a class; DatasetError: the list of names has no such index."""
    if not 0 <= index < len(names):
        raise DatasetError(f'class index {index} is not among {len(names)} names; give the names '
                           'of the classes that the map was made with: `class_names`')
    return names[index]


def shares(weights: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return classes with their shares, the greatest first; shares up to 0.001 are dropped."""
    least = _LEAST_SHARE * sum(weights.values())
    ranked = sorted(((name, weight) for name, weight in weights.items() if weight > least),
                    key=lambda pair: -pair[1])
    total = sum(weight for _, weight in ranked)
    return tuple((name, weight / total) for name, weight in ranked)


def read_msgloc(path: Path, class_names: Sequence[str]) -> GivenMap:
    """Read a map of MSG-Loc: JSON with a list of nodes.

    | field of a node | content |
    |---|---|
    | id | a symbol of GTSAM: the letter q in the highest byte, and a number |
    | translation, radii | centre and semi-axes; the signs of radii are ignored |
    | orientation | quaternion w, x, y, z |
    | baseline_label | class to [share of the detections by score, ...] |
    | msgloc_label | class to [likelihood]: how often the class was proposed by the detector |

    Class weights are the shares of the detections. For a node without shares, likelihoods are
    used: they sum to more than 1, and show which classes the detector confuses. DatasetError: the
    message names the file and its fault.

    Parameters
    ----------
    path : Path
        A JSON file.
    class_names : sequence of str
        Names of the class indices; a file may also name classes.
    """
    given = GivenMap([], [], [])
    negative = 0
    content = Fields.of_file(path, read_bytes)
    if not isinstance(content.values.get('nodes'), list):
        raise DatasetError(f"{path}: is not a map of MSG-Loc: it has no list 'nodes'")
    for place, values in enumerate(content.entries('nodes')):
        try:
            node = Fields(values, f'node {place}')
            given.landmarks.append(_landmark_of_node(node, place, class_names))
            negative += any(radius < 0.0 for radius in node.values['radii'])
        except FieldError as error:
            reason = str(error).removeprefix(f'node {place}: ')
            given.left_out.append(Skipped(f'node {place}', reason))
    if negative:
        given.notes.append(f'{negative} landmarks have negative radii; their signs are ignored')
    return given


def _landmark_of_node(node: Fields, place: int, class_names: Sequence[str]) -> GivenLandmark:
    center, radii = (node.numbers(name, (3,)).tolist() for name in ('translation', 'radii'))
    w, x, y, z = node.numbers('orientation', (4,)).tolist()
    weights = _class_weights(node, class_names)
    number = node.values.get('id', place)
    if not isinstance(number, int):
        raise FieldError(f"{node.where}: 'id' is {str(number)[:40]!r}, not an integer")
    name = weights[0][0]
    return GivenLandmark(
        make_id(name, number & _NUMBER_OF_SYMBOL), name, name, center,
        [abs(radius) for radius in radii], (x, y, z, w),
        LandmarkDetails(class_weights=weights if len(weights) > 1 else None))


def _class_weights(node: Fields, class_names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Return the classes of a node with their shares, the greatest first."""
    weights = shares(_labels(node, 'baseline_label', class_names))
    if not weights:
        likely = _labels(node, 'msgloc_label', class_names)
        least = _LEAST_LIKELIHOOD * max(likely.values(), default=0.0)
        weights = shares({name: value for name, value in likely.items() if value >= least})
    if not weights:
        raise FieldError(f"{node.where}: has no class: neither 'baseline_label' nor "
                         "'msgloc_label'")
    return weights


def _labels(node: Fields, field: str, class_names: Sequence[str]) -> Mapping[str, float]:
    """Return the first number of each class in a field."""
    found: dict[str, float] = {}
    shares = Fields(node.values.get(field) or {}, f"{node.where}: field '{field}'").values
    for key, values in shares.items():
        where = f"{node.where}: '{field}' of class {key[:40]!r}"
        first = Fields({'share': values[0] if isinstance(values, list) and values else None},
                       where).number('share')
        if not 0.0 <= first < _MOST_SHARE:
            raise FieldError(f'{where} is {first:g}, expected 0 or more')
        name = _name_of(key, class_names, where)
        found[name] = found.get(name, 0.0) + first
    return found


def _name_of(key: str, class_names: Sequence[str], where: str) -> str:
    """Return the class of a key, which is an index written as a float, or a name."""
    try:
        index = float(key)
    except ValueError:
        if not key.strip() or len(key) > 1000:
            raise FieldError(f'{where}: the class has no name') from None
        return key
    if not index.is_integer():
        raise FieldError(f'{where}: the class is not an index')
    return class_name(class_names, int(index))


# ---- protocol buffers ---------------------------------------------------------------------------
#
# A message is a sequence of fields. A field begins with a varint, 8 * number + wire type; the wire
# type determines the content: protobuf.dev/programming-guides/encoding. The package protobuf would
# be a new dependency, and needs compiled schemas.

_Fields = Mapping[int, list[int | memoryview]]


def _messages(path: Path, is_strict: bool = True) -> Iterator[_Fields]:
    """Yield the messages in field 1 of a file; WireError: a strict file has other fields."""
    fields = _fields(memoryview(read_bytes(path)))
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


READERS = {'goreloc': read_goreloc, 'oaslam': read_oaslam, 'msgloc': read_msgloc}


def main(args: Sequence[str] | None = None) -> int:
    """Import a map as ``import_map`` does; return the exit code."""
    parser = import_map.make_parser(tuple(READERS))
    parser.prog, parser.epilog = 'studies.foreign_maps', None
    option(parser, '--class-names FILE', 'a file with one class name per line, for class indices '
           '(COCO)')

    def run(options: argparse.Namespace) -> int:
        names = COCO if options.class_names is None else read_class_names(options.class_names)
        return import_map.import_map(options, lambda path: READERS[options.format](path, names))

    return run_main(parser, run, args)


if __name__ == '__main__':
    sys.exit(main())
