# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observation files: what a detector said about a recording, and where the camera was.

Mapping, evaluation and the map editor read the same file, so that the networks run once.
"""

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import CameraError, DatasetError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.mapping.posed_detections import PosedDetections

#: Arrays of the file, by name: shape in terms of F frames and n boxes, and kinds of dtype.
LAYOUT = {
    'intrinsics_fx_fy_cx_cy': ((4,), 'fiu'),
    'image_size': ((2,), 'iu'),
    'frame_offsets': (('F+1',), 'iu'),
    'boxes_xyxy': (('n', 4), 'fiu'),
    'class_ids': (('n',), 'US'),
    'scores': (('n',), 'fiu'),
    'map_from_camera': (('F', 4, 4), 'fiu'),
    'timestamps': (('F',), 'fiu'),
}
#: Arrays that a file may have besides.
OPTIONAL = {
    'depths': (('n',), 'f'),
    'depth_spreads': (('n',), 'f'),
    'open_edges': (('n', 4), 'b'),
    'embeddings': (('n', 'd'), 'f'),
    'encoder_key': ((), 'U'),
    'odom_from_camera': (('F', 4, 4), 'f'),  # a row without odometry is NaN
    'stamps_ns': (('F',), 'iu'),
    'detector_ms': (('F',), 'f'),
    'clip_ms': (('F',), 'f'),
    'image_counts': ((2,), 'iu'),
    'described': ((), 'U'),
}
_KIND_NAMES = {'f': 'floats', 'U': 'a string', 'fiu': 'numbers', 'iu': 'integers', 'US': 'strings',
               'b': 'true or false'}
_MAX_ROTATION_ERROR = 1e-3
# These are large, and few of their rows are in use at once.
_MAPPED = ('embeddings',)
_ROWS_AT_ONCE = 10_000
# Of a member of a zip file: where the lengths of its name and of a further field stand, and where
# the name begins.
_ZIP_LENGTHS, _ZIP_HEAD = 26, 30


@dataclass(frozen=True)
class Recorded:
    """Observations and how they came about: F frames.

    Parameters
    ----------
    detections : PosedDetections
    stamps_ns : ndarray (F,) of int
        Exact stamps [ns].
    detector_ms, clip_ms : ndarray (F,)
        Time that the networks took [ms]; NaN where unknown.
    images, without_pose : int
        Images of the source, and those of them without a pose.
    described : str
        All that the observations depend on; '' where unknown.
    """

    detections: PosedDetections
    stamps_ns: NDArray[np.int64]
    detector_ms: NDArray[np.float64]
    clip_ms: NDArray[np.float64]
    images: int
    without_pose: int
    described: str


def load_observations(path: str | Path) -> PosedDetections:
    """Read and validate an observation file.

    Frames are put in the order of time. A frame may lack boxes; a file may lack frames with
    boxes only if mapping is told so later.

    Parameters
    ----------
    path : str or Path
        An npz file without pickles.

    Raises
    ------
    DatasetError
        Names the file, the array, what is wrong with it, and what to do.
    """
    return load_recorded(path).detections


def load_recorded(path: str | Path) -> Recorded:
    """Read and validate an observation file, and how it came about; see load_observations."""
    path = Path(path)
    try:
        arrays = _read_arrays(path)
        _check_layout(arrays)
        _check_values(arrays)
        return _make_recorded(arrays)
    except (_ArrayError, CameraError) as error:
        raise DatasetError(f'{path}: {error}') from error


def save_observations(path: str | Path, detections: PosedDetections) -> None:
    """Write an observation file in one step: an existing file is replaced complete, or stays.

    Raises
    ------
    DatasetError
        The detections are malformed, or the file cannot be written.
    """
    _write(Path(path), _arrays_of(detections))


def save_recorded(path: str | Path, recorded: Recorded) -> None:
    """Write an observation file that says how it came about; see save_observations."""
    _write(Path(path), _arrays_of(recorded.detections) | {
        'stamps_ns': recorded.stamps_ns, 'detector_ms': recorded.detector_ms,
        'clip_ms': recorded.clip_ms, 'described': np.array(recorded.described),
        'image_counts': np.array([recorded.images, recorded.without_pose])})


def _arrays_of(detections: PosedDetections) -> dict[str, NDArray[Any]]:
    camera = detections.camera
    names = np.array(detections.class_names, dtype=np.str_)
    arrays: dict[str, NDArray[Any]] = {
        'intrinsics_fx_fy_cx_cy': np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        'image_size': np.array([camera.width, camera.height]),
        'frame_offsets': detections.frame_offsets,
        'boxes_xyxy': detections.bboxes_xyxy,
        'class_ids': names[detections.classes] if len(names) else np.empty(0, dtype=np.str_),
        'scores': detections.scores,
        'map_from_camera': detections.map_from_camera,
        'timestamps': detections.stamps_s,
    }
    for name in ('depths', 'depth_spreads', 'embeddings', 'odom_from_camera', 'open_edges'):
        if (values := getattr(detections, name)) is not None:
            arrays[name] = values
    if detections.encoder_key:
        arrays['encoder_key'] = np.array(detections.encoder_key)
    return arrays


def _write(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    # embeddings do not compress, and take minutes to try
    write: Any = np.savez if 'embeddings' in arrays else np.savez_compressed
    try:
        _check_layout(arrays)
        _check_values(arrays)
        with replace_file(path) as partial, partial.open('wb') as file:
            write(file, **arrays)
    except _ArrayError as error:
        raise DatasetError(f'{path}: cannot be written: {error}') from error
    except OSError as error:
        raise DatasetError(f'{path}: cannot be written: {error.strerror}; nothing was changed'
                           ) from error


class _ArrayError(Exception):
    """What is wrong with an array; the caller adds the file's name."""


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise _ArrayError('no such observation file')
    try:
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _ArrayError('is no complete npz file; record the observations again') from error
    if not isinstance(content, np.lib.npyio.NpzFile):
        raise _ArrayError('is a single array, not an npz file of named arrays')
    with content:
        if missing := [name for name in LAYOUT if name not in content.files]:
            hint = (' (this is a query file: map from an observation file)'
                    if 'similarities' in content.files else '')
            raise _ArrayError(f'array {missing[0]} is missing{hint}')
        return {name: _map_array(path, content, name) if name in _MAPPED
                else _read_array(content, name)
                for name in LAYOUT | OPTIONAL if name in content.files}


