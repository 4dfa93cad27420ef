# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a reader of a map format returns, and how it becomes a map of ours."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from stat import S_ISREG
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import DatasetError, MappingError
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.datasets.parsing import naming
from cliploc_ros.offline.mapping.refit import refit_map
from cliploc_ros.offline.vocabulary.vocabulary import shipped_classes

# A landmark with a thinner semi-axis is a fit that collapsed; a larger one is no object. Guesses.
_SEMI_AXIS_RANGE_M = (1e-3, 100.0)
_MAX_COORDINATE_M = 1e6
_MAX_NORM_ERROR = 0.01
MAX_FILE_BYTES = 512 * 1024 * 1024
COCO = shipped_classes()
_MAX_LENGTH = 1000
# A map file holds four decimals of a weight. A class with less means nothing.
_LEAST_SHARE = 0.001


class GivenLandmark(NamedTuple):
    """A landmark as its file has it, in the file's coordinate frame and unit of length."""

    landmark_id: str
    label: str
    class_id: str
    center: Sequence[float]
    semi_axes: Sequence[float]
    quat_xyzw: Sequence[float]  #: Landmark axes into the file's axes
    details: LandmarkDetails = LandmarkDetails()


class Skipped(NamedTuple):
    """A landmark of the file that is not in the map, and why."""

    landmark_id: str
    reason: str


class GivenMap(NamedTuple):
    """The content of a file: landmarks, what could not be read as one, and notes on the file."""

    landmarks: list[GivenLandmark]
    left_out: list[Skipped]
    notes: list[str]


class ImportedMap(NamedTuple):
    """A map of ours, what was left out and why, and what to say about it."""

    landmark_map: LandmarkMap
    left_out: tuple[Skipped, ...]
    notes: tuple[str, ...]


def place(given: GivenMap, source: str, frame_id: str, scale: float,
          map_from_given: NDArray[np.float64], errors: tuple[float, float] | None = None
          ) -> ImportedMap:
    """Return a given map in the coordinate frame and unit of ours.

    Landmarks that no map can hold are left out. DatasetError: no landmark is left; the message
    says why the first one was left out.

    Parameters
    ----------
    source : str
        What the landmarks say of where they come from.
    frame_id : str
        Coordinate frame of the map, where x_map = map_from_given @ (scale * x_given).
    scale : float
        Metres in one unit of length of the file.
    map_from_given : ndarray (4, 4)
    errors : tuple of two floats, optional
        How far the landmarks are off on each axis where the file does not say it, each on its own
        and all together [m], and by how much they are turned together [deg].
    """
    kept: dict[str, GivenLandmark] = {}
    left_out = list(given.left_out)
    for landmark in given.landmarks:
        reason = ('its id occurs before' if landmark.landmark_id in kept
                  else _reason_against(landmark, scale))
        if reason is None:
            kept[landmark.landmark_id] = landmark
        else:
            left_out.append(Skipped(landmark.landmark_id, reason))
    if not kept:
        why = f'; the first one: {left_out[0].reason}' if left_out else ''
        raise DatasetError(f'none of its {len(left_out)} landmarks can be used{why}')
    ids, labels, class_ids, centers, semi_axes, quats, details = zip(*kept.values(), strict=True)
    turn = map_from_given[:3, :3]
    rotations = Rotation.from_matrix(turn) * Rotation.from_quat(np.array(quats, dtype=np.float64))
    landmark_map = LandmarkMap(
        frame_id, ids, labels, class_ids,
        np.array(centers) * scale @ turn.T + map_from_given[:3, 3],
        np.array(semi_axes) * scale, rotations.as_quat(),
        tuple(_with_errors(replace(one, source=source), scale, errors) for one in details))
    return ImportedMap(landmark_map, tuple(left_out), tuple(given.notes))


def _with_errors(details: LandmarkDetails, scale: float, errors: tuple[float, float] | None
                 ) -> LandmarkDetails:
    """Return details with the deviation of the file in metres, or with given ones."""
    if details.position_sigma is not None:
        return replace(details, position_sigma=scale * details.position_sigma)
    if errors is None:
        return details
    return replace(details, position_sigma=errors[0], shared_sigma=errors[0],
                   shared_sigma_deg=errors[1])


