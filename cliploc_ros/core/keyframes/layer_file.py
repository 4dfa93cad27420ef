# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file of a layer: ``NAME.keyframes.npz`` next to ``NAME.yaml``.

The arrays lie in the file uncompressed. Those of a large file are mapped into memory, not read: a
layer costs memory only where it is used, and may be larger than the memory.
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
from cliploc_ros.core.geometry.transforms import are_rigid
from cliploc_ros.core.keyframes.features import DIMENSIONS, KIND
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CameraError, MapError
from cliploc_ros.files.arrays import ArrayError, Arrays, Check, Field, Offsets, Schema

VERSION = 1


def _check_words(name: str, arrays: Arrays) -> None:
    if (arrays[name] >= len(arrays['vocabulary'])).any():
        raise ArrayError(f'array {name} names a word that the vocabulary lacks')


# K keyframes, n points, L landmarks, W words, b bytes.
_SCHEMA = Schema('file of keyframes', {
    'header': Field('text'),
    'landmark_ids': Field('text', ('L',)),
    'landmark_centers': Field('float32', ('L', 3)),
    'map_from_camera': Field('float64', ('K', 4, 4), (
        Check('is no rigid transform', lambda poses: ~are_rigid(poses)),)),
    'offsets': Field('int64', ('K+1',), (Offsets('descriptors', 'points'),)),
    'pixels': Field('uint16', ('n', 2), stays=True),
    'points': Field('float32', ('n', 3), stays=True),
    'descriptors': Field('uint8', ('n', DIMENSIONS), stays=True),
    'words': Field('uint16', ('n',), (_check_words,)),
    'vocabulary': Field('uint8', ('W', DIMENSIONS)),
    # only there where images were asked for, both of them
    'images': Field('uint8', ('b',), is_optional=True, stays=True),
    'image_offsets': Field('int64', ('K+1',), (Offsets('images', 'bytes'),), is_optional=True),
}, MapError, 'make the layer again with build_map --keyframe-layer, or remove the file',
    {'K': 'keyframes', 'W': 'keyframes'}, is_stored=True, checks_sums=False,
    largest_read=256_000_000)
_CAMERA = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_HASH_DIGITS = 12
_MOST_DEVIATION = 1.0
# A map whose landmarks of the same name have moved so far in general is another map [m]. An update
# or an edit moves few of them.
_MOST_MOVED_M = 0.25


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
    names = [name for name in _SCHEMA.fields
             if name != 'header' and getattr(layer, name) is not None]
    arrays: dict[str, NDArray[Any]] = {'header': np.array(json.dumps(header))} | {
        name: np.asarray(getattr(layer, name)) for name in names}
    _SCHEMA.write(path, {
        name: array if _SCHEMA.fields[name].type == 'text'
        else array.astype(_SCHEMA.fields[name].type, copy=False)
        for name, array in arrays.items()})


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
    arrays = _SCHEMA.read(path)
    try:
        layer = _layer_of(arrays)
        _check_map(layer, landmark_map)
    except ArrayError as error:
        raise _SCHEMA.invalid(path, error) from error
    return layer


def layer_hash(path: Path) -> str:
    """Return what tells one layer from another: of the names, sizes and checksums of its arrays.

    It reads the table of contents only: a layer may be larger than the memory.
    """
    with zipfile.ZipFile(path) as archive:
        content = [(one.filename, one.file_size, one.CRC) for one in archive.infolist()]
    return hashlib.sha256(repr(content).encode()).hexdigest()[:_HASH_DIGITS]


def _layer_of(arrays: dict[str, NDArray[Any]]) -> KeyframeLayer:
    if ('images' in arrays) != ('image_offsets' in arrays):
        raise ArrayError('array images or image_offsets is missing')
    try:
        header = json.loads(str(arrays.pop('header')))
        version, kind = header.get('version'), header.get('descriptors')
    except (AttributeError, ValueError, RecursionError) as error:
        raise ArrayError(f'its header is no JSON object ({error})') from error
    if version != VERSION:
        raise ArrayError(f'is of version {version!r}, expected {VERSION}')
    if kind != KIND:
        raise ArrayError(f'has descriptors of the kind {kind!r}, expected {KIND!r}')
    try:
        camera = Camera(*(header['camera'][name] for name in _CAMERA))
        deviation = float(header['deviation_per_metre'])
    except (CameraError, KeyError, TypeError, ValueError) as error:
        raise ArrayError(f'has no valid camera or deviation in its header ({error})') from error
    if not 0.0 <= deviation <= _MOST_DEVIATION:
        raise ArrayError(f'deviation_per_metre is {deviation}, expected 0 to {_MOST_DEVIATION}')
    return KeyframeLayer(str(header.get('frame_id', '')),
                         tuple(map(str, arrays.pop('landmark_ids'))),
                         arrays.pop('landmark_centers'), camera, **arrays,
                         deviation_per_metre=deviation)


def _check_map(layer: KeyframeLayer, landmark_map: LandmarkMap) -> None:
    """Refuse the layer of another map. Landmarks may be new, gone or moved, but not in general."""
    if layer.frame_id != landmark_map.frame_id:
        raise ArrayError(f"is of a map in frame '{layer.frame_id}', not "
                          f"'{landmark_map.frame_id}'")
    rows = {name: row for row, name in enumerate(layer.landmark_ids)}
    shared = [(rows[name], row) for row, name in enumerate(landmark_map.landmark_ids)
              if name in rows]
    if not shared:
        raise ArrayError('knows no landmark of the map: it is of another map')
    ours, theirs = np.array(shared).T
    moved = np.linalg.norm(layer.landmark_centers[ours] - landmark_map.centers[theirs], axis=1)
    if not float(np.median(moved)) <= _MOST_MOVED_M:
        raise ArrayError(f'its landmarks lie {np.median(moved):.3g} m from those of the map '
                          '(median): it is of another map')