def _read_array(content: Any, name: str) -> NDArray[Any]:
    try:
        array = np.asarray(content[name])
        return np.char.decode(array, 'utf-8') if array.dtype.kind == 'S' else array
    except Exception as error:  # whatever numpy and zipfile meet in a broken file
        raise _damaged(name, error) from error


def _map_array(path: Path, content: Any, name: str) -> NDArray[Any]:
    """Return an array that stays in the file, so that memory holds only the rows in use."""
    try:
        member = content.zip.getinfo(f'{name}.npy')
        with content.zip.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
            start = stream.tell()
            while stream.read(1 << 20):  # to the end, where zipfile compares the check sum
                pass
        with path.open('rb') as file:
            file.seek(member.header_offset + _ZIP_LENGTHS)
            start += member.header_offset + _ZIP_HEAD + sum(struct.unpack('<HH', file.read(4)))
    except Exception as error:  # whatever numpy and zipfile meet in a broken file
        raise _damaged(name, error) from error
    if (member.compress_type != zipfile.ZIP_STORED or version != (1, 0) or by_columns
            or dtype.hasobject or 0 in shape):
        return _read_array(content, name)
    return np.memmap(path, dtype, 'r', start, shape)


def _damaged(name: str, error: Exception) -> _ArrayError:
    return _ArrayError(f'array {name} cannot be read: {error}; record the observations again')


def _check_layout(arrays: dict[str, NDArray[Any]]) -> None:
    sizes: dict[object, int] = {}
    for letter, name in (('F', 'timestamps'), ('n', 'boxes_xyxy')):
        if arrays[name].ndim == 0:
            raise _ArrayError(f'array {name} is a single value')
        sizes[letter] = len(arrays[name])
    sizes['F+1'] = sizes['F'] + 1
    if 'embeddings' in arrays:
        sizes['d'] = arrays['embeddings'].shape[-1]
    for name, (letters, kinds) in (LAYOUT | OPTIONAL).items():
        if name not in arrays:
            continue
        array, shape = arrays[name], tuple(sizes.get(letter, letter) for letter in letters)
        if array.shape != shape:
            raise _ArrayError(f'array {name} has shape {array.shape}, expected {shape}')
        if array.dtype.kind not in kinds:
            raise _ArrayError(f'array {name} has type {array.dtype}, expected '
                              f'{_KIND_NAMES[kinds]}')
    if sizes['F'] == 0:
        raise _ArrayError('holds no frames')


