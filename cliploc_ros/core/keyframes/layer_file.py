# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file of a layer: ``NAME.keyframes.npz`` next to ``NAME.yaml``.

The arrays lie in the file uncompressed. Those of a large file are mapped into memory, not read: a
layer costs memory only where it is used, and may be larger than the memory. A small file is read:
a program that writes over a mapped file in place would kill this process.
"""

import hashlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.core.keyframes.features import DIMENSIONS, KIND
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.errors import CameraError, MapError
from cliploc_ros.files.storage import replace_file

VERSION = 1
# Arrays of the file: shape in terms of K keyframes, n points, L landmarks and W words; type.
_LAYOUT: dict[str, tuple[tuple[object, ...], str]] = {
    'landmark_ids': (('L',), 'U'),
    'landmark_centers': (('L', 3), 'float32'),
    'map_from_camera': (('K', 4, 4), 'float64'),
    'offsets': (('K+1',), 'int64'),
    'pixels': (('n', 2), 'uint16'),
    'points': (('n', 3), 'float32'),
    'descriptors': (('n', DIMENSIONS), 'uint8'),
    'words': (('n',), 'uint16'),
    'vocabulary': (('W', DIMENSIONS), 'uint8'),
}
# Only there where images were asked for; b bytes.
_IMAGES: dict[str, tuple[tuple[object, ...], str]] = {
    'images': (('b',), 'uint8'),
    'image_offsets': (('K+1',), 'int64'),
}
_CAMERA = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_MAPPED = ('pixels', 'points', 'descriptors', 'images')
_HEADER_BYTES = 100_000
_HASH_DIGITS = 12
#: Files up to this size are read into memory [bytes].
MOST_READ = 256_000_000
_MOST_DEVIATION = 1.0
# A map whose landmarks of the same name have moved so far in general is another map [m]. An update
# or an edit moves few of them.
_MOST_MOVED_M = 0.25
_MAKE_AGAIN = 'make the layer again with build_map --keyframe-layer, or remove the file'


def layer_path(map_path: str | os.PathLike[str]) -> Path:
    """Return the file of a map's keyframes: NAME.keyframes.npz next to NAME.yaml."""
    return Path(map_path).with_suffix('.keyframes.npz')


def save_layer(path: Path, layer: KeyframeLayer) -> None:
    """Write a layer in one step: an existing file is replaced complete, or stays.

    Raises
    ------
    MapError
        The file cannot be written.
    """
    header = {'version': VERSION, 'descriptors': KIND, 'frame_id': layer.frame_id,
              'deviation_per_metre': layer.deviation_per_metre,
              'camera': {name: getattr(layer.camera, name) for name in _CAMERA}}
    layout = _LAYOUT if layer.images is None else _LAYOUT | _IMAGES
    arrays: dict[str, NDArray[Any]] = {
        name: np.asarray(getattr(layer, name)).astype(kind, copy=False)
        for name, (_, kind) in layout.items()}
    try:
        with replace_file(path) as partial, partial.open('wb') as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise MapError(f'{path}: cannot be written: {error.strerror}; nothing was changed'
                       ) from error


def remove_layer(map_path: str | os.PathLike[str]) -> str:
    """Remove the layer of a map that another one has replaced; return a note, '' without one.

    Raises
    ------
    MapError
        The file cannot be removed.
    """
    path = layer_path(map_path)
    try:
        path.unlink()
    except FileNotFoundError:
        return ''
    except OSError as error:
        raise MapError(f'{path}: belongs to the map before and cannot be removed: '
                       f'{error.strerror}; remove it') from error
    return f'removed {path}: its keyframes belonged to the map before'


def load_layer_of_map(path: Path, landmark_map: LandmarkMap) -> KeyframeLayer:
    """Read the layer of a map.

    Raises
    ------
    MapError
        The file is invalid or belongs to another map; says what to do.
    """
    try:
        layer = _load(path)
        _check_map(layer, landmark_map)
    except _LayerError as error:
        raise MapError(f'{path}: {error}; {_MAKE_AGAIN}') from error
    return layer


def layer_hash(path: Path) -> str:
    """Return what tells one layer from another: of the names, sizes and checksums of its arrays.

    It reads the table of contents only: a layer may be larger than the memory.
    """
    with zipfile.ZipFile(path) as archive:
        content = [(one.filename, one.file_size, one.CRC) for one in archive.infolist()]
    return hashlib.sha256(repr(content).encode()).hexdigest()[:_HASH_DIGITS]


class _LayerError(Exception):
    """What is wrong with a layer; the caller adds the file's name."""


def _load(path: Path) -> KeyframeLayer:
    if not path.is_file():
        raise _LayerError('no such file')
    try:
        with zipfile.ZipFile(path) as archive, path.open('rb') as file:
            header = _read_header(archive)
            layout = _LAYOUT | _IMAGES if 'images.npy' in archive.namelist() else _LAYOUT
            arrays = {name: _read_array(archive, file, path, name) for name in layout}
    except _LayerError:
        raise
    except Exception as error:  # whatever NumPy and zipfile meet in a broken file
        raise _LayerError(f'is no complete layer of keyframes ({error})') from error
    _check_layout(arrays, layout)
    _check_values(arrays)
    try:
        camera = Camera(*(header['camera'][name] for name in _CAMERA))
        deviation = float(header['deviation_per_metre'])
    except (CameraError, KeyError, TypeError, ValueError) as error:
        raise _LayerError(f'has no valid camera or deviation in its header ({error})') from error
    if not 0.0 <= deviation <= _MOST_DEVIATION:
        raise _LayerError(f'deviation_per_metre is {deviation}, expected 0 to {_MOST_DEVIATION}')
    return KeyframeLayer(str(header.get('frame_id', '')),
                         tuple(map(str, arrays.pop('landmark_ids'))),
                         arrays.pop('landmark_centers'), camera, **arrays,
                         deviation_per_metre=deviation)


