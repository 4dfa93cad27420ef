# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Label the landmarks of a built map with phrases that fit their crops, and embed them.

A phrase is compared with the mean embedding of a landmark's crops. On both mapping walks of the
demo's world (51 and 57 landmarks), each of these variants named at most one more object:
weighting crops by size or score, dropping the crops farthest from the mean, subtracting a phrase's
mean similarity to all crops or to the crops of its class.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import MOST_MEDOIDS, LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import LabelCache, encode_labels
from cliploc_ros.models.onnx_clip import ClipWeights
from cliploc_ros.models.protocols import ClipOptions
from cliploc_ros.offline.mapping.landmarks import classes_of, group_boxes
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import number_viewpoints
from cliploc_ros.offline.vocabulary.vocabulary import Phrases

# The best phrase and the next five.
_LABELS = 6
# CLIP is trained such that softmax(100 cosine) over many texts is the probability of each text.
_CLIP_SCALE = 100.0
# Greatest number of crops that describe a landmark, evenly spaced: it bounds the memory.
_MOST_CROPS = 512
# A further medoid has to raise the mean cosine of crops and nearest medoids by this. Chosen.
_LEAST_MEDOID_GAIN = 0.005
# Phrases are encoded once, and cached class by class: enough for the 80 COCO classes and as many
# of the user; a file of ViT-L-14 takes at most 3 MB.
_MOST_FILES = 200

logger = logging.getLogger(__name__)


def embed_landmarks(landmark_ids: Sequence[str], detections: PosedDetections,
                    shown: NDArray[np.int64]) -> LandmarkEmbeddings:
    """Return the mean embedding and the medoids of each landmark's crops.

    The frames of a viewpoint share the weight of one frame. Embeddings of length 0 are ignored.
    """
    assert detections.embeddings is not None
    viewpoints = number_viewpoints(detections)
    weights = (1.0 / np.bincount(viewpoints))[viewpoints][detections.frames]
    size = detections.embeddings.shape[1]
    means = np.zeros((len(landmark_ids), size), dtype=np.float16)
    medoids = [np.empty((0, size), dtype=np.float32)]
    for row, boxes in enumerate(group_boxes(shown, len(landmark_ids))):
        chosen = boxes[::-(-len(boxes) // _MOST_CROPS) or 1]
        crops, lengths = _unit_rows(detections.embeddings[chosen])
        crops, crop_weights = crops[lengths > 0.0], weights[chosen][lengths > 0.0]
        mean, mean_length = _unit_rows(crop_weights[None] @ crops)
        if len(crops) and mean_length[0] > 0.0:
            means[row] = mean[0]
            medoids.append(crops[choose_medoids(crops, crop_weights)])
        else:
            medoids.append(crops[:0])
    offsets = np.cumsum(list(map(len, medoids)))
    return LandmarkEmbeddings(detections.encoder_key, tuple(landmark_ids), means,
                              np.concatenate(medoids).astype(np.float16), offsets)


def label_landmarks(landmark_map: LandmarkMap, embeddings: LandmarkEmbeddings,
                    phrases: Mapping[str, Sequence[Phrases]]) -> LandmarkMap:
    """Label each landmark of a map with its best-fitting phrases and their weights.

    A landmark without embeddings keeps its label. The candidates are the phrases of all classes of
    the landmark.
    """
    embeddings = embeddings.in_order(landmark_map.landmark_ids)
    labels = list(landmark_map.labels)
    details = list(landmark_map.details or [LandmarkDetails()] * len(labels))
    for row in np.nonzero(embeddings.is_known)[0]:
        mean = embeddings.means[row].astype(np.float32)
        similarities = {
            text: float(similarity) for name in classes_of(landmark_map, int(row))
            for texts, rows in phrases[name]
            for text, similarity in zip(texts, rows @ mean, strict=True)}
        best = sorted(similarities, key=lambda text: -similarities[text])[:_LABELS]
        weights = np.exp(_CLIP_SCALE * np.array([similarities[text] - similarities[best[0]]
                                                 for text in best]))
        # the map file stores five digits and allows no weight of 0
        weights = np.maximum(weights / weights.sum(), 1e-4)
        labels[row] = best[0]
        details[row] = replace(details[row], labels=tuple(
            zip(best, weights.tolist(), strict=True)))
    return replace(landmark_map, labels=tuple(labels), details=tuple(details))


def choose_medoids(crops: NDArray[np.float32], weights: NDArray[np.float64]) -> list[int]:
    """Choose at most five medoids of m crops (m, d), greedily by their gain in cosine."""
    cosines = crops @ crops.T
    nearest = np.full(len(crops), -1.0)
    chosen: list[int] = []
    while len(chosen) < MOST_MEDOIDS:
        gains = weights @ np.maximum(cosines - nearest[:, None], 0.0)
        best = int(np.argmax(gains))
        if gains[best] < _LEAST_MEDOID_GAIN * weights.sum():
            break
        chosen.append(best)
        nearest = np.maximum(nearest, cosines[:, best])
    return chosen


def _unit_rows(rows: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return rows scaled to unit length, and their lengths; a row of zeros is unchanged."""
    rows = rows.astype(np.float32)
    lengths = np.asarray(np.linalg.norm(rows, axis=1), dtype=np.float32)
    return np.asarray(rows / np.where(lengths > 0.0, lengths, 1.0)[:, None]), lengths


def embed_phrases(weights: ClipWeights, options: ClipOptions,
                  phrases: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], Phrases]:
    """Return groups of phrases with their embeddings.

    The text tower is loaded only if a group is missing in the cache, and only once. Put phrases
    that change together into one group: the cache then keeps the others.

    ModelError, OptionsError: see cliploc_ros.models.clip_encoder.embed_map.
    """
    cache = LabelCache(resolve_cache_dir(options.cache_dir) / 'phrases', _MOST_FILES)
    found = {texts: cache.load(weights.text_key, texts, weights.embed_dim) for texts in phrases}
    missing = [texts for texts, rows in found.items() if rows is None]
    if missing:
        all_texts = [text for texts in missing for text in texts]
        logger.warning('CLIP encodes %d phrases in %d groups; later runs use the cache',
                       len(all_texts), len(missing))
        ends = np.cumsum([len(texts) for texts in missing])
        for texts, rows in zip(missing, np.split(encode_labels(weights, all_texts, options),
                                                 ends[:-1]), strict=True):
            cache.store(weights.text_key, texts, rows)
            found[texts] = rows
    return {texts: Phrases(texts, rows) for texts, rows in found.items() if rows is not None}
