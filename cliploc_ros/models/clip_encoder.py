# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Encode crops, labels and maps with CLIP as embeddings of unit length.

Crops are compared with the labels of a map, its images, or both. Label embeddings are cached, so
that CLIP starts without its text tower.
"""

import contextlib
import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Sequence
from itertools import batched
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from cliploc_ros.core.map.joined_map import parts_of
from cliploc_ros.core.map.landmark_details import WeightedLabels
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    concatenated,
    embeddings_path,
    load_embeddings_of_map,
    with_images,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import LabelEmbeddings
from cliploc_ros.errors import MapError, ModelError
from cliploc_ros.files.arrays import Check, Field, Schema
from cliploc_ros.files.storage import MAKE_ROOM, check_owners, resolve_cache_dir, warn_not_kept
from cliploc_ros.models import onnx_clip
from cliploc_ros.models.files import new_entry
from cliploc_ros.models.observer import crop_bounds
from cliploc_ros.models.onnx_network import free_memory
from cliploc_ros.models.protocols import ClipOptions

# Greatest number of crops or labels that are encoded at once; it limits the memory.
_BATCH = 64
_FORMAT = 1
# A map of 1,000 labels takes 3 MB with ViT-L-14.
_MOST_FILES = 32
# L labels, d numbers, t bytes that identify labels and encoder.
_SCHEMA = Schema('file of label embeddings', {
    'identity': Field('uint8', ('t',)),
    'embeddings': Field('float32', ('L', 'd'), (Check('is not of unit length', lambda rows: ~(
        np.abs(np.einsum('ij,ij->i', rows, rows) - 1.0) <= 2e-3)),)),
}, ModelError)

logger = logging.getLogger(__name__)


def load_encoder_for_map(options: ClipOptions, landmark_map: LandmarkMap,
                         map_files: Sequence[str], compare: str
                         ) -> tuple['ClipEncoder', LabelEmbeddings]:
    """Load CLIP and the embeddings that crops are compared with, see embed_map.

    If the cache has the embeddings for model, weights and labels, the text tower is not loaded.
    Otherwise the text tower is loaded first, and freed before the image tower is loaded.

    ModelError: the weights cannot be found or loaded.
    """
    started = time.monotonic()
    embeddings = embed_map(options, landmark_map, map_files, compare)
    weights = onnx_clip.resolve_clip_weights(options)
    encoder = ClipEncoder(weights, options)
    logger.info('CLIP %s is ready after %.1f s', weights.model, time.monotonic() - started)
    return encoder, embeddings


def embed_map(options: ClipOptions, landmark_map: LandmarkMap, map_files: Sequence[str],
              compare: str) -> LabelEmbeddings:
    """Return the embeddings that crops are compared with, without an encoder for crops.

    ``map_files`` are the files of the maps, with image embeddings next to them; empty: no image
    embeddings. ``compare`` is one of COMPARED. If a map has no image embeddings of this encoder,
    only labels are compared, because similarities to images and to labels are not comparable
    between maps.

    ModelError: the weights cannot be found or loaded.
    """
    weights = onnx_clip.resolve_clip_weights(options)
    # Unique and sorted, so that moving or reordering landmarks needs no new embeddings.
    unique = sorted(set(landmark_map.weighted_labels))
    rows = {description: row for row, description in enumerate(unique)}

    def encode(texts: Sequence[str]) -> NDArray[np.float32]:
        return encoded_once(weights.text_key, texts, weights.embed_dim, options.cache_dir,
                            lambda missing: encode_labels(weights, missing, options))
    labels = LabelEmbeddings(mixed_rows(unique, encode), np.array(
        [rows[description] for description in landmark_map.weighted_labels], dtype=np.int64))
    images = None if compare == 'text' else _images_of_all(weights, landmark_map, map_files)
    if images is not None:
        labels = with_images(labels, images, compare)
    return labels


def _images_of_all(weights: onnx_clip.ClipWeights, landmark_map: LandmarkMap,
                   map_files: Sequence[str]) -> LandmarkEmbeddings | None:
    """Return the image embeddings of all maps; None unless each map has some of this encoder."""
    parts = parts_of(landmark_map)
    if len(map_files) != len(parts):
        return None
    found = {file: _images(weights, part.landmark_map, file)
             for part, file in zip(parts, map_files, strict=True)}
    known = [images for images in found.values() if images is not None]
    if len(known) < len(parts):
        if known:
            without = next(file for file, images in found.items() if images is None)
            logger.warning('only labels are compared: %s has no image embeddings of this encoder, '
                           'unlike other maps; build it again with its images', without)
        return None
    for file, images in zip(map_files, known, strict=True):
        logger.info('%s: images of %d of %d landmarks', embeddings_path(file),
                    int(images.is_known.sum()), len(images))
    return concatenated(known, landmark_map.landmark_ids)


def _images(weights: onnx_clip.ClipWeights, landmark_map: LandmarkMap, map_file: str
            ) -> LandmarkEmbeddings | None:
    """Return the image embeddings of a map by this encoder; None if there are none."""
    try:
        images = load_embeddings_of_map(map_file, landmark_map.landmark_ids, landmark_map.map_set)
    except MapError as error:
        logger.warning('only labels are compared: %s', error)
        return None
    if images is None or not images.is_known.any():
        return None
    if (images.encoder_key, images.means.shape[1]) != (weights.key, weights.embed_dim):
        logger.warning('only labels are compared: %s was made with the encoder %s, not %s; build '
                       'the map again with this encoder', embeddings_path(map_file),
                       images.encoder_key, weights.key)
        return None
    return images


def encoded_once(key: str, labels: Sequence[str], embed_dim: int, cache_dir: str,
                 encode: Callable[[Sequence[str]], NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the embeddings of labels from the cache, or encode and cache them; see LabelCache."""
    cache = LabelCache(resolve_cache_dir(cache_dir) / 'labels')
    embeddings = cache.load(key, labels, embed_dim)
    logger.info('%d labels %s', len(labels), 'to encode' if embeddings is None else 'cached')
    if embeddings is None:
        embeddings = encode(labels)
        cache.store(key, labels, embeddings)
    return embeddings