def _read_header(archive: zipfile.ZipFile) -> dict[str, Any]:
    if archive.getinfo('header.npy').file_size > _HEADER_BYTES:
        raise _LayerError(f'its header is larger than {_HEADER_BYTES} bytes')
    with archive.open('header.npy') as member:
        header = json.loads(str(np.lib.format.read_array(member, allow_pickle=False)))
    if not isinstance(header, dict):
        raise _LayerError('its header is no JSON object')
    if header.get('version') != VERSION:
        raise _LayerError(f"is of version {header.get('version')!r}, expected {VERSION}")
    if header.get('descriptors') != KIND:
        raise _LayerError(f"has descriptors of the kind {header.get('descriptors')!r}, expected "
                          f'{KIND!r}')
    return header


def _read_array(archive: zipfile.ZipFile, file: Any, path: Path, name: str) -> NDArray[Any]:
    """Return an array of the archive; a large one stays in the file."""
    info = archive.getinfo(f'{name}.npy')
    if info.file_size > path.stat().st_size:
        raise _LayerError(f'array {name} claims more bytes than the file has')
    if name not in _MAPPED:
        with archive.open(info) as member:
            return np.asarray(np.lib.format.read_array(member, allow_pickle=False))
    if info.compress_type != zipfile.ZIP_STORED:
        raise _LayerError(f'array {name} is compressed')
    # the local header repeats name and extra fields, whose lengths may differ from the directory's
    file.seek(info.header_offset + 26)
    lengths = np.frombuffer(file.read(4), dtype='<u2')
    file.seek(info.header_offset + 30 + int(lengths.sum()))
    version = np.lib.format.read_magic(file)
    read = (np.lib.format.read_array_header_1_0 if version == (1, 0)
            else np.lib.format.read_array_header_2_0)
    shape, fortran, dtype = read(file)
    if fortran or dtype.hasobject or not np.prod(shape):
        raise _LayerError(f'array {name} has shape {shape} and type {dtype}')
    mapped = np.memmap(path, dtype=dtype, mode='r', offset=file.tell(), shape=shape)
    return mapped if path.stat().st_size > MOST_READ else np.array(mapped)


def _check_layout(arrays: dict[str, NDArray[Any]],
                  layout: dict[str, tuple[tuple[object, ...], str]]) -> None:
    sizes: dict[object, int] = {
        letter: len(np.atleast_1d(arrays[name])) for letter, name in
        (('K', 'map_from_camera'), ('n', 'descriptors'), ('L', 'landmark_ids'),
         ('W', 'vocabulary'))}
    sizes['K+1'] = sizes['K'] + 1
    sizes['b'] = arrays['images'].size if 'images' in layout else 0
    for name, (letters, kind) in layout.items():
        array, shape = arrays[name], tuple(sizes.get(one, one) for one in letters)
        if array.shape != shape:
            raise _LayerError(f'array {name} has shape {array.shape}, expected {shape}')
        if (array.dtype.kind != 'U') if kind == 'U' else (array.dtype != kind):
            raise _LayerError(f'array {name} has type {array.dtype}, expected {kind}')
    if not sizes['K'] or not sizes['W']:
        raise _LayerError('has no keyframes')


def _check_values(arrays: dict[str, NDArray[Any]]) -> None:
    for name, counted, what in (('offsets', 'descriptors', 'points'),
                                ('image_offsets', 'images', 'bytes')):
        offsets = arrays.get(name)
        if offsets is not None and (offsets[0] != 0 or offsets[-1] != len(arrays[counted])
                                    or (np.diff(offsets) < 0).any()):
            raise _LayerError(f'array {name} does not count the {what} of the keyframes')
    for row, pose in enumerate(arrays['map_from_camera']):
        if not is_rigid(pose, tolerance=1e-3):
            raise _LayerError(f'array map_from_camera has no rigid transform in row {row}')
    if (arrays['words'] >= len(arrays['vocabulary'])).any():
        raise _LayerError('array words names a word that the vocabulary lacks')


def _check_map(layer: KeyframeLayer, landmark_map: LandmarkMap) -> None:
    """Refuse the layer of another map. Landmarks may be new, gone or moved, but not in general."""
    if layer.frame_id != landmark_map.frame_id:
        raise _LayerError(f"is of a map in frame '{layer.frame_id}', not "
                          f"'{landmark_map.frame_id}'")
    rows = {name: row for row, name in enumerate(layer.landmark_ids)}
    shared = [(rows[name], row) for row, name in enumerate(landmark_map.landmark_ids)
              if name in rows]
    if not shared:
        raise _LayerError('knows no landmark of the map: it is of another map')
    ours, theirs = np.array(shared).T
    moved = np.linalg.norm(layer.landmark_centers[ours] - landmark_map.centers[theirs], axis=1)
    if not float(np.median(moved)) <= _MOST_MOVED_M:
        raise _LayerError(f'its landmarks lie {np.median(moved):.3g} m from those of the map '
                          '(median): it is of another map')
