# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Encode crops and labels with CLIP as embeddings of unit length."""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import WeightedLabels
from cliploc_ros.core.map.similarities import LabelEmbeddings
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_weights import (
    WITHOUT_CLIP,
    ClipOptions,
    ClipWeights,
    resolve_clip_weights,
    runs_in_openvino,
)
from cliploc_ros.models.devices import (
    free_memory,
    needs_pytorch,
    resolve_device,
    resolve_precision,
)
from cliploc_ros.models.exports import ExportError, keep_export
from cliploc_ros.models.images import check_image_rgb, crop_bounds
from cliploc_ros.models.label_embeddings import LabelCache, mixed_rows
from cliploc_ros.models.onnx_clip import OnnxTextTower, OnnxTower

if TYPE_CHECKING:  # needs PyTorch
    from cliploc_ros.models.clip_towers import TorchTextTower, TorchTower

Label = str | WeightedLabels

_LABEL_BATCH = 64

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

    ModelError: the weights cannot be found or loaded. OptionsError: the device is missing.
    """
    started = time.monotonic()
    weights = resolve_clip_weights(options)
    embeddings = embed_labels(weights, options, labels)
    encoder = ClipEncoder(weights, options)
    logger.info('CLIP %s is ready after %.1f s (%s, %s)', weights.model,
                time.monotonic() - started, encoder.inference, encoder.device)
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

    ModelError: the file does not hold the weights of the model, or embeddings are not finite.
    OptionsError: the device or the inference engine is missing.
    """

    def __init__(self, weights: ClipWeights, options: ClipOptions) -> None:
        self._weights = weights
        self._options = options
        self.device = resolve_device(options.device)
        self._tower = _load_image_tower(weights, options, self.device)
        #: Equal keys (model and weights) give equal label embeddings.
        self.key = weights.key
        self.inference = self._tower.inference  #: 'pytorch' or 'openvino'
        self.embed_dim = weights.embed_dim  #: The length d of an embedding
        # The first pass sets up kernels and memory; run it before the first request.
        self.encode_crops(np.zeros((32, 32, 3), dtype=np.uint8), np.array([[0.0, 0, 32, 32]]))

    def encode_crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                     ) -> NDArray[np.float32]:
        """Return embeddings (n, d) of unit length for the boxes of an image (h, w, 3).

        The boxes (n, 4) are left, top, right, bottom [px]; `visible_boxes` finds those that can be
        cropped. A crop contains all pixels that its box touches. A batch has at most ``max_batch``
        crops.

        ImageError: the image has another shape or type, or no pixels. CliplocError: a box is not
        finite, empty or outside the image. ModelError: memory runs out, or embeddings are not
        finite.
        """
        check_image_rgb(image_rgb)
        bounds = crop_bounds(bboxes_xyxy, image_rgb.shape[1], image_rgb.shape[0])
        features = []
        for start in range(0, len(bounds), self._options.max_batch):
            features.append(self._tower(np.stack([
                self._tower.prepare(image_rgb[top:bottom, left:right])
                for left, top, right, bottom in
                bounds[start:start + self._options.max_batch].tolist()])))
        return _unit_rows(features, self._weights)

    def encode_labels(self, labels: Sequence[str]) -> NDArray[np.float32]:
        """Return the embeddings (L, d) of labels; loads and frees the text tower."""
        return encode_labels(self._weights, labels, self._options)


def encode_labels(weights: ClipWeights, labels: Sequence[str], options: ClipOptions
                  ) -> NDArray[np.float32]:
    """Return the embeddings (L, d) of labels, float32 rows of unit length.

    This loads the text tower and frees it afterwards. The tower runs in fp32 on any device, so
    that a cache made on one machine can be used on another. A label longer than the model's
    context is truncated, with a warning.
    """
    features = [_run_text_tower(weights, labels, options)] if labels else []
    free_memory()
    return _unit_rows(features, weights)


def _run_text_tower(weights: ClipWeights, labels: Sequence[str], options: ClipOptions
                    ) -> NDArray[np.float32]:
    tower = _load_text_tower(weights, options)
    ends = 2  # the tokens of start and end
    for label in labels:
        if (count := tower.count(label)) > tower.context:
            logger.warning("label '%s' has %d tokens: CLIP reads the first %d and ignores the "
                           'rest', label, count - ends, tower.context - ends)
    return tower(labels, _LABEL_BATCH)


def _load_image_tower(weights: ClipWeights, options: ClipOptions, device: str
                      ) -> 'TorchTower | OnnxTower':
    exported = _as_onnx(weights, options)
    if exported is not None:
        return OnnxTower(exported, options)
    from cliploc_ros.models.clip_towers import TorchTower

    return TorchTower(weights, device, resolve_precision(options.precision, device))


def _load_text_tower(weights: ClipWeights, options: ClipOptions
                     ) -> 'TorchTextTower | OnnxTextTower':
    exported = _as_onnx(weights, options)
    if exported is not None:
        return OnnxTextTower(exported, options)
    from cliploc_ros.models.clip_towers import TorchTextTower

    return TorchTextTower(weights, resolve_device(options.device))


def _as_onnx(weights: ClipWeights, options: ClipOptions) -> ClipWeights | None:
    """Return weights in ONNX files, exported once; None if PyTorch is to run them.

    With inference 'auto', PyTorch runs a CLIP that cannot be exported; with 'openvino', an
    ExportError is raised. OptionsError: a GPU or PyTorch is requested for ONNX files.
    """
    if not runs_in_openvino(options):
        if weights.is_onnx and not (options.device == 'auto' and options.inference == 'auto'):
            raise OptionsError(f"{weights.file} runs in OpenVINO: set device to 'cpu', precision "
                               "and inference to 'auto', or name weights of open_clip for a GPU")
        return weights if weights.is_onnx else None
    if weights.is_onnx:
        return weights
    with needs_pytorch(f'CLIP {weights.model}, which is not an ONNX network,', WITHOUT_CLIP):
        from cliploc_ros.models.export import export_clip

        try:
            folder = keep_export(options.cache_dir, weights.model, weights.identity,
                                 partial(export_clip, weights))
        except ExportError as error:
            if options.inference == 'openvino':
                raise
            logger.warning('%s; PyTorch runs it (set inference to pytorch to skip the attempt)',
                           error)
            return None
    return replace(weights, file=folder, is_onnx=True)


def _unit_rows(features: Sequence[NDArray[np.float32]], weights: ClipWeights
               ) -> NDArray[np.float32]:
    """Scale features to rows of unit length, in fp32: fp16 would round their length to 1e-3."""
    rows = np.concatenate([np.empty((0, weights.embed_dim), dtype=np.float32), *features])
    if not np.isfinite(rows).all():
        raise ModelError(f'the embeddings of {weights.file} are not finite: the weights are '
                         'corrupt, or overflow in fp16 (set the precision to fp32)')
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