class ClipEncoder:
    """An `ImageTextEncoder` that keeps only the image tower in memory.

    ModelError: the files do not hold a CLIP, or embeddings are not finite.
    """

    def __init__(self, weights: onnx_clip.ClipWeights, options: ClipOptions) -> None:
        self._weights = weights
        self._tower = onnx_clip.OnnxTower(weights, options.cache_dir)
        #: Equal keys (model and weights) give equal label embeddings.
        self.key = weights.key
        self.embed_dim = weights.embed_dim  #: The length d of an embedding
        # The first pass sets up kernels and memory; run it before the first request.
        self.encode_crops(np.zeros((32, 32, 3), dtype=np.uint8), np.array([[0.0, 0, 32, 32]]))

    def encode_crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                     ) -> NDArray[np.float32]:
        """Return embeddings (n, d) of unit length for the boxes of an image (h, w, 3).

        The boxes (n, 4) are left, top, right, bottom [px]. A crop contains all pixels that its box
        touches, see `crop_bounds`.

        CliplocError: a box is not finite, empty or outside the image. ModelError: embeddings are
        not finite.
        """
        bounds = crop_bounds(bboxes_xyxy, image_rgb.shape[1], image_rgb.shape[0])
        prepared = (self._tower.prepare(image_rgb[top:bottom, left:right])
                    for left, top, right, bottom in bounds.tolist())
        return _unit_rows([self._tower(np.stack(batch)) for batch in batched(prepared, _BATCH)],
                          self._weights)


def encode_labels(weights: onnx_clip.ClipWeights, labels: Sequence[str], options: ClipOptions
                  ) -> NDArray[np.float32]:
    """Return the embeddings (L, d) of labels, float32 rows of unit length.

    This loads the text tower and frees it afterwards. The tower runs in fp32 on any machine, so
    that a cache made on one machine can be used on another. A label longer than the model's
    context is truncated, with a warning.
    """
    features = []
    if labels:
        ends = 2  # the tokens of start and end
        tower = onnx_clip.OnnxTextTower(weights, options.cache_dir)
        for label in labels:
            if (count := tower.count(label)) > tower.context:
                logger.warning("label '%s' has %d tokens: CLIP reads the first %d and ignores the "
                               'rest', label, count - ends, tower.context - ends)
        features = [tower(labels, _BATCH)]
        del tower
    free_memory()
    return _unit_rows(features, weights)


