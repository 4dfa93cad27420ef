# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer: keyframes with their poses, features and points, and search for similar ones.

Images are compared by the words of their features (Sivic and Zisserman, "Video Google", 2003):
the descriptors of a layer are clustered, each cluster is a word, and two images are as similar as
the numbers of their words. Words that many keyframes have count less.

Its file is ``NAME.keyframes.npz`` next to ``NAME.yaml``. The arrays lie in it uncompressed. Those
of a large file are mapped into memory, not read: a layer costs memory only where it is used, and
may be larger than the memory.
"""

import hashlib
import json
import os
import zipfile
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import are_rigid
from cliploc_ros.core.keyframes.features import ONLY_SIFT, SIFT, FeatureKind, FeatureKinds
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.parameter_file import check_set
from cliploc_ros.errors import CameraError, MapError
from cliploc_ros.files.arrays import FINITE, ArrayError, Arrays, Check, Field, Offsets, Schema
from cliploc_ros.files.storage import parse_json

# Focal lengths, as shares of the image's width, count as equal within this.
_SAME_FOCAL = 0.02
#: Deviations a metre from a keyframe: of points from depth, whose scale and registration are never
#: exact (chosen on the kitchen), and of triangulated ones (a guess on the safe side).
FROM_DEPTH, TRIANGULATED = 0.1, 0.02
#: A pixel of the layer is kept in sixteenths.
PIXEL_SCALE = 16.0
VERSION = 1
_CAMERA = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_HASH_DIGITS = 12
_MOST_DEVIATION = 1.0
# A map whose landmarks of the same name have moved so far in general is another map [m]. An update
# or an edit moves few of them.
_MOST_MOVED_M = 0.25


@dataclass(frozen=True)
class KeyframeLayer:
    """K keyframes with n points in total. The large arrays may lie in a file."""

    frame_id: str  #: Coordinate frame of the poses: the map's
    #: The map's landmarks when the layer was made, which identify the map
    landmark_ids: tuple[str, ...]
    landmark_centers: NDArray[np.float32]  #: (L, 3): where they were [m]
    camera: Camera  #: Camera of the undistorted images; the first of several
    map_from_camera: NDArray[np.float64]  #: (K, 4, 4)
    #: (K + 1,): keyframe k has the points from offsets[k] up to offsets[k + 1]
    offsets: NDArray[np.int64]
    #: (n, 2): where the keyframe shows each point, undistorted [1/16 px]
    pixels: NDArray[np.uint16]
    points: NDArray[np.float32]  #: (n, 3): in the optical coordinate frame of their keyframe [m]
    descriptors: NDArray[np.uint8]  #: (n, d)
    words: NDArray[np.uint16]  #: (n,): word of each descriptor
    vocabulary: NDArray[np.uint8]  #: (W, d): the words' mean descriptors
    #: How far a pose is off that was found from a keyframe a metre away, as a standard deviation
    #: on each axis [m]: the error that its points share
    deviation_per_metre: float = FROM_DEPTH
    #: (b,): small undistorted JPEG images, one after another: for people, no answer needs them
    images: NDArray[np.uint8] | None = None
    #: (K + 1,): keyframe k has the bytes from image_offsets[k] up to image_offsets[k + 1]
    image_offsets: NDArray[np.int64] | None = None
    other_cameras: tuple[Camera, ...] = ()  #: Further cameras of a robot with several cameras
    #: (K,): which camera took each keyframe, 0 for the first one; None: the first one took all
    camera_rows: NDArray[np.int64] | None = None
    kind: FeatureKind = SIFT  #: Kind of the descriptors
    set_digest: str = ''  #: Digest of the map that it was written with; '' if it is unknown

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.map_from_camera)

    def select(self, chosen: NDArray[np.bool_]) -> 'KeyframeLayer':
        """Return the keyframes of a mask (K,), without their small images."""
        counts = np.diff(self.offsets)
        rows = np.repeat(chosen, counts)
        return replace(
            self, map_from_camera=self.map_from_camera[chosen],
            offsets=np.cumsum([0, *counts[chosen]]), images=None, image_offsets=None,
            camera_rows=None if self.camera_rows is None else self.camera_rows[chosen],
            **{name: getattr(self, name)[rows] for name in ('pixels', 'points', 'descriptors',
                                                            'words')})

    def prepare(self) -> None:
        """Compute the indices now, so that the first request does not wait for them."""
        _ = self._profiles, self._unit_vocabulary

    def camera_of(self, keyframe: int) -> Camera:
        """Return the camera that took a keyframe."""
        row = 0 if self.camera_rows is None else int(self.camera_rows[keyframe])
        return (self.camera, *self.other_cameras)[row]

    def camera_note(self, camera: Camera) -> str:
        """Return how a camera differs from those of the keyframes; empty if one is like it."""
        theirs, own = np.array([camera.fx, camera.fy]) / camera.width, self.camera
        for one in (own, *self.other_cameras):
            ours = np.array([one.fx, one.fy]) / one.width
            if np.abs(theirs / ours - 1.0).max() <= _SAME_FOCAL:
                return ''
        return (f'the camera differs from that of the keyframes: fx {camera.fx:.1f} of '
                f'{camera.width} px, theirs {own.fx:.1f} of {own.width} px; is camera_info right?')

    def rows(self, keyframe: int) -> slice:
        """Return where the points of a keyframe are."""
        return slice(int(self.offsets[keyframe]), int(self.offsets[keyframe + 1]))

    def image_rgb(self, keyframe: int) -> NDArray[np.uint8] | None:
        """Return the small image (h, w, 3) of a keyframe; None without a sound one."""
        if self.images is None or self.image_offsets is None:
            return None
        content = np.asarray(self.images[slice(*self.image_offsets[keyframe:keyframe + 2])])
        image = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
        return None if image is None else np.asarray(image[..., ::-1], dtype=np.uint8)

    def points_in_map(self, keyframe: int) -> NDArray[np.float64]:
        """Return the points (m, 3) of a keyframe in the map [m]."""
        pose = self.map_from_camera[keyframe]
        points = np.asarray(self.points[self.rows(keyframe)], dtype=np.float64)
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    def unit_descriptors(self, keyframe: int) -> NDArray[np.float32]:
        """Return the descriptors (m, d) of a keyframe as unit vectors."""
        return self.kind.units(np.asarray(self.descriptors[self.rows(keyframe)]))

    def similarities(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return how similar each keyframe (K,) is to an image.

        Parameters
        ----------
        descriptors : ndarray (n, d)
            Unit vectors of the image.
        """
        profiles, weights = self._profiles
        counts = np.bincount(nearest_words(descriptors, self._unit_vocabulary),
                             minlength=len(self.vocabulary))
        return np.asarray(profiles @ (np.sqrt(counts) * weights).astype(np.float32))

    @cached_property
    def _unit_vocabulary(self) -> NDArray[np.float32]:
        return self.kind.units(self.vocabulary)

    @cached_property
    def _profiles(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the weighted words (K, W) of each keyframe, unit rows, and the weights (W,)."""
        size = len(self.vocabulary)
        profiles = np.zeros((len(self), size), dtype=np.float32)
        for row in range(len(self)):
            words = np.asarray(self.words[self.rows(row)], dtype=np.int64)
            profiles[row] = np.sqrt(np.bincount(words, minlength=size)[:size])
        # one keyframe more than there are, so that a single one has weights
        weights = np.log((len(self) + 1.0) / np.maximum(1, (profiles > 0).sum(axis=0)))
        profiles *= weights.astype(np.float32)
        profiles /= np.maximum(np.linalg.norm(profiles, axis=1, keepdims=True), 1e-9)
        return profiles, weights


def nearest_words(descriptors: NDArray[np.float32], vocabulary: NDArray[np.float32]
                  ) -> NDArray[np.int64]:
    """Return the most similar word (n,) of each descriptor; both are unit vectors."""
    found = [np.argmax(part @ vocabulary.T, axis=1) for part in np.array_split(
        descriptors.reshape(-1, vocabulary.shape[1]), 1 + len(descriptors) // 4096)]
    return np.concatenate(found)


def _check_words(name: str, arrays: Arrays) -> None:
    if (arrays[name] >= len(arrays['vocabulary'])).any():
        raise ArrayError(f'array {name} names a word that the vocabulary lacks')


# K keyframes, n points, L landmarks, W words, b bytes.
_SCHEMA = Schema('file of keyframes', {
    'header': Field('text'),
    'landmark_ids': Field('text', ('L',)),
    'landmark_centers': Field('float32', ('L', 3), (FINITE,)),
    'map_from_camera': Field('float64', ('K', 4, 4), (
        FINITE, Check('is not a rigid transform', lambda poses: ~are_rigid(poses)))),
    'offsets': Field('int64', ('K+1',), (Offsets('descriptors', 'points'),)),
    'pixels': Field('uint16', ('n', 2), stays=True),
    'points': Field('float32', ('n', 3), (FINITE,), stays=True),
    'descriptors': Field('uint8', ('n', 'd'), stays=True),
    'words': Field('uint16', ('n',), (_check_words,)),
    'vocabulary': Field('uint8', ('W', 'd')),
    # both are missing unless images were requested
    'images': Field('uint8', ('b',), is_optional=True, stays=True),
    'image_offsets': Field('int64', ('K+1',), (Offsets('images', 'bytes'),), is_optional=True),
    # missing for a single camera; the header holds the cameras
    'camera_rows': Field('int64', ('K',), is_optional=True),
}, MapError, 'make the layer again with build_map --keyframe-layer, or remove the file',
    {'K': 'keyframes', 'W': 'keyframes'}, is_stored=True,
    largest_read=256_000_000)


def layer_path(map_path: str | os.PathLike[str]) -> Path:
    """Return the file of a map's keyframes: NAME.keyframes.npz next to NAME.yaml."""
    return Path(map_path).with_suffix('.keyframes.npz')


def removed_layer(map_path: str | os.PathLike[str]) -> str:
    """Return a message for the user: the layer of a replaced map was removed."""
    return f'removed {layer_path(map_path)}: its keyframes belonged to the map before'


def save_layer(path: Path, layer: KeyframeLayer) -> None:
    """Write a layer in one step: an existing file is replaced complete, or stays.

    MapError: the file cannot be written.
    """
    header = {'version': VERSION, 'descriptors': layer.kind.name, 'frame_id': layer.frame_id,
              'deviation_per_metre': layer.deviation_per_metre,
              'camera': _numbers_of(layer.camera)}
    if layer.set_digest:
        header['set'] = layer.set_digest
    if layer.other_cameras:
        header['other_cameras'] = list(map(_numbers_of, layer.other_cameras))
    names = [name for name in _SCHEMA.fields
             if name != 'header' and getattr(layer, name) is not None]
    arrays: dict[str, NDArray[Any]] = {'header': np.array(json.dumps(header))} | {
        name: np.asarray(getattr(layer, name)) for name in names}
    _SCHEMA.write(path, {
        name: array.astype(np.str_) if _SCHEMA.fields[name].type == 'text'
        else array.astype(_SCHEMA.fields[name].type, copy=False)
        for name, array in arrays.items()})


def _numbers_of(camera: Camera) -> dict[str, float]:
    return {name: getattr(camera, name) for name in _CAMERA}


def load_layer_of_map(path: Path, landmark_map: LandmarkMap, kinds: FeatureKinds = ONLY_SIFT
                      ) -> KeyframeLayer:
    """Read the layer of a map, and make the kind of its features.

    MapError: the file is invalid or belongs to another map; says what to do. Other CliplocErrors:
    from the kind.
    """
    arrays = _SCHEMA.read(path)
    try:
        layer = _layer_of(arrays, kinds)
        _check_map(layer, landmark_map)
    except ArrayError as error:
        raise _SCHEMA.invalid(path, error) from error
    return layer


def layer_hash(path: Path) -> str:
    """Return a digest of a layer, by the names, sizes and checksums of its arrays.

    It reads the table of contents only: a layer may be larger than the memory.
    """
    with zipfile.ZipFile(path) as archive:
        content = [(one.filename, one.file_size, one.CRC) for one in archive.infolist()]
    return hashlib.sha256(repr(content).encode()).hexdigest()[:_HASH_DIGITS]


def _layer_of(arrays: dict[str, NDArray[Any]], kinds: FeatureKinds) -> KeyframeLayer:
    if ('images' in arrays) != ('image_offsets' in arrays):
        raise ArrayError('array images or image_offsets is missing')
    try:
        header = parse_json(str(arrays.pop('header')))
        version, name = header.get('version'), str(header.get('descriptors'))
    except (AttributeError, ValueError) as error:
        raise ArrayError(f'its header is not a JSON object ({error})') from error
    if version != VERSION:
        raise ArrayError(f'is of version {version!r}, expected {VERSION}')
    if name not in kinds:
        raise ArrayError(f'has descriptors of the kind {name!r}, expected {" or ".join(kinds)}')
    try:
        camera, *others = (Camera(*(one[name] for name in _CAMERA))
                           for one in (header['camera'], *header.get('other_cameras', ())))
        deviation = float(header['deviation_per_metre'])
    except (CameraError, KeyError, TypeError, ValueError) as error:
        raise ArrayError(f'has no valid camera or deviation in its header ({error})') from error
    if not 0.0 <= deviation <= _MOST_DEVIATION:
        raise ArrayError(f'deviation_per_metre is {deviation}, expected 0 to {_MOST_DEVIATION}')
    rows = arrays.get('camera_rows', np.zeros(1, dtype=np.int64))
    if not ((rows >= 0) & (rows <= len(others))).all():
        raise ArrayError(f'array camera_rows names none of the {1 + len(others)} cameras')
    kind, dimensions = kinds[name](), arrays['descriptors'].shape[1]
    if dimensions != kind.dimensions:
        raise ArrayError(f'has descriptors of {dimensions} numbers, but those of the kind {name} '
                         f'have {kind.dimensions}')
    return KeyframeLayer(str(header.get('frame_id', '')),
                         tuple(map(str, arrays.pop('landmark_ids'))),
                         arrays.pop('landmark_centers'), camera, **arrays,
                         deviation_per_metre=deviation, other_cameras=tuple(others), kind=kind,
                         set_digest=str(header.get('set', '')))


def _check_map(layer: KeyframeLayer, landmark_map: LandmarkMap) -> None:
    """Refuse the layer of another map. Landmarks may be new, gone or moved, but not in general."""
    try:
        check_set(layer.set_digest, landmark_map.map_set.family)
    except ValueError as error:
        raise ArrayError(str(error)) from error
    if layer.frame_id != landmark_map.frame_id:
        raise ArrayError(f"is of a map in frame '{layer.frame_id}', not "
                          f"'{landmark_map.frame_id}'")
    is_of_set = layer.set_digest != '' and layer.set_digest == landmark_map.map_set.family
    if not layer.landmark_ids and (is_of_set or not landmark_map.landmark_ids):
        return  # made of keyframes alone; landmarks may be new
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
