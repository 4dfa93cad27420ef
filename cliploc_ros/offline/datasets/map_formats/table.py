# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps as tables: CSV of an editor or a spreadsheet, with a header.

Separators are commas, semicolons or tabs. Next to semicolons and tabs, numbers may have decimal
commas.
"""

import codecs
import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.map_formats.given_map import (
    GivenLandmark,
    GivenMap,
    make_id,
    read_bytes,
)
from cliploc_ros.offline.datasets.parsing import unit_quaternion

_CENTER, _SEMI_AXES, _QUATERNION = ('x', 'y', 'z'), ('a', 'b', 'c'), ('qx', 'qy', 'qz', 'qw')
_REQUIRED = ('class_id', *_CENTER, *_SEMI_AXES)
_DETAILS = ('position_sigma', 'support', 'seen_ratio', 'baseline_deg', 'last_seen')
_NUMBERS = (*_CENTER, *_SEMI_AXES, *_QUATERNION, *_DETAILS)
#: Columns that a table may have; the others are ignored.
COLUMNS = ('id', 'label', *_REQUIRED, *_QUATERNION, *_DETAILS)
_MAX_LENGTH = 1000
_MAX_NORM_ERROR = 0.01
_NO_TURN = [0.0, 0.0, 0.0, 1.0]


def read_table(path: Path) -> GivenMap:
    """Read a map from a table.

    A row without an id gets its class and number as one, a row without a label its class. A table
    without qx, qy, qz and qw has ellipsoids along the axes of its coordinate frame. DatasetError:
    the message names the file, the line and the column to correct.
    """
    content = read_bytes(path)
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # of a spreadsheet
    try:
        text = content.decode('utf-16' if is_utf16 else 'utf-8-sig').lstrip()
    except UnicodeDecodeError as error:
        raise DatasetError(f'{path}: not a text file in UTF-8 (byte {error.start}); save the '
                           'table as CSV in UTF-8') from error
    delimiter = max(',;\t', key=text.split('\n', 1)[0].count)
    reader = csv.reader(io.StringIO(text, newline=''), delimiter=delimiter, strict=True)
    given = GivenMap([], [], [])
    lines: dict[str, int] = {}
    try:
        header = _read_header(next(reader, []), path)
        if ignored := [name for name in header if name not in COLUMNS]:
            given.notes.append(f'ignored columns: {", ".join(ignored)[:200]}')
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            where = f'{path}: line {reader.line_num}'
            row = _row(header, cells, delimiter, where)
            landmark = _landmark(row, len(given.landmarks) + 1, where)
            first = lines.setdefault(landmark.landmark_id, reader.line_num)
            if first != reader.line_num:
                raise DatasetError(f"{where}: id '{landmark.landmark_id}' is that of line {first}")
            given.landmarks.append(landmark)
    except csv.Error as error:
        raise DatasetError(f'{path}: line {reader.line_num}: {error}') from error
    return given


def _read_header(cells: Sequence[str], path: Path) -> list[str]:
    header = [cell.strip().lower() for cell in cells]
    if missing := [name for name in _REQUIRED if name not in header]:
        raise DatasetError(f'{path}: the header lacks {", ".join(missing)}; its first line must '
                           f'name the columns, of {", ".join(COLUMNS)}')
    if repeated := [name for name in COLUMNS if header.count(name) > 1]:
        raise DatasetError(f'{path}: the header has {repeated[0]} more than once')
    missing = [name for name in _QUATERNION if name not in header]
    if 0 < len(missing) < len(_QUATERNION):
        raise DatasetError(f'{path}: the header lacks {", ".join(missing)} of the quaternion')
    return header


def _row(header: Sequence[str], cells: Sequence[str], delimiter: str, where: str
         ) -> dict[str, str]:
    """Return the values of a line by their column; numbers with decimal points."""
    if any(cell.strip() for cell in cells[len(header):]):
        raise DatasetError(f'{where}: has {len(cells)} values for {len(header)} columns; quote '
                           f'text that has a {delimiter!r}')
    row = dict.fromkeys(header, '') | {
        name: cell.strip() for name, cell in zip(header, cells, strict=False)}
    if delimiter != ',':
        row |= {name: row[name].replace(',', '.') for name in _NUMBERS if name in row}
    return row


def _landmark(row: Mapping[str, str], number: int, where: str) -> GivenLandmark:
    class_id = _text(row, 'class_id', where)
    landmark_id = row.get('id') or make_id(class_id, number)
    if '.' in landmark_id or len(landmark_id) > _MAX_LENGTH:
        raise DatasetError(f'{where}: column id: an id must be short text without dots')
    label = _text(row, 'label', where) if row.get('label') else class_id
    has_turn = _QUATERNION[0] in row
    quat_xyzw = [_number(row, name, where) for name in _QUATERNION] if has_turn else _NO_TURN
    unit_quaternion(quat_xyzw, f'{where}: columns qx to qw', _MAX_NORM_ERROR)
    semi_axes = [_number(row, name, where) for name in _SEMI_AXES]
    for name, value in zip(_SEMI_AXES, semi_axes, strict=True):
        if value <= 0.0:
            raise DatasetError(f'{where}: column {name}: {value:g} must be above 0')
    return GivenLandmark(landmark_id, label, class_id,
                         [_number(row, name, where) for name in _CENTER], semi_axes, quat_xyzw,
                         _details(row, where))


def _details(row: Mapping[str, str], where: str) -> LandmarkDetails:
    values: dict[str, Any] = {name: _number(row, name, where) for name in _DETAILS
                              if row.get(name)}
    for name, value in values.items():
        if value < 0.0:
            raise DatasetError(f'{where}: column {name}: {value:g} must not be negative')
    if 'support' in values:
        values['support'] = int(values['support'])
    return LandmarkDetails(**values)


def _text(row: Mapping[str, str], name: str, where: str) -> str:
    if not row[name] or len(row[name]) > _MAX_LENGTH:
        raise DatasetError(f'{where}: column {name}: must be text of 1 to {_MAX_LENGTH} '
                           'characters')
    return row[name]


def _number(row: Mapping[str, str], name: str, where: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f'{where}: column {name}: {row[name][:40]!r} is not a finite number')
    return value