def _unit_rows(features: Sequence[NDArray[np.float32]], weights: onnx_clip.ClipWeights
               ) -> NDArray[np.float32]:
    """Scale features to rows of unit length."""
    rows = np.concatenate([np.empty((0, weights.embed_dim), dtype=np.float32), *features])
    if not np.isfinite(rows).all():
        raise ModelError(f'the embeddings of {weights.folder} are not finite: the weights are '
                         'corrupt')
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


class LabelCache:
    """A folder of label embeddings, one ``.npz`` for each model and set of labels.

    The name of a file is the hash of the encoder's key (model, activation, fingerprint of the
    weights) and of the labels. The file also contains both, to detect foreign and damaged files. A
    file holds a whole set of labels, not a single label, so that embeddings never depend on
    earlier batches; a changed map costs one slow start. Files are written under another name and
    renamed, so that any number of processes can share the folder. Reading a file marks it as used.
    Beyond ``most_files``, the least recently used files are removed. The first write makes the
    folder.
    """

    def __init__(self, folder: Path, most_files: int = _MOST_FILES) -> None:
        self._folder = folder
        self._most_files = most_files

    def load(self, key: str, labels: Sequence[str], embed_dim: int) -> NDArray[np.float32] | None:
        """Return the embeddings (L, embed_dim) of L labels; None if they are not in the cache."""
        file = self._file(key, labels)
        if not file.exists():
            return None
        try:
            check_owners(self._folder)
            arrays = _SCHEMA.read(file)
            embeddings = arrays['embeddings']
            if (bytes(arrays['identity']), embeddings.shape) != (
                    _identity(key, labels), (len(labels), embed_dim)):
                raise ModelError('it is for other weights or labels')
        except (ModelError, PermissionError) as error:
            logger.warning('label embeddings in %s cannot be used (%s): encoding the labels again',
                           file, error)
            return None
        with contextlib.suppress(OSError):  # a read-only cache works too
            os.utime(file)
        return embeddings

    def store(self, key: str, labels: Sequence[str], embeddings: NDArray[np.float32]) -> None:
        """Write the embeddings of labels; a failure causes only a warning."""
        file = self._file(key, labels)
        try:
            with new_entry(file, self._most_files) as partial:
                np.savez(partial, embeddings=embeddings,
                         identity=np.frombuffer(_identity(key, labels), dtype=np.uint8))
        except OSError as error:
            warn_not_kept(f'label embeddings are not cached: cannot write {file} '
                          f'({error.strerror or error}); {MAKE_ROOM} (cache_dir)')

    def _file(self, key: str, labels: Sequence[str]) -> Path:
        digest = hashlib.sha256(_identity(key, labels)).hexdigest()
        return self._folder / f'labels-{digest[:32]}.npz'


def _identity(key: str, labels: Sequence[str]) -> bytes:
    return json.dumps([_FORMAT, key, list(labels)]).encode()


def mixed_rows(descriptions: Sequence[WeightedLabels],
               encode: Callable[[Sequence[str]], NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the embeddings (R, d) of R descriptions.

    The embedding of a description is the weighted mean of the embeddings of its labels, scaled to
    unit length. That of a single label is unchanged. ``encode`` returns the embeddings (m, d)
    of m labels, as unit rows. It is called with all labels, sorted.
    """
    labels = sorted({label for description in descriptions for label, _ in description})
    # the share of each label in each description, a sparse matrix (R, U)
    columns = {label: column for column, label in enumerate(labels)}
    ends = np.cumsum([0, *map(len, descriptions)])
    shares = np.array([weight for description in descriptions for _, weight in description],
                      dtype=np.float32)
    owners = np.repeat(np.arange(len(descriptions)), np.diff(ends))
    shares /= np.bincount(owners, shares, len(descriptions)).astype(np.float32)[owners]
    weights = csr_matrix(
        (shares, [columns[label] for description in descriptions for label, _ in description],
         ends), shape=(len(descriptions), len(labels)))
    rows = np.asarray(weights @ encode(labels))
    lengths = np.maximum(np.sqrt(np.einsum('ij,ij->i', rows, rows)), 1e-12)
    rows /= np.where(np.diff(weights.indptr) > 1, lengths, 1.0)[:, None]
    return rows
