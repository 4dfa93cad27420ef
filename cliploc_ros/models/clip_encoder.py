# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Encode crops and labels with CLIP as embeddings of unit length."""

import logging
import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import WeightedLabels
from cliploc_ros.core.map.similarities import LabelEmbeddings
from cliploc_ros.errors import ModelError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_weights import ClipWeights, resolve_clip_weights
from cliploc_ros.models.images import check_image_rgb, crop_bounds
from cliploc_ros.models.label_embeddings import LabelCache, mixed_rows
from cliploc_ros.models.onnx_clip import OnnxTextTower, OnnxTower
from cliploc_ros.models.onnx_network import free_memory
from cliploc_ros.models.protocols import ClipOptions

Label = str | WeightedLabels

# Greatest number of crops or labels that are encoded at once; it limits the memory.
_BATCH = 64

logger = logging.getLogger(__name__)


class LoadedEncoder(NamedTuple):
    """An encoder for crops, and the embeddings (L, d) of a map's labels."""

    encoder: 'ClipEncoder'
    label_embeddings: LabelEmbeddings


def load_encoder(options: ClipOptions, labels: Sequence[Label]) -> LoadedEncoder:
    """Load CLIP for a map: encode its labels and keep only the image tower.

    If the cache has the embeddings for model, weights and labels, the text tower is not loaded.
    Otherwise the text tower is loaded first, and freed before the image tower is loaded. Labels
    may be repeated.

    ModelError: the weights cannot be found or loaded.
    """
    started = time.monotonic()
    weights = resolve_clip_weights(options)
    embeddings = embed_labels(weights, options, labels)
    encoder = ClipEncoder(weights, options)
    logger.info('CLIP %s is ready after %.1f s', weights.model, time.monotonic() - started)
    return LoadedEncoder(encoder, embeddings)


def embed_labels(weights: ClipWeights, options: ClipOptions, labels: Sequence[Label]
                 ) -> LabelEmbeddings:
    """Return the embeddings of labels, without an encoder for crops; see `load_encoder`."""
    described = [((label, 1.0),) if isinstance(label, str) else label for label in labels]
    # Unique and sorted, so that moving or reordering landmarks needs no new embeddings.
    unique = sorted(set(described))
    embeddings = mixed_rows(unique, partial(_encoded_once, weights, options), weights.embed_dim)
    rows = {description: row for row, description in enumerate(unique)}
    return LabelEmbeddings(embeddings, np.array([rows[description] for description in described],
                                                dtype=np.int64))


def _encoded_once(weights: ClipWeights, options: ClipOptions, labels: Sequence[str]
                  ) -> NDArray[np.float32]:
    """Return the embeddings of labels from the cache, or encode and cache them."""
    cache = LabelCache(resolve_cache_dir(options.cache_dir) / 'labels')
    embeddings = cache.load(weights.key, labels, weights.embed_dim)
    source = 'cached'
    if embeddings is None:
        source = 'encoded'
        embeddings = encode_labels(weights, labels, options)
        cache.store(weights.key, labels, embeddings)
    logger.info('CLIP %s: %d labels %s', weights.model, len(labels), source)
    return embeddings


class ClipEncoder:
    """An `ImageTextEncoder` that keeps only the image tower in memory.

    ModelError: the files do not hold a CLIP, or embeddings are not finite.
    """

    def __init__(self, weights: ClipWeights, options: ClipOptions) -> None:
        self._weights = weights
        self._options = options
        self._tower = OnnxTower(weights, options.cache_dir)
        #: Equal keys (model and weights) give equal label embeddings.
        self.key = weights.key
        self.embed_dim = weights.embed_dim  #: The length d of an embedding
        # The first pass sets up kernels and memory; run it before the first request.
        self.encode_crops(np.zeros((32, 32, 3), dtype=np.uint8), np.array([[0.0, 0, 32, 32]]))

    def encode_crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                     ) -> NDArray[np.float32]:
        """Return embeddings (n, d) of unit length for the boxes of an image (h, w, 3).

        The boxes (n, 4) are left, top, right, bottom [px]; `visible_boxes` finds those that can be
        cropped. A crop contains all pixels that its box touches.

        ImageError: the image has another shape or type, or no pixels. CliplocError: a box is not
        finite, empty or outside the image. ModelError: embeddings are not finite.
        """
        check_image_rgb(image_rgb)
        bounds = crop_bounds(bboxes_xyxy, image_rgb.shape[1], image_rgb.shape[0])
        features = []
        for start in range(0, len(bounds), _BATCH):
            features.append(self._tower(np.stack([
                self._tower.prepare(image_rgb[top:bottom, left:right])
                for left, top, right, bottom in
                bounds[start:start + _BATCH].tolist()])))
        return _unit_rows(features, self._weights)

    def encode_labels(self, labels: Sequence[str]) -> NDArray[np.float32]:
        """Return the embeddings (L, d) of labels; loads and frees the text tower."""
        return encode_labels(self._weights, labels, self._options)


def encode_labels(weights: ClipWeights, labels: Sequence[str], options: ClipOptions
                  ) -> NDArray[np.float32]:
    """Return the embeddings (L, d) of labels, float32 rows of unit length.

    This loads the text tower and frees it afterwards. The tower runs in fp32 on any machine, so
    that a cache made on one machine can be used on another. A label longer than the model's
    context is truncated, with a warning.
    """
    features = []
    if labels:
        tower, ends = OnnxTextTower(weights, options.cache_dir), 2  # the tokens of start and end
        for label in labels:
            if (count := tower.count(label)) > tower.context:
                logger.warning("label '%s' has %d tokens: CLIP reads the first %d and ignores the "
                               'rest', label, count - ends, tower.context - ends)
        features = [tower(labels, _BATCH)]
        del tower
    free_memory()
    return _unit_rows(features, weights)


def _unit_rows(features: Sequence[NDArray[np.float32]], weights: ClipWeights
               ) -> NDArray[np.float32]:
    """Scale features to rows of unit length."""
    rows = np.concatenate([np.empty((0, weights.embed_dim), dtype=np.float32), *features])
    if not np.isfinite(rows).all():
        raise ModelError(f'the embeddings of {weights.folder} are not finite: the weights are '
                         'corrupt')
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
