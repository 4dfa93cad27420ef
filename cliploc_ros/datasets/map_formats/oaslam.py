# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of OA-SLAM, in one of the two forms in which it saves them.

| file | content |
|---|---|
| map_objects_NAME.txt | a line for each object: track id, category, dual quadric (16 numbers) |
| map_NAME.mapobjects | protocol buffers: repeated mapobject = 1 {ellipsoid = 1, track id = 2} |
| map_NAME.objecttracks | next to it: repeated track = 1 {id = 1, category = 2, boxes = 8} |

The message ellipsoid is that of GOReloc, whose map_objects_NAME.txt is the same, too. These facts
are from the sources of OA-SLAM; no map that it saved was at hand. A monocular map has no metric
scale, and its coordinate frame is the first camera's: z forward, y down.
"""

from collections.abc import Sequence
from pathlib import Path

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.datasets.map_formats.given_map import (
    GivenLandmark,
    GivenMap,
    LeftOut,
    class_name,
    make_id,
    read_bytes,
)
from cliploc_ros.datasets.map_formats.goreloc import QuadricError, decompose, read_quadric
from cliploc_ros.datasets.map_formats.protobuf import WireError, read_fields
from cliploc_ros.errors import DatasetError

_NOTE = ('a monocular map of OA-SLAM has no metric scale, and its axes are those of the first '
         'camera: give --scale and --transform')
_NUMBERS_IN_A_LINE = 18


def read_oaslam(path: Path, class_names: Sequence[str]) -> GivenMap:
    """Read the objects of an OA-SLAM map.

    Parameters
    ----------
    path : Path
        map_objects_NAME.txt, or map_NAME.mapobjects next to map_NAME.objecttracks.
    class_names : sequence of str
        Of the category indices.

    Raises
    ------
    DatasetError
        Names the file and what is wrong with it.
    """
    if path.suffix == '.mapobjects':
        return _read_saved_map(path, class_names)
    given = GivenMap([], [], [_NOTE])
    try:
        lines = read_bytes(path).decode('ascii').splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f'{path}: is no map_objects_NAME.txt of OA-SLAM: not a text; a '
                           'saved map must end in .mapobjects') from error
    for line_number, line in enumerate(lines, 1):
        if line.strip():
            track, category, quadric = _read_line(line, f'{path}: line {line_number}')
            _add(given, track, class_name(class_names, category), quadric)
    return given


def _read_line(line: str, where: str) -> tuple[int, int, list[float]]:
    """Return track id, category and dual quadric of a line."""
    words = line.split()
    try:
        if len(words) != _NUMBERS_IN_A_LINE:
            raise ValueError
        return int(words[0]), int(words[1]), [float(word) for word in words[2:]]
    except ValueError as error:
        raise DatasetError(f'{where}: expected track id, category and the 16 numbers of a dual '
                           f'quadric, not {line[:40]!r}') from error


def _add(given: GivenMap, track: int, name: str, quadric: list[float],
         support: int | None = None) -> None:
    """Append an object to what a file holds."""
    landmark_id = make_id(name, track)
    try:
        ellipsoid = decompose(quadric)
    except QuadricError as error:
        given.left_out.append(LeftOut(landmark_id, str(error)))
        return
    given.landmarks.append(GivenLandmark(
        landmark_id, name, name, ellipsoid.center, ellipsoid.semi_axes, ellipsoid.quat_xyzw,
        LandmarkDetails(support=support)))


def _read_saved_map(path: Path, class_names: Sequence[str]) -> GivenMap:
    tracks_path = path.with_suffix('.objecttracks')
    if not tracks_path.is_file():
        raise DatasetError(f'{tracks_path} is missing: it holds the classes of {path.name}')
    given = GivenMap([], [], [_NOTE])
    tracks = _read_tracks(tracks_path)
    try:
        for field in read_fields(memoryview(read_bytes(path))):
            if field.number != 1:
                raise WireError(f'field {field.number} is unknown')
            track = 0  # a zero is not stored
            quadric: list[float] = []
            for part in read_fields(field.message()):
                if part.number == 1:
                    quadric += read_quadric(part.message())
                elif part.number == 2:
                    track = part.integer()
            if track in tracks:
                category, support = tracks[track]
                _add(given, track, class_name(class_names, category), quadric, support)
            else:
                given.left_out.append(LeftOut(
                    f'track {track}', f'{tracks_path.name} has no such track, and so no class'))
    except WireError as error:
        raise DatasetError(f'{path}: is no complete map of OA-SLAM: {error}') from error
    return given


def _read_tracks(path: Path) -> dict[int, tuple[int, int]]:
    """Return category and number of keyframes of each track, by its id."""
    tracks = {}
    try:
        for field in read_fields(memoryview(read_bytes(path))):
            track = category = support = 0  # a zero is not stored
            for part in read_fields(field.message()):
                if part.number == 1:
                    track = part.integer()
                elif part.number == 2:
                    category = part.integer()
                elif part.number == 8:
                    support += 1
            tracks[track] = category, support
    except WireError as error:
        raise DatasetError(f'{path}: is no complete map of OA-SLAM: {error}') from error
    return tracks
