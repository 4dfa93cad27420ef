# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Query files: recorded boxes and similarities, identical input for every method."""

import math
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.units import NS_PER_S

#: Arrays of the file by name: shape (F frames, n boxes, L landmarks), and kind of dtype.
LAYOUT = {
    'landmark_ids': (('L',), 'string'),
    'intrinsics_fx_fy_cx_cy': ((4,), 'number'),
    'frame_offsets': (('F+1',), 'integer'),
    'boxes_xyxy': (('n', 4), 'number'),
    'class_ids': (('n',), 'string'),
    'scores': (('n',), 'number'),
    'similarities': (('n', 'L'), 'number'),
    'true_landmark': (('n',), 'integer'),
    'map_from_camera': (('F', 4, 4), 'number'),
    'timestamps': (('F',), 'number'),
    'query_group': (('F',), 'integer'),
    'is_main': (('F',), 'boolean'),
}
#: An optional array of exact stamps [ns]; a float64 of seconds cannot hold them.
STAMPS_NS = 'stamps_ns'
#: Optional arrays: the time that detector and CLIP took [ms], NaN where unknown.
_STAGES = ('detector_ms', 'clip_ms')
_OPTIONAL = {STAMPS_NS: (('F',), 'integer')} | dict.fromkeys(_STAGES, (('F',), 'number'))

_KINDS = {'string': 'US', 'number': 'fiu', 'integer': 'iu', 'boolean': 'b'}
_MAX_SIMILARITY = 1.001  # half precision rounds some cosines to just above 1


@dataclass(frozen=True)
class QueryFrame:
    """One frame of a query file: n boxes, L landmarks.

    Parameters
    ----------
    stamp_ns : int
        Time of the image [ns].
    bboxes_xyxy : ndarray (n, 4)
        Left, top, right, bottom [px], undistorted.
    class_ids : tuple of str
        Detector classes.
    scores : ndarray (n,)
        Detector confidences.
    similarities : ndarray (n, L)
        Cosine similarity of each crop and each landmark's label.
    true_landmark : ndarray (n,) of int
        Index into the landmarks, -1 where unknown. For evaluation only.
    map_from_camera : ndarray (4, 4)
        Ground truth.
    group : int
        The query to which the frame belongs.
    is_main : bool
        Whether the frame is the query itself and not one of its neighbours.
    detector_ms, clip_ms : float
        Processing time of the image [ms]; NaN if not recorded.
    """

    stamp_ns: int
    bboxes_xyxy: NDArray[np.float64]
    class_ids: tuple[str, ...]
    scores: NDArray[np.float64]
    similarities: NDArray[np.float64]
    true_landmark: NDArray[np.int64]
    map_from_camera: NDArray[np.float64]
    group: int
    is_main: bool
    detector_ms: float = math.nan
    clip_ms: float = math.nan

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.class_ids)


@dataclass(frozen=True)
class Queries:
    """The content of a query file.

    Parameters
    ----------
    landmark_ids : tuple of str
        The landmarks of the columns of the similarities.
    intrinsics_fx_fy_cx_cy : tuple of float
        Of the undistorted camera [px].
    frames : tuple of QueryFrame
        In the file's order.
    """

    landmark_ids: tuple[str, ...]
    intrinsics_fx_fy_cx_cy: tuple[float, float, float, float]
    frames: tuple[QueryFrame, ...]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __iter__(self) -> Iterator[QueryFrame]:
        """Iterate over the frames."""
        return iter(self.frames)

    def __getitem__(self, index: int) -> QueryFrame:
        """Return a frame."""
        return self.frames[index]

    def main_frames(self) -> tuple[QueryFrame, ...]:
        """Return the main frame of each query."""
        return tuple(frame for frame in self.frames if frame.is_main)

    def group(self, group: int) -> tuple[QueryFrame, ...]:
        """Return all frames of one query, in the file's order."""
        return tuple(frame for frame in self.frames if frame.group == group)


def load_queries(
    path: str | Path, landmark_ids: Collection[str] | None = None
) -> Queries:
    """Read and validate a query file.

    Parameters
    ----------
    path : str or Path
        An npz file without pickles.
    landmark_ids : collection of str, optional
        The map's landmarks; the file must contain no others.

    Returns
    -------
    Queries

    Raises
    ------
    DatasetError
        If the file is invalid; the message names file, array and error.
    """
    path = Path(path)
    try:
        arrays = _load_arrays(path)
        _check_layout(arrays)
        _check_values(arrays)
        if landmark_ids is not None:
            _check_landmarks(arrays, landmark_ids)
    except _ArrayError as error:
        raise DatasetError(f'{path}: {error}') from error
    return _make_queries(arrays)