def _check_values(arrays: dict[str, NDArray[Any]]) -> None:
    for name, (_, kinds) in LAYOUT.items():
        if kinds == 'fiu':
            rows = arrays[name].reshape(len(arrays[name]), -1)
            _refuse(name, 'is not finite', ~np.isfinite(rows).all(axis=1))
    if 'embeddings' in arrays:
        _refuse('embeddings', 'is not finite', np.concatenate([
            ~np.isfinite(rows).all(axis=1) for rows in np.array_split(
                arrays['embeddings'], len(arrays['embeddings']) // _ROWS_AT_ONCE + 1)]))
    if 'depths' in arrays:
        _refuse('depths', 'is not positive', arrays['depths'] <= 0.0)  # NaN is none
    offsets = arrays['frame_offsets'].astype(np.int64)
    boxes, scores = arrays['boxes_xyxy'], arrays['scores']
    if offsets[0] != 0 or offsets[-1] != len(boxes):
        raise _ArrayError(f'array frame_offsets goes from {offsets[0]} to {offsets[-1]}, expected '
                          f'0 to {len(boxes)}, the number of boxes')
    _refuse('frame_offsets', 'decreases', np.diff(offsets, prepend=0) < 0)
    _refuse('boxes_xyxy', 'is not left, top, right, bottom',
            (boxes[:, :2] >= boxes[:, 2:]).any(axis=1))
    _refuse('scores', 'is outside 0 to 1', (scores < 0) | (scores > 1))
    _refuse('map_from_camera', 'is no rigid transform', ~_are_rigid(arrays['map_from_camera']))
    if 'odom_from_camera' in arrays:
        poses = arrays['odom_from_camera']
        _refuse('odom_from_camera', 'is no rigid transform',
                ~np.isnan(poses).all(axis=(1, 2)) & ~_are_rigid(poses))


def _are_rigid(poses: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which of some matrices (k, 4, 4) are finite rigid transforms."""
    finite = np.isfinite(poses).all(axis=(1, 2))
    rotations = np.where(finite[:, None, None], poses[:, :3, :3], 0.0)
    errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return np.asarray((errors <= _MAX_ROTATION_ERROR) & (np.linalg.det(rotations) > 0)
                      & (poses[:, 3] == [0, 0, 0, 1]).all(axis=1))


def _refuse(name: str, what: str, is_wrong: NDArray[np.bool_]) -> None:
    if is_wrong.any():
        raise _ArrayError(f'array {name} {what} in row {int(np.argmax(is_wrong))}')


def _make_recorded(arrays: dict[str, NDArray[Any]]) -> Recorded:
    detections = _make_detections(arrays)
    order = np.argsort(detections.stamps_s, kind='stable')
    if (order != np.arange(len(order))).any():
        detections = detections.select_frames(order)
    frames = len(order)
    # a float64 of today's seconds resolves 0.24 us: microseconds are what it still knows
    rounded = np.round(arrays['timestamps'] * 1e6).astype(np.int64) * 1000
    detector_ms, clip_ms = (arrays.get(name, np.full(frames, np.nan)).astype(np.float64)[order]
                            for name in ('detector_ms', 'clip_ms'))
    images, without_pose = arrays.get('image_counts', (frames, 0))
    return Recorded(
        detections, arrays.get('stamps_ns', rounded).astype(np.int64)[order], detector_ms,
        clip_ms, int(images), int(without_pose), str(arrays.get('described', '')))


def _make_detections(arrays: dict[str, NDArray[Any]]) -> PosedDetections:
    width, height = map(int, arrays['image_size'])
    fx, fy, cx, cy = map(float, arrays['intrinsics_fx_fy_cx_cy'])
    names, classes = np.unique(arrays['class_ids'], return_inverse=True)
    return PosedDetections(
        camera=Camera(width, height, fx, fy, cx, cy),
        map_from_camera=arrays['map_from_camera'].astype(np.float64),
        stamps_s=arrays['timestamps'].astype(np.float64),
        frame_offsets=arrays['frame_offsets'].astype(np.int64),
        bboxes_xyxy=arrays['boxes_xyxy'].astype(np.float64),
        class_names=tuple(str(name) for name in names),
        classes=classes.astype(np.int64).reshape(-1),
        scores=arrays['scores'].astype(np.float64),
        depths=arrays.get('depths'), depth_spreads=arrays.get('depth_spreads'),
        embeddings=arrays.get('embeddings'), encoder_key=str(arrays.get('encoder_key', '')),
        odom_from_camera=(arrays['odom_from_camera'].astype(np.float64)
                          if 'odom_from_camera' in arrays else None),
        open_edges=arrays.get('open_edges'))
