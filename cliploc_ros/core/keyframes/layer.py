# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframe layer: keyframes with poses, features and points, and search for similar keyframes.

Images are compared by the visual words of their features (Sivic and Zisserman, "Video Google",
2003): the descriptors of a layer are clustered, each cluster is a word, and the similarity of two
images is that of their word histograms. Words that occur in many keyframes have less weight.

The file is ``NAME.keyframes.npz`` next to ``NAME.yaml``. Its arrays are read completely.
"""

import hashlib
import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import are_rigid, shifted
from cliploc_ros.core.keyframes.features import ONLY_SIFT, SIFT, FeatureKind, FeatureKinds
from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.parameter_file import check_set
from cliploc_ros.errors import CameraError, MapError
from cliploc_ros.files.arrays import FINITE, ArrayError, Arrays, Check, Field, Offsets, Schema
from cliploc_ros.files.storage import parse_json

# Relative tolerance within which focal lengths, divided by the image width, are equal.
_SAME_FOCAL = 0.02
#: Position deviation per metre of distance from a keyframe: with points from depth images, whose
#: scale and registration are never exact (chosen on the kitchen), and with triangulated points (a
#: conservative guess).
FROM_DEPTH, TRIANGULATED = 0.1, 0.02
#: Pixel coordinates of the layer are stored in sixteenths.
PIXEL_SCALE = 16.0
VERSION = 1
_CAMERA = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_HASH_DIGITS = 12
_MOST_DEVIATION = 1.0
# If landmarks of the same name have moved farther than this (median), the layer belongs to another
# map [m]. An update or an edit moves few landmarks.
_MOST_MOVED_M = 0.25


@dataclass(frozen=True)
class KeyframeLayer:
    """K keyframes with n points in total."""

    frame_id: str  #: Coordinate frame of the poses: the map's
    #: Landmarks of the map when the layer was made; they identify the map
    landmark_ids: tuple[str, ...]
    landmark_centers: NDArray[np.float32]  #: (L, 3): their centres at that time [m]
    cameras: tuple[Camera, ...]  #: Cameras of the undistorted images
    map_from_camera: NDArray[np.float64]  #: (K, 4, 4)
    #: (K + 1,): keyframe k has the points [offsets[k], offsets[k + 1])
    offsets: NDArray[np.int64]
    #: (n, 2): position of each point in the undistorted image of its keyframe [1/16 px]
    pixels: NDArray[np.uint16]
    points: NDArray[np.float32]  #: (n, 3): in the optical coordinate frame of their keyframe [m]
    descriptors: NDArray[np.uint8]  #: (n, d)
    words: NDArray[np.uint16]  #: (n,): visual word of each descriptor
    vocabulary: NDArray[np.uint8]  #: (W, d): mean descriptor of each word
    #: Standard deviation on each axis of a pose found from a keyframe one metre away [m], due to
    #: the common error of the keyframe's points
    deviation_per_metre: float = FROM_DEPTH
    #: (b,): small undistorted JPEG images, concatenated: for display only
    images: NDArray[np.uint8] | None = None
    #: (K + 1,): keyframe k has the bytes [image_offsets[k], image_offsets[k + 1])
    image_offsets: NDArray[np.int64] | None = None
    #: (K,): camera of each keyframe, 0 for the first; None: the first camera took all keyframes
    camera_rows: NDArray[np.int64] | None = None
    kind: FeatureKind = SIFT  #: Kind of the descriptors
    set_digest: str = ''  #: Digest of the map that the layer was written with; '' if unknown
    #: Joined layers of several maps, each with its shift (3,), see MapPart. Poses, cameras and
    #: deviation are then those of all keyframes, and everything else is only in the parts.
    parts: tuple[tuple['KeyframeLayer', NDArray[np.float64]], ...] = ()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.map_from_camera)

    def select(self, chosen: NDArray[np.bool_]) -> 'KeyframeLayer':
        """Return a layer of the keyframes that a mask (K,) selects, without their small images."""
        counts = np.diff(self.offsets)
        rows = np.repeat(chosen, counts)
        return replace(
            self, map_from_camera=self.map_from_camera[chosen],
            offsets=np.cumsum([0, *counts[chosen]]), images=None, image_offsets=None,
            camera_rows=None if self.camera_rows is None else self.camera_rows[chosen],
            **{name: getattr(self, name)[rows] for name in ('pixels', 'points', 'descriptors',
                                                            'words')})

    def prepare(self) -> None:
        """Compute the indices in advance, so that the first request does not wait for them."""
        _ = self.parts or (self._profiles, self._unit_vocabulary)

    def camera_of(self, keyframe: int) -> Camera:
        """Return the camera that took a keyframe."""
        return self.cameras[0 if self.camera_rows is None else int(self.camera_rows[keyframe])]

    def camera_note(self, camera: Camera) -> str:
        """Return a warning if a camera differs from all cameras of the keyframes; empty if not."""
        theirs, *ours = (np.array([each.fx, each.fy]) / each.width
                         for each in (camera, *self.cameras))
        own = self.cameras[0]
        if np.abs(theirs / np.array(ours) - 1.0).max(axis=1).min() <= _SAME_FOCAL:
            return ''
        return (f'the camera differs from that of the keyframes: fx {camera.fx:.1f} at width '
                f'{camera.width} px, theirs {own.fx:.1f} at {own.width} px; check camera_info')

    def rows(self, keyframe: int) -> slice:
        """Return the slice of the points of a keyframe."""
        return slice(int(self.offsets[keyframe]), int(self.offsets[keyframe + 1]))

    def image_rgb(self, keyframe: int) -> NDArray[np.uint8] | None:
        """Return the small image (h, w, 3) of a keyframe; None if it is missing or damaged."""
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
        """Return the similarity (K,) of each keyframe to an image.

        Parameters
        ----------
        descriptors : ndarray (n, d)
            Descriptors of the image as unit vectors.
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
        """Return the weighted word histograms (K, W) as unit rows, and the weights (W,)."""
        size = len(self.vocabulary)
        profiles = np.zeros((len(self), size), dtype=np.float32)
        for row in range(len(self)):
            words = np.asarray(self.words[self.rows(row)], dtype=np.int64)
            profiles[row] = np.sqrt(np.bincount(words, minlength=size)[:size])
        # + 1, so that the weights of a layer with a single keyframe are not zero
        weights = np.log((len(self) + 1.0) / np.maximum(1, (profiles > 0).sum(axis=0)))
        profiles *= weights.astype(np.float32)
        profiles /= np.maximum(np.linalg.norm(profiles, axis=1, keepdims=True), 1e-9)
        return profiles, weights


