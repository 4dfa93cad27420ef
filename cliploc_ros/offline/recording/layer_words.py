# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Visual words of a layer of keyframes, and the compression of a large layer."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.features import SIFT, FeatureKind, compact
from cliploc_ros.core.keyframes.layer import WORDS, KeyframeLayer, nearest_words

# Descriptors that the words are learned from, for each group of WORDS words; steps of k-means.
_MOST_LEARNED, _STEPS = 50_000, 8
# A layer with this number of points has groups of this number of words. Among 352 keyframes of 4
# rooms (190,000 points), 1, 4 and 16 words rank one of the three nearest below 5 for 41, 50 and 52
# of 56 images, and the fast pass finds 52, 54 and 55. Layers of one room are smaller.
_TWO_LEVELS, _IN_GROUP = 150_000, 16
# A layer with this number of points is compressed, to this number of bytes a descriptor.
_LARGE, _CODES = 1_000_000, 16
# Rows at once, and rows that the codes are learned from.
_ROWS = 1 << 16


def with_words(layer: KeyframeLayer) -> KeyframeLayer:
    """Return a plain layer with words for its descriptors; a large one is compressed, too."""
    vocabulary = learn_words(layer.descriptors, layer.kind)
    means = layer.kind.units(vocabulary)
    words = [nearest_words(layer.kind.units(layer.descriptors[start:start + _ROWS]), means)
             for start in range(0, len(layer.descriptors), _ROWS)]
    layer = replace(layer, vocabulary=vocabulary, words=np.concatenate(words).astype(np.uint16))
    return layer if len(layer.words) < _LARGE else _compressed(layer)


def learn_words(descriptors: NDArray[np.uint8], kind: FeatureKind = SIFT) -> NDArray[np.uint8]:
    """Learn a vocabulary (W, d) from descriptors (n, d) by k-means, see nearest_words.

    The initial words are evenly spaced descriptors, so that equal layers have equal words.
    """
    size = _IN_GROUP if len(descriptors) >= _TWO_LEVELS else 1
    learned = kind.units(descriptors[::max(1, len(descriptors) // (size * _MOST_LEARNED))])
    means = _means(learned[::size], WORDS)
    if size > 1:
        groups = nearest_words(learned, means)
        parts = [learned[groups == group] for group in range(len(means))]
        # the words of a small group are repeated
        means = np.concatenate([np.resize(_means(part, size) if len(part) else mean, (
            size, kind.dimensions)) for part, mean in zip(parts, means, strict=True)])
    return compact(means, kind.zero, kind.scale)


def _means(units: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return at most `count` means (k, d) of unit vectors (n, d)."""
    means = units[np.linspace(0, len(units) - 1, min(count, len(units))).astype(np.int64)]
    for _ in range(_STEPS):
        words = nearest_words(units, means)
        order = np.argsort(words, kind='stable')
        found, starts = np.unique(words[order], return_index=True)
        sums = np.add.reduceat(units[order], starts, axis=0)
        means[found] = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return means


def _compressed(layer: KeyframeLayer) -> KeyframeLayer:
    """Encode what descriptors differ from their words, in parts (Jegou et al., 2011)."""
    def parts(rows: slice) -> NDArray[np.float32]:
        own = layer.vocabulary[layer.words[rows]].astype(np.float32)
        return (layer.descriptors[rows] - own).reshape(len(own), _CODES, -1).transpose(1, 0, 2)
    learned = parts(slice(None, None, 1 + len(layer.words) // _ROWS))
    cv2.setRNGSeed(0)  # equal layers have equal codes
    codebook = np.array([cv2.kmeans(
        part, 256, None, (cv2.TERM_CRITERIA_MAX_ITER, _STEPS, 0.0), 1,  # type: ignore[call-overload]
        cv2.KMEANS_PP_CENTERS)[2] for part in learned]).round().astype(np.int16)
    # the nearest code has the greatest product after half of its square
    squares = -0.5 * (codebook.astype(np.float32) ** 2).sum(axis=2)
    books = np.dstack([codebook, squares]).astype(np.float32)
    codes = [np.column_stack([
        nearest_words(np.pad(part, ((0, 0), (0, 1)), constant_values=1.0), book)
        for part, book in zip(parts(slice(start, start + _ROWS)), books, strict=True)])
        for start in range(0, len(layer.words), _ROWS)]
    return replace(layer, descriptors=np.concatenate(codes).astype(np.uint8), codebook=codebook,
                   points=layer.points.astype(np.float16))
