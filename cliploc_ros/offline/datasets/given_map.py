# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read a map from a table, CSV, and convert maps of other systems to ours."""

import codecs
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.files.storage import read_file
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.datasets.parsing import naming, unit_quaternion
from cliploc_ros.offline.mapping.building import refit_map

# A smaller semi-axis is a collapsed fit; a larger one does not belong to an object. Not measured.
_SEMI_AXIS_RANGE_M = (1e-3, 100.0)
_MAX_COORDINATE_M = 1e6
_MAX_NORM_ERROR = 0.01
MAX_FILE_BYTES = 512 * 1024 * 1024
MAX_LENGTH = 1000


class GivenLandmark(NamedTuple):
    """A landmark as stored, in the file's coordinate frame and unit of length."""

    landmark_id: str
    label: str
    class_id: str
    center: Sequence[float]
    semi_axes: Sequence[float]
    quat_xyzw: Sequence[float]  #: Rotation from landmark axes into the file's axes
    details: LandmarkDetails = LandmarkDetails()


class Skipped(NamedTuple):
    """A landmark of the file that is not in the map, and the reason."""

    landmark_id: str
    reason: str


class GivenMap(NamedTuple):
    """The content of a file: landmarks, unreadable objects, and notes on the file."""

    landmarks: list[GivenLandmark]
    left_out: list[Skipped]
    notes: list[str]


def place(given: GivenMap, source: str, frame_id: str, scale: float,
          map_from_given: NDArray[np.float64], errors: tuple[float, float] | None = None
          ) -> tuple[LandmarkMap, list[Skipped]]:
    """Convert a map to our coordinate frame and to metres; also return what is left out.

    Invalid landmarks are left out. DatasetError: no landmark is valid; the message gives the
    reason of the first.

    Parameters
    ----------
    source : str
        The source that each landmark stores.
    frame_id : str
        Coordinate frame of the map, where x_map = map_from_given @ (scale * x_given).
    scale : float
        Metres per unit of length of the file.
    map_from_given : ndarray (4, 4)
    errors : tuple of two floats, optional
        Standard deviation of the position on each axis, both of single landmarks and of all
        together [m], and of the rotation of all together [deg]; used if the file has none.
    """
    kept: dict[str, GivenLandmark] = {}
    left_out = list(given.left_out)
    for landmark in given.landmarks:
        reason = ('its id is repeated' if landmark.landmark_id in kept
                  else _reason_against(landmark, scale))
        if reason is not None:
            left_out.append(Skipped(landmark.landmark_id, reason))
            continue
        details = replace(landmark.details, source=source)
        if details.position_sigma is not None:
            details = replace(details, position_sigma=scale * details.position_sigma)
        elif errors is not None:
            details = replace(details, position_sigma=errors[0], shared_sigma=errors[0],
                              shared_sigma_deg=errors[1])
        kept[landmark.landmark_id] = landmark._replace(details=details)
    if not kept:
        why = f'; the first one: {left_out[0].reason}' if left_out else ''
        raise DatasetError(f'none of its {len(left_out)} landmarks can be used{why}')
    ids, labels, class_ids, centers, semi_axes, quats, details_of = zip(
        *kept.values(), strict=True)
    turn = map_from_given[:3, :3]
    rotations = Rotation.from_matrix(turn) * Rotation.from_quat(np.array(quats, dtype=np.float64))
    return LandmarkMap(
        frame_id, ids, labels, class_ids,
        np.array(centers) * scale @ turn.T + map_from_given[:3, 3],
        np.array(semi_axes) * scale, rotations.as_quat(), details_of), left_out


def refit(before: LandmarkMap, observations: Path, keep_unsupported: bool
          ) -> tuple[LandmarkMap, list[Skipped], list[str]]:
    """Fit a map to the boxes of an observation file; also return what is left out, and notes.

    `keep_unsupported` keeps landmarks that cannot be fitted, unchanged. CliplocError: the file is
    invalid, or no landmark can be fitted.
    """
    detections = load_observations(observations)
    try:
        fit = refit_map(detections, before)
    except MappingError as error:
        raise MappingError(f'{observations}: {error}') from error
    left_out = [Skipped(before.landmark_ids[row], reason) for row, reason in enumerate(fit.reasons)
                if reason is not None and not (keep_unsupported and fit.part_of[row] == row)]
    fitted = [row for row, reason in enumerate(fit.reasons) if reason is None]
    moved_m = np.linalg.norm(fit.landmark_map.centers - before.centers, axis=1)
    gone = {skipped.landmark_id for skipped in left_out}
    return fit.landmark_map.select(
        [row for row, name in enumerate(before.landmark_ids) if name not in gone]), left_out, [
        f'{len(fitted)} of {len(before)} landmarks fitted to {observations.name}: explained '
        f'boxes {fit.explained_before:.1%} -> {fit.explained:.1%}, median IoU '
        f'{fit.iou_before:.3f} -> {fit.iou:.3f} (on the frames used for fitting)',
        f'they moved by {np.median(moved_m[fitted]) * 100:.1f} cm (median)',
        *(f'note: {note}' for note in fit.notes),
        *(f'note: {before.landmark_ids[row]} moved by {moved_m[row]:.2f} m, more than its size: '
          'check its label' for row in fitted
          if moved_m[row] > 2.0 * before.semi_axes[row].max())]