def nearest_words(descriptors: NDArray[np.float32], vocabulary: NDArray[np.float32]
                  ) -> NDArray[np.int64]:
    """Return the index (n,) of the most similar word of each descriptor; both are unit vectors."""
    found = [np.argmax(part @ vocabulary.T, axis=1) for part in np.array_split(
        descriptors.reshape(-1, vocabulary.shape[1]), 1 + len(descriptors) // 4096)]
    return np.concatenate(found)


def _check_words(name: str, arrays: Arrays) -> None:
    if (arrays[name] >= len(arrays['vocabulary'])).any():
        raise ArrayError(f'array {name} contains a word that the vocabulary lacks')


# K keyframes, n points, L landmarks, W words, b bytes.
_SCHEMA = Schema('file of keyframes', {
    'header': Field('text'),
    'landmark_ids': Field('text', ('L',)),
    'landmark_centers': Field('float32', ('L', 3), (FINITE,)),
    'map_from_camera': Field('float64', ('K', 4, 4), (
        FINITE, Check('is not a rigid transform', lambda poses: ~are_rigid(poses)))),
    'offsets': Field('int64', ('K+1',), (Offsets('descriptors', 'points'),)),
    'pixels': Field('uint16', ('n', 2)),
    'points': Field('float32', ('n', 3), (FINITE,)),
    'descriptors': Field('uint8', ('n', 'd')),
    'words': Field('uint16', ('n',), (_check_words,)),
    'vocabulary': Field('uint8', ('W', 'd')),
    # both missing unless images were requested
    'images': Field('uint8', ('b',), is_optional=True),
    'image_offsets': Field('int64', ('K+1',), (Offsets('images', 'bytes'),), is_optional=True),
    # missing if there is a single camera; the header contains the cameras
    'camera_rows': Field('int64', ('K',), is_optional=True),
}, MapError, 'make the layer again with build_map --keyframe-layer, or remove the file',
    {'K': 'keyframes', 'W': 'keyframes'})


def layer_path(map_path: str | os.PathLike[str]) -> Path:
    """Return the path of a map's keyframe layer: NAME.keyframes.npz next to NAME.yaml."""
    return Path(map_path).with_suffix('.keyframes.npz')


def removed_layer(map_path: str | os.PathLike[str]) -> str:
    """Return a message for the user: the layer of a replaced map was removed."""
    return f'removed {layer_path(map_path)}: its keyframes belonged to the replaced map'


def save_layer(path: Path, layer: KeyframeLayer) -> None:
    """Write a layer atomically.

    Raises MapError if the file cannot be written.
    """
    first, *others = ({name: getattr(camera, name) for name in _CAMERA}
                      for camera in layer.cameras)
    header = {'version': VERSION, 'descriptors': layer.kind.name, 'frame_id': layer.frame_id,
              'deviation_per_metre': layer.deviation_per_metre, 'camera': first,
              'other_cameras': others, 'set': layer.set_digest}
    _SCHEMA.write(path, {'header': np.array(json.dumps(header))} | {
        name: np.asarray(getattr(layer, name), np.str_ if entry.type == 'text' else entry.type)
        for name, entry in _SCHEMA.fields.items()
        if name != 'header' and getattr(layer, name) is not None})


def load_layer_of_map(path: Path, landmark_map: LandmarkMap, kinds: FeatureKinds = ONLY_SIFT
                      ) -> KeyframeLayer:
    """Read the keyframe layer of a map, and construct its feature kind.

    Raises MapError if the file is invalid or belongs to another map; the message says what to do.
    The feature kind may raise other CliplocErrors.
    """
    arrays = _SCHEMA.read(path)
    try:
        layer = _layer_of(arrays, kinds)
        _check_map(layer, landmark_map)
    except (ArrayError, ValueError) as error:
        raise _SCHEMA.invalid(path, error) from error
    return layer


def load_layers(paths: Sequence[Path], landmark_map: LandmarkMap, kinds: FeatureKinds = ONLY_SIFT
                ) -> KeyframeLayer:
    """Read the layer of each part of a map, and join them; see load_layer_of_map.

    MapError: a layer is missing or invalid. With the keyframes of some maps only, a place that
    looks the same in another map, such as a staircase, would seem unique.
    """
    parts = parts_of(landmark_map)
    layers = [load_layer_of_map(path, part.landmark_map, kinds)
              for path, part in zip(paths, parts, strict=False)]
    if len(layers) < len(parts) or len({layer.kind.name for layer in layers}) > 1:
        raise MapError(f'{", ".join(map(str, paths))}: {len(parts)} maps need a layer each, of '
                       'the same --keyframe-features, next to the maps')
    shifts = [part.shift for part in parts]
    return layers[0] if len(layers) == 1 else replace(
        layers[0], cameras=sum((layer.cameras for layer in layers), ()),
        map_from_camera=np.concatenate([*map(shifted, (
            layer.map_from_camera for layer in layers), shifts)]),
        deviation_per_metre=max(layer.deviation_per_metre for layer in layers),
        parts=tuple(zip(layers, shifts, strict=True)))


def layer_hash(path: Path) -> str:
    """Return a digest of a layer file, from the names, sizes and checksums of its arrays.

    Only the table of contents is read: a layer may have gigabytes.
    """
    with zipfile.ZipFile(path) as archive:
        content = [(entry.filename, entry.file_size, entry.CRC) for entry in archive.infolist()]
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
        raise ArrayError(f'has version {version!r}, expected {VERSION}')
    if name not in kinds:
        raise ArrayError(f'has descriptors of kind {name!r}, expected {" or ".join(kinds)}')
    try:
        cameras = tuple(Camera(*(numbers[name] for name in _CAMERA))
                        for numbers in (header['camera'], *header.get('other_cameras', ())))
        deviation = float(header['deviation_per_metre'])
    except (CameraError, KeyError, TypeError, ValueError) as error:
        raise ArrayError(f'has no valid camera or deviation in its header ({error})') from error
    if not 0.0 <= deviation <= _MOST_DEVIATION:
        raise ArrayError(f'deviation_per_metre is {deviation}, expected 0 to {_MOST_DEVIATION}')
    rows = arrays.get('camera_rows', np.zeros(1, dtype=np.int64))
    if not ((rows >= 0) & (rows < len(cameras))).all():
        raise ArrayError(f'array camera_rows has an entry outside the {len(cameras)} cameras')
    kind, dimensions = kinds[name](), arrays['descriptors'].shape[1]
    if dimensions != kind.dimensions:
        raise ArrayError(f'has descriptors of {dimensions} dimensions, expected '
                         f'{kind.dimensions} for kind {name}')
    return KeyframeLayer(str(header.get('frame_id', '')),
                         tuple(map(str, arrays.pop('landmark_ids'))),
                         arrays.pop('landmark_centers'), cameras, **arrays, parts=(),
                         deviation_per_metre=deviation, kind=kind,
                         set_digest=str(header.get('set', '')))


def _check_map(layer: KeyframeLayer, landmark_map: LandmarkMap) -> None:
    """Raise ArrayError if the layer is of another map. A few landmarks may have changed."""
    check_set(layer.set_digest, landmark_map.map_set.family)
    if layer.frame_id != landmark_map.frame_id:
        raise ArrayError(f"belongs to a map in frame '{layer.frame_id}', expected "
                         f"'{landmark_map.frame_id}'")
    is_of_set = layer.set_digest != '' and layer.set_digest == landmark_map.map_set.family
    if not layer.landmark_ids and (is_of_set or not landmark_map.landmark_ids):
        return  # the map had keyframes alone; all landmarks may be new
    rows = {name: row for row, name in enumerate(layer.landmark_ids)}
    shared = [(rows[name], row) for row, name in enumerate(landmark_map.landmark_ids)
              if name in rows]
    if not shared:
        raise ArrayError('contains no landmark of the map: it is of another map')
    ours, theirs = np.array(shared).T
    moved = np.linalg.norm(layer.landmark_centers[ours] - landmark_map.centers[theirs], axis=1)
    if not float(np.median(moved)) <= _MOST_MOVED_M:
        raise ArrayError(f'its landmarks are {np.median(moved):.3g} m away from those of the map '
                         '(median): it is of another map')