def save_queries(path: str | Path, queries: Queries) -> None:
    """Write a query file atomically.

    Parameters
    ----------
    path : str or Path
        The npz file; an existing one is replaced.
    queries : Queries
        What to write; validated like a file that is read.

    Raises
    ------
    DatasetError
        If the queries are invalid or the file cannot be written.
    """
    path = Path(path)
    try:
        arrays = _make_arrays(queries)
        _check_layout(arrays)
        _check_values(arrays)
    except (_ArrayError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be written: {error}') from error
    try:
        with replace_file(path) as partial, partial.open('wb') as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise DatasetError(
            f'{path}: cannot be written: {error.strerror}; no partial file remains'
        ) from error


class _ArrayError(Exception):
    """An invalid array; the caller adds the file's name."""


def _load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise _ArrayError('no such query file')
    try:
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _ArrayError('is no npz file') from error
    if not isinstance(content, np.lib.npyio.NpzFile):
        raise _ArrayError('is a single array, not an npz file of named arrays')
    with content:
        if missing := [name for name in LAYOUT if name not in content.files]:
            raise _ArrayError(f'array {missing[0]} is missing')
        names = [name for name in (*LAYOUT, *_OPTIONAL) if name in content.files]
        return {name: _load_array(content, name) for name in names}


def _load_array(content: Any, name: str) -> NDArray[Any]:
    try:
        array = np.asarray(content[name])
        return np.char.decode(array, 'utf-8') if array.dtype.kind == 'S' else array
    except Exception as error:  # numpy's and zipfile's own, in a damaged file
        raise _ArrayError(f'array {name} cannot be read: {error}') from error


def _check_layout(arrays: dict[str, NDArray[Any]]) -> None:
    sizes: dict[str, int] = {}
    for name, letter in (('landmark_ids', 'L'), ('boxes_xyxy', 'n'), ('timestamps', 'F')):
        if arrays[name].ndim == 0:
            raise _ArrayError(f'array {name} is a single value')
        sizes[letter] = len(arrays[name])
    sizes['F+1'] = sizes['F'] + 1
    layout = LAYOUT | {name: one for name, one in _OPTIONAL.items() if name in arrays}
    for name, (letters, kind) in layout.items():
        array = arrays[name]
        shape = tuple(sizes.get(str(letter), letter) for letter in letters)
        if array.shape != shape:
            raise _ArrayError(f'array {name} has shape {array.shape}, expected {shape}')
        if array.dtype.kind not in _KINDS[kind]:
            raise _ArrayError(f'array {name} has type {array.dtype}, expected {kind}s')
    for letter, what in (('F', 'frames'), ('L', 'landmarks')):
        if sizes[letter] == 0:
            raise _ArrayError(f'holds no {what}')


def _check_values(arrays: dict[str, NDArray[Any]]) -> None:
    for name, (_, kind) in LAYOUT.items():
        if kind == 'number' and not np.isfinite(arrays[name]).all():
            row = np.argwhere(~np.isfinite(arrays[name]))[0][0]
            raise _ArrayError(f'array {name} is not finite in row {row}')
    ids = arrays['landmark_ids']
    _refuse('landmark_ids', 'repeats an id', _repeated(ids))
    _refuse('landmark_ids', 'is empty', ids == '')
    if (arrays['intrinsics_fx_fy_cx_cy'][:2] <= 0).any():
        raise _ArrayError('array intrinsics_fx_fy_cx_cy has a focal length that is not above 0')
    _check_offsets(arrays['frame_offsets'], len(arrays['boxes_xyxy']))
    boxes = arrays['boxes_xyxy']
    _refuse(
        'boxes_xyxy', 'is not left, top, right, bottom', (boxes[:, :2] >= boxes[:, 2:]).any(axis=1)
    )
    scores, similarities = arrays['scores'], arrays['similarities']
    _refuse('scores', 'is outside 0 to 1', (scores < 0) | (scores > 1))
    _refuse(
        'similarities',
        'is no cosine, outside -1 to 1',
        (np.abs(similarities) > _MAX_SIMILARITY).any(axis=1),
    )
    truth = arrays['true_landmark']
    _refuse('true_landmark', 'is no landmark', (truth < -1) | (truth >= len(ids)))
    _check_poses(arrays['map_from_camera'])
    _check_stamps(arrays)
    _check_groups(arrays['query_group'], arrays['is_main'])


def _refuse(name: str, what: str, is_wrong: NDArray[np.bool_]) -> None:
    if is_wrong.any():
        raise _ArrayError(f'array {name} {what} in row {int(np.argmax(is_wrong))}')


def _repeated(values: NDArray[Any]) -> NDArray[np.bool_]:
    repeated = np.ones(len(values), dtype=np.bool_)
    repeated[np.unique(values, return_index=True)[1]] = False
    return repeated


def _check_offsets(offsets: NDArray[Any], boxes: int) -> None:
    if offsets[0] != 0 or offsets[-1] != boxes:
        raise _ArrayError(
            f'array frame_offsets goes from {offsets[0]} to {offsets[-1]}, '
            f'expected 0 to {boxes}, the number of boxes'
        )
    _refuse('frame_offsets', 'decreases', np.diff(offsets.astype(np.int64), prepend=0) < 0)


def _check_poses(poses: NDArray[Any]) -> None:
    rotations = poses[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    no_rotation = (error > 1e-3) | (np.linalg.det(rotations) < 0)
    no_rotation |= (poses[:, 3] != [0, 0, 0, 1]).any(axis=1)
    _refuse('map_from_camera', 'is no rigid transform', no_rotation)


def _check_stamps(arrays: dict[str, NDArray[Any]]) -> None:
    timestamps = arrays['timestamps']
    _refuse('timestamps', 'is negative', timestamps < 0)
    if STAMPS_NS in arrays:
        difference_s = np.abs(arrays[STAMPS_NS] / NS_PER_S - timestamps)
        _refuse(STAMPS_NS, 'contradicts timestamps', difference_s > 1e-6)


def _check_groups(groups: NDArray[Any], is_main: NDArray[np.bool_]) -> None:
    for group in np.unique(groups):
        mains = int(is_main[groups == group].sum())
        if mains != 1:
            raise _ArrayError(f'array is_main marks {mains} frames of query_group {group}, not 1')


def _check_landmarks(arrays: dict[str, NDArray[Any]], known: Collection[str]) -> None:
    if unknown := [str(one) for one in arrays['landmark_ids'] if str(one) not in known]:
        raise _ArrayError(
            f'array landmark_ids has {unknown[0]!r}, which the map does not know'
            + (f' (and {len(unknown) - 1} more)' if len(unknown) > 1 else '')
        )


def _make_queries(arrays: dict[str, NDArray[Any]]) -> Queries:
    fx, fy, cx, cy = (float(value) for value in arrays['intrinsics_fx_fy_cx_cy'])
    offsets = arrays['frame_offsets']
    return Queries(
        landmark_ids=tuple(str(one) for one in arrays['landmark_ids']),
        intrinsics_fx_fy_cx_cy=(fx, fy, cx, cy),
        frames=tuple(
            _make_frame(arrays, index, slice(int(offsets[index]), int(offsets[index + 1])))
            for index in range(len(offsets) - 1)
        ),
    )


def _make_frame(arrays: dict[str, NDArray[Any]], index: int, rows: slice) -> QueryFrame:
    return QueryFrame(
        stamp_ns=_stamp_ns(arrays, index),
        bboxes_xyxy=arrays['boxes_xyxy'][rows].astype(np.float64),
        class_ids=tuple(str(one) for one in arrays['class_ids'][rows]),
        scores=arrays['scores'][rows].astype(np.float64),
        similarities=arrays['similarities'][rows].astype(np.float64),
        true_landmark=arrays['true_landmark'][rows].astype(np.int64),
        map_from_camera=arrays['map_from_camera'][index].astype(np.float64),
        group=int(arrays['query_group'][index]),
        is_main=bool(arrays['is_main'][index]),
        **{name: float(arrays[name][index]) for name in _STAGES if name in arrays},
    )


def _stamp_ns(arrays: dict[str, NDArray[Any]], index: int) -> int:
    if STAMPS_NS in arrays:
        return int(arrays[STAMPS_NS][index])
    # A float64 of today's seconds resolves 0.24 us: round to microseconds.
    return round(float(arrays['timestamps'][index]) * 1e6) * 1000


def _make_arrays(queries: Queries) -> dict[str, NDArray[Any]]:
    frames = queries.frames
    landmarks = len(queries.landmark_ids)
    no_rows = np.empty((0, landmarks))
    stamps_ns = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    return {
        'landmark_ids': np.array(queries.landmark_ids, dtype=np.str_),
        'intrinsics_fx_fy_cx_cy': np.array(queries.intrinsics_fx_fy_cx_cy, dtype=np.float64),
        'frame_offsets': np.cumsum([0, *(len(frame) for frame in frames)], dtype=np.int64),
        'boxes_xyxy': np.concatenate([np.empty((0, 4)), *(one.bboxes_xyxy for one in frames)]),
        'class_ids': np.array([name for one in frames for name in one.class_ids], dtype=np.str_),
        'scores': np.concatenate([np.empty(0), *(one.scores for one in frames)]),
        'similarities': np.concatenate([no_rows, *(one.similarities for one in frames)]).astype(
            np.float32
        ),
        'true_landmark': np.concatenate(
            [np.empty(0, dtype=np.int64), *(one.true_landmark for one in frames)]
        ),
        'map_from_camera': np.array([one.map_from_camera for one in frames]).reshape(-1, 4, 4),
        # Python's division of integers rounds once, NumPy's twice.
        'timestamps': np.array([frame.stamp_ns / NS_PER_S for frame in frames]),
        'query_group': np.array([one.group for one in frames], dtype=np.int64),
        'is_main': np.array([one.is_main for one in frames], dtype=np.bool_),
        STAMPS_NS: stamps_ns,
        **{name: np.array([getattr(one, name) for one in frames]) for name in _STAGES},
    }