def _reason_against(landmark: GivenLandmark, scale: float) -> str | None:
    """Return the reason why a landmark is invalid; None if it is valid."""
    numbers = np.array([*landmark.center, *landmark.semi_axes, *landmark.quat_xyzw])
    if not np.isfinite(numbers).all():
        return 'it has numbers that are not finite'
    semi_axes = numbers[3:6] * scale
    least, most = _SEMI_AXIS_RANGE_M
    if semi_axes.min() < least or semi_axes.max() > most:
        shown = ' '.join(f'{axis:.3g}' for axis in semi_axes)
        return f'its semi-axes are {shown} m, not {least:g} to {most:g}'
    if np.abs(numbers[:3]).max() * scale > _MAX_COORDINATE_M:
        return f'its centre is beyond {_MAX_COORDINATE_M:g} m'
    norm = math.hypot(*numbers[6:])
    if abs(norm - 1.0) > _MAX_NORM_ERROR:
        return f'its quaternion has the norm {norm:.3g}, not 1'
    return None


def make_id(class_id: str, number: int | str) -> str:
    """Make an id of class and number, for a landmark that has only a number."""
    word = ''.join(char if char.isalnum() else '_' for char in class_id)
    return f'{word}_{number}'


def read_bytes(path: Path) -> bytes:
    """Read a regular file that is neither empty nor too large.

    DatasetError: the message names the file and its fault.
    """
    with naming(path, OSError, what='cannot be read: '):
        content = read_file(path, MAX_FILE_BYTES)
    if not content:
        raise DatasetError(f'{path}: is empty')
    return content


_CENTER, _SEMI_AXES, _QUATERNION = ('x', 'y', 'z'), ('a', 'b', 'c'), ('qx', 'qy', 'qz', 'qw')
_REQUIRED = ('class_id', *_CENTER, *_SEMI_AXES)
_DETAILS = ('position_sigma', 'support', 'seen_ratio', 'baseline_deg', 'last_seen')
_NUMBERS = (*_CENTER, *_SEMI_AXES, *_QUATERNION, *_DETAILS)
#: Columns that a table may have; the others are ignored.
COLUMNS = ('id', 'label', *_REQUIRED, *_QUATERNION, *_DETAILS)
_NO_TURN = [0.0, 0.0, 0.0, 1.0]


def read_table(path: Path) -> GivenMap:
    """Read a map from a table: CSV of an editor or a spreadsheet, with a header.

    Separators are commas, semicolons or tabs. With semicolons or tabs, numbers may have decimal
    commas.

    The default id of a row is its class and number, the default label its class. In a table
    without qx, qy, qz and qw, the ellipsoids are aligned with the axes of the coordinate frame.
    DatasetError: the message names the file, the line and the column to correct.
    """
    content = read_bytes(path)
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # spreadsheets
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
            landmark = _landmark_of_row(row, len(given.landmarks) + 1, where)
            first = lines.setdefault(landmark.landmark_id, reader.line_num)
            if first != reader.line_num:
                raise DatasetError(f"{where}: id '{landmark.landmark_id}' is already used in line "
                                   f'{first}')
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
    """Return the values of a line by column, with decimal points in numbers."""
    if any(cell.strip() for cell in cells[len(header):]):
        raise DatasetError(f'{where}: has {len(cells)} values for {len(header)} columns; quote '
                           f'text that has a {delimiter!r}')
    row = dict.fromkeys(header, '') | {
        name: cell.strip() for name, cell in zip(header, cells, strict=False)}
    if delimiter != ',':
        row |= {name: row[name].replace(',', '.') for name in _NUMBERS if name in row}
    return row


def _landmark_of_row(row: Mapping[str, str], number: int, where: str) -> GivenLandmark:
    class_id = _text(row, 'class_id', where)
    landmark_id = row.get('id') or make_id(class_id, number)
    if '.' in landmark_id or len(landmark_id) > MAX_LENGTH:
        raise DatasetError(f'{where}: column id: an id must be short text without dots')
    label = _text(row, 'label', where) if row.get('label') else class_id
    has_turn = _QUATERNION[0] in row
    quat_xyzw = [_number(row, name, where) for name in _QUATERNION] if has_turn else _NO_TURN
    unit_quaternion(quat_xyzw, f'{where}: columns qx to qw', _MAX_NORM_ERROR)
    semi_axes = [_number(row, name, where) for name in _SEMI_AXES]
    for name, value in zip(_SEMI_AXES, semi_axes, strict=True):
        if value <= 0.0:
            raise DatasetError(f'{where}: column {name}: {value:g} must be above 0')
    details: dict[str, Any] = {name: _number(row, name, where) for name in _DETAILS
                               if row.get(name)}
    for name, value in details.items():
        if value < 0.0:
            raise DatasetError(f'{where}: column {name}: {value:g} must not be negative')
    if 'support' in details:
        details['support'] = int(details['support'])
    return GivenLandmark(landmark_id, label, class_id,
                         [_number(row, name, where) for name in _CENTER], semi_axes, quat_xyzw,
                         LandmarkDetails(**details))


def _text(row: Mapping[str, str], name: str, where: str) -> str:
    if not row[name] or len(row[name]) > MAX_LENGTH:
        raise DatasetError(f'{where}: column {name}: must be text of 1 to {MAX_LENGTH} '
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
