# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframe layer: keyframes with poses, features and points, and search for similar keyframes.

Images are compared by the visual words of their features (Sivic and Zisserman, "Video Google",
2003): the descriptors of a layer are clustered, each cluster is a word, and the similarity of two
images is that of their word histograms. Words that occur in many keyframes have less weight. The
words of a large layer have two levels (Nister and Stewenius, "Scalable recognition with a
vocabulary tree", 2006), and its descriptors are compressed: to the word and a product-quantized
residual (Jegou et al., "Product quantization for nearest neighbor search", 2011).

The file is ``NAME.keyframes.npz`` next to ``NAME.yaml``. Large arrays of points stay in it.
"""

import hashlib
import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import are_rigid, make_transform
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
#: Words of a small layer; the words of a larger one are a multiple, in as many groups. 1,024 words
#: find the keyframes of the kitchen as well as comparing all descriptors.
WORDS = 1024
#: Version 1 has one deviation_per_metre, in its header, and neither sources nor compression.
VERSION = 2
_CAMERA = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_HASH_DIGITS = 12
_MOST_DEVIATION = 1.0
# If landmarks of the same name have moved farther than this (median), the layer belongs to another
# map [m]. An update or an edit moves few landmarks.
_MOST_MOVED_M = 0.25
_OF_POINTS = ('pixels', 'points', 'descriptors', 'words')
_OF_KEYFRAMES = ('map_from_camera', 'camera_rows', 'source_rows', 'deviation_per_metre')


class Source(NamedTuple):
    """A recording that keyframes are from."""

    name: str
    date: str = ''  #: As text, such as '2026-11-29'; '' if unknown


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
    #: (n, 3): in the optical coordinate frame of their keyframe [m]; float16 in a compressed layer
    points: NDArray[np.floating]
    descriptors: NDArray[np.uint8]  #: (n, d); (n, c) codes in a compressed layer
    words: NDArray[np.uint16]  #: (n,): visual word of each descriptor
    vocabulary: NDArray[np.uint8]  #: (W, d): mean descriptor of each word
    #: (K,), or one for all: standard deviation on each axis of a pose found from a keyframe one
    #: metre away [m], due to the common error of the keyframe's points
    deviation_per_metre: NDArray[np.float64] | float = FROM_DEPTH
    #: (b,): small undistorted JPEG images, concatenated: for display only
    images: NDArray[np.uint8] | None = None
    #: (K + 1,): keyframe k has the bytes [image_offsets[k], image_offsets[k + 1])
    image_offsets: NDArray[np.int64] | None = None
    #: (K,): camera of each keyframe, 0 for the first; None: the first camera took all keyframes
    camera_rows: NDArray[np.int64] | None = None
    kind: FeatureKind = SIFT  #: Kind of the descriptors
    set_digest: str = ''  #: Digest of the map that the layer was written with; '' if unknown
    #: (c, 256, d / c): what each code adds to the mean of the word; None: not compressed
    codebook: NDArray[np.int16] | None = None
    sources: tuple[Source, ...] = ()  #: Recordings of the keyframes; empty if unknown
    #: (K,): source of each keyframe; None: all are from the first one
    source_rows: NDArray[np.int64] | None = None
    #: (K,): in a view, keyframe k has the points [offsets[k], ends[k])
    ends: NDArray[np.int64] | None = None
    #: Layers of several maps, in the frame of the joined map. Poses, cameras and deviations are
    #: then those of all keyframes, and everything else is only in the parts.
    parts: tuple['KeyframeLayer', ...] = ()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.map_from_camera)

    def select(self, chosen: NDArray[np.bool_], points: NDArray[np.bool_] | None = None
               ) -> 'KeyframeLayer':
        """Return a layer of the keyframes that a mask (K,) selects, without their small images.

        A mask of points (n,) leaves out others.
        """
        parts = [np.arange(rows.start, rows.stop) for rows in map(
            self.rows, np.nonzero(chosen)[0].tolist())]
        if points is not None:
            parts = [part[points[part]] for part in parts]
        rows = np.concatenate([np.empty(0, dtype=np.int64), *parts])
        return replace(self.view(chosen), offsets=np.cumsum([0, *map(len, parts)]), ends=None, **{
            name: getattr(self, name)[rows] for name in _OF_POINTS})

    def view(self, chosen: NDArray[np.bool_]) -> 'KeyframeLayer':
        """Like select, but the layers share the arrays of points; a view cannot be written."""
        ends = self.offsets[1:] if self.ends is None else self.ends
        columns: dict[str, Any] = {name: array[chosen] for name in _OF_KEYFRAMES if isinstance(
            array := getattr(self, name), np.ndarray)}
        return replace(self, offsets=self.offsets[:len(self)][chosen], ends=ends[chosen],
                       images=None, image_offsets=None, **columns)

    def plain(self) -> 'KeyframeLayer':
        """Return the layer without compression and no view, to join or to change it."""
        if self.ends is not None:
            return self.select(np.ones(len(self), dtype=np.bool_)).plain()
        descriptors = [self.descriptors_of(self.rows(keyframe)) for keyframe in range(len(self))]
        return replace(self, points=np.asarray(self.points, np.float32), codebook=None,
                       descriptors=np.concatenate(descriptors))

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

    def recorded(self, keyframe: int) -> str:
        """Return recording and date of a keyframe; '' if all are of one recording."""
        row = 0 if self.source_rows is None else int(self.source_rows[keyframe])
        return ' '.join(self.sources[row]).strip() if len(self.sources) > 1 else ''

    def rows(self, keyframe: int) -> slice:
        """Return the slice of the points of a keyframe."""
        ends = self.offsets[1:] if self.ends is None else self.ends
        return slice(int(self.offsets[keyframe]), int(ends[keyframe]))

    def deviations(self, keyframes: Any = slice(None)) -> NDArray[np.float64]:
        """Return the deviation_per_metre (k,) of keyframes, by default of all."""
        return np.broadcast_to(self.deviation_per_metre, len(self))[keyframes]

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
        return self.kind.units(self.descriptors_of(self.rows(keyframe)))

    def descriptors_of(self, rows: Any) -> NDArray[np.uint8]:
        """Return the descriptors (m, d) of points, given as a slice or an array."""
        codes = self.descriptors[rows]
        if self.codebook is None:
            return codes
        added = self.codebook[np.arange(codes.shape[1]), codes].reshape(len(codes), -1)
        return np.clip(self.vocabulary[self.words[rows]] + added, 0, 255).astype(np.uint8)

    def similarities(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the similarity (K,) of each keyframe to an image.

        Parameters
        ----------
        descriptors : ndarray (n, d)
            Descriptors of the image as unit vectors.
        """
        profiles, weights = self._profiles
        found, counts = np.unique(nearest_words(descriptors, self._unit_vocabulary),
                                  return_counts=True)
        return np.asarray(profiles[:, found] @ (np.sqrt(counts) * weights[found]).astype(
            np.float32))

    @cached_property
    def _unit_vocabulary(self) -> NDArray[np.float32]:
        return self.kind.units(self.vocabulary)

    @cached_property
    def _profiles(self) -> tuple[csc_array, NDArray[np.float64]]:
        """Return the weighted word histograms (K, W) as unit rows, and the weights (W,).

        They are stored by word, so that a request reads those of its words only.
        """
        words = [self.words[self.rows(row)] for row in range(len(self))]
        starts = np.cumsum([0, *map(len, words)])
        profiles = csr_array((np.ones(starts[-1], np.float32), np.concatenate(words), starts),
                             (len(self), len(self.vocabulary)))
        profiles.sum_duplicates()
        # + 1, so that the weights of a layer with a single keyframe are not zero
        weights = np.log((len(self) + 1.0) / np.maximum(1, np.bincount(
            profiles.indices, minlength=len(self.vocabulary))))
        profiles.data = np.sqrt(profiles.data) * weights.astype(np.float32)[profiles.indices]
        norms = np.sqrt(profiles.multiply(profiles).sum(axis=1))
        profiles.data /= np.repeat(np.maximum(norms, 1e-9), np.diff(profiles.indptr))
        return profiles.tocsc(), weights


def nearest_words(descriptors: NDArray[np.float32], vocabulary: NDArray[np.float32]
                  ) -> NDArray[np.int64]:
    """Return the word (n,) with the greatest product with each descriptor; both are unit vectors.

    Of more than WORDS words, those of the group with the most similar mean are compared.
    """
    groups = vocabulary.reshape(min(WORDS, len(vocabulary)), -1, vocabulary.shape[1])
    means, found = groups.sum(axis=1), []
    if groups.shape[1] > 1:
        means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)
    for part in np.array_split(descriptors.reshape(-1, vocabulary.shape[1]),
                               1 + len(descriptors) // 4096):
        nearest = np.argmax(part @ means.T, axis=1)
        found.append(groups.shape[1] * nearest + np.argmax(
            (groups[nearest] @ part[:, :, None])[..., 0], axis=1))
    return np.concatenate(found)


def _check_words(name: str, arrays: Arrays) -> None:
    count = len(arrays['vocabulary'])
    if (arrays[name] >= count).any() or count % min(count, WORDS):
        raise ArrayError(f'array {name} does not fit the vocabulary of {count} words')


# K keyframes, n points, L landmarks, W words, b bytes, c codes.
_SCHEMA = Schema('file of keyframes', {
    'header': Field('text'),
    'landmark_ids': Field('text', ('L',)),
    'landmark_centers': Field('float32', ('L', 3), (FINITE,)),
    'map_from_camera': Field('float64', ('K', 4, 4), (
        FINITE, Check('is not a rigid transform', lambda poses: ~are_rigid(poses)))),
    'offsets': Field('int64', ('K+1',), (Offsets('descriptors', 'points'),)),
    'pixels': Field('uint16', ('n', 2), is_stored=True),
    'points': Field('floats', ('n', 3), (FINITE,), is_stored=True),
    'descriptors': Field('uint8', ('n', 'c'), is_stored=True),
    'words': Field('uint16', ('n',), (_check_words,)),
    'vocabulary': Field('uint8', ('W', 'd')),
    'codebook': Field('int16', ('c', 256, 's'), is_optional=True),  # if they are compressed
    # missing in version 1
    'deviation_per_metre': Field('float64', ('K',), is_optional=True),
    'source_rows': Field('int64', ('K',), is_optional=True),  # missing if there is one source
    # both missing unless images were requested
    'images': Field('uint8', ('b',), is_optional=True, is_stored=True),
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
              'sources': layer.sources, 'camera': first, 'other_cameras': others,
              'set': layer.set_digest}
    layer = replace(layer, deviation_per_metre=layer.deviations())
    _SCHEMA.write(path, {'header': np.array(json.dumps(header))} | {
        name: np.asarray(getattr(layer, name), {'text': np.str_, 'floats': None}.get(
            entry.type, entry.type)) for name, entry in _SCHEMA.fields.items()
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

    MapError: a layer is missing, invalid or of another kind. With the keyframes of some maps only,
    a place that looks the same in another map, such as a staircase, would seem unique.
    """
    parts = parts_of(landmark_map)
    layers = [load_layer_of_map(path, part.landmark_map, kinds) for path, part in zip(
        paths, parts, strict=False) if len(parts) == 1 or path.exists()]
    if len(layers) < len(parts) or len({layer.kind.name for layer in layers}) > 1:
        lacking = [str(path) for path in paths if not path.exists()]
        raise MapError(f'{", ".join(lacking) or paths[0]}: several maps need a layer each, of the '
                       'same --keyframe-features, next to the maps: build them with build_map')
    layers = [replace(layer, map_from_camera=make_transform(np.eye(3), part.shift)
                      @ layer.map_from_camera) for layer, part in zip(layers, parts, strict=True)]
    return layers[0] if len(layers) == 1 else replace(
        layers[0], cameras=sum((layer.cameras for layer in layers), ()),
        map_from_camera=np.concatenate([layer.map_from_camera for layer in layers]),
        deviation_per_metre=np.concatenate([layer.deviations() for layer in layers]),
        parts=tuple(layers))


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
    if version not in (1, VERSION):
        raise ArrayError(f'has version {version!r}, expected up to {VERSION}')
    if name not in kinds:
        raise ArrayError(f'has descriptors of kind {name!r}, expected {" or ".join(kinds)}')
    try:
        cameras = tuple(Camera(*(numbers[name] for name in _CAMERA))
                        for numbers in (header['camera'], *header.get('other_cameras', ())))
        sources = tuple(Source(*map(str, source)) for source in header.get('sources', ()))
        deviations = arrays.setdefault('deviation_per_metre', np.full(
            len(arrays['map_from_camera']), header.get('deviation_per_metre', FROM_DEPTH), float))
    except (CameraError, KeyError, TypeError, ValueError) as error:
        raise ArrayError(f'has no valid camera or deviation in its header ({error})') from error
    if not ((deviations >= 0.0) & (deviations <= _MOST_DEVIATION)).all():
        raise ArrayError(f'deviation_per_metre is not 0 to {_MOST_DEVIATION}')
    for what, count in (('camera', len(cameras)), ('source', len(sources) or 1)):
        rows = arrays.get(f'{what}_rows', np.zeros(1, dtype=np.int64))
        if not ((rows >= 0) & (rows < count)).all():
            raise ArrayError(f'array {what}_rows has an entry outside the {count} {what}s')
    kind, dimensions = kinds[name](), arrays['vocabulary'].shape[1]
    length = arrays['codebook'].shape[2] if 'codebook' in arrays else 1
    if {dimensions, length * arrays['descriptors'].shape[1]} != {kind.dimensions}:
        raise ArrayError(f'has descriptors of {dimensions} dimensions, expected '
                         f'{kind.dimensions} for kind {name}')
    return KeyframeLayer(str(header.get('frame_id', '')),
                         tuple(map(str, arrays.pop('landmark_ids'))),
                         arrays.pop('landmark_centers'), cameras, **arrays, kind=kind,
                         set_digest=str(header.get('set', '')), sources=sources, parts=())


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