def refit(imported: ImportedMap, observations: Path, keep_unsupported: bool) -> ImportedMap:
    """Return an imported map fitted to the boxes of an observation file.

    `keep_unsupported` keeps landmarks that cannot be fitted, where the file has them.
    CliplocError: the file is invalid, or nothing can be fitted to it.
    """
    detections = load_observations(observations)
    before = imported.landmark_map
    try:
        fit = refit_map(detections, before)
    except MappingError as error:
        raise MappingError(f'{observations}: {error}') from error
    left_out, kept = list(imported.left_out), []
    for row, reason in enumerate(fit.reasons):
        if reason is None or (keep_unsupported and fit.part_of[row] == row):
            kept.append(row)
        else:
            left_out.append(Skipped(before.landmark_ids[row], reason))
    fitted = [row for row, reason in enumerate(fit.reasons) if reason is None]
    moved_m = np.linalg.norm(fit.landmark_map.centers - before.centers, axis=1)
    far = [row for row in fitted if moved_m[row] > 2.0 * before.semi_axes[row].max()]
    return ImportedMap(fit.landmark_map.select(kept), tuple(left_out), (
        f'{len(fitted)} of {len(before)} landmarks fitted to {observations.name}: explained '
        f'boxes {fit.explained_before:.1%} -> {fit.explained:.1%}, median IoU '
        f'{fit.iou_before:.3f} -> {fit.iou:.3f} (on the frames used for fitting)',
        f'they moved by {np.median(moved_m[fitted]) * 100:.1f} cm (median)',
        *(f'note: {note}' for note in (*imported.notes, *fit.notes)),
        *(f'note: {before.landmark_ids[row]} moved by {moved_m[row]:.2f} m, more than its size: '
          'check its label' for row in far)))


def _reason_against(landmark: GivenLandmark, scale: float) -> str | None:
    """Return why no map can hold a landmark, or None."""
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
    """Return an id for a landmark that has only a number: its class and the number."""
    word = ''.join(char if char.isalnum() else '_' for char in class_id)
    return f'{word}_{number}'


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file that is neither empty nor too large.

    DatasetError: the message names the file and what is wrong with it.
    """
    with naming(path, OSError, what='cannot be read: '):
        if not S_ISREG(path.stat().st_mode):
            raise DatasetError(f'{path}: is no file; name the file of the map')
        with path.open('rb') as file:
            content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise DatasetError(f'{path}: is larger than {MAX_FILE_BYTES // 2**20} MiB; split it')
    if not content:
        raise DatasetError(f'{path}: is empty')
    return content


def read_class_names(path: Path) -> tuple[str, ...]:
    """Read a text file with one class name in each line.

    DatasetError: the message names the file and the line to correct.
    """
    with naming(path, UnicodeDecodeError, what='not a text file in UTF-8: '):
        lines = read_bytes(path).decode('utf-8-sig').splitlines()
    names = tuple(line.strip() for line in lines)
    for number, name in enumerate(names, 1):
        if not name or len(name) > _MAX_LENGTH:
            raise DatasetError(f'{path}: line {number} must be a class name, one in each line')
    return names


def class_name(names: Sequence[str], index: int) -> str:
    """Return the name of a class; DatasetError: the list of names has no such index."""
    if not 0 <= index < len(names):
        raise DatasetError(f'class index {index} is not among {len(names)} names; name the '
                           'classes that the map was made with: `class_names`')
    return names[index]


def shares(weights: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Return classes with their shares, the greatest first; those below a thousandth go."""
    least = _LEAST_SHARE * sum(weights.values())
    ranked = sorted(((name, weight) for name, weight in weights.items() if weight > least),
                    key=lambda pair: -pair[1])
    total = sum(weight for _, weight in ranked)
    return tuple((name, weight / total) for name, weight in ranked)
