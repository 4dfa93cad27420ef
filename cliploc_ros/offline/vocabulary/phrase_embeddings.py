# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of a vocabulary's phrases: encoded once, and cached class by class."""

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights
from cliploc_ros.models.label_embeddings import LabelCache
from cliploc_ros.offline.vocabulary.vocabulary import Phrases

# Enough for the 80 COCO classes and as many of the user; a file of ViT-L-14 takes at most 3 MB.
_MOST_FILES = 200

logger = logging.getLogger(__name__)


def embed_phrases(weights: ClipWeights, options: ClipOptions,
                  phrases: Mapping[str, Sequence[str]]) -> dict[str, NDArray[np.float32]]:
    """Return the embeddings (P, d) of the P phrases of each class, as unit rows.

    The text tower is loaded only if a class is missing in the cache, and only once.

    ModelError, OptionsError: see cliploc_ros.models.clip_encoder.load_encoder.
    """
    cache = LabelCache(resolve_cache_dir(options.cache_dir) / 'phrases', _MOST_FILES)
    found, missing = {}, {}
    for name, texts in phrases.items():
        rows = cache.load(weights.key, texts, weights.embed_dim)
        if rows is None:
            missing[name] = texts
        else:
            found[name] = rows
    if missing:
        all_texts = [text for texts in missing.values() for text in texts]
        logger.warning('CLIP encodes %d phrases of %d classes; later runs use the cache',
                       len(all_texts), len(missing))
        encoded = encode_labels(weights, all_texts, options)
        ends = np.cumsum([len(texts) for texts in missing.values()])
        for name, rows in zip(missing, np.split(encoded, ends[:-1]), strict=True):
            cache.store(weights.key, missing[name], rows)
            found[name] = rows
    return {name: found[name] for name in phrases}


def phrases_of_classes(weights: ClipWeights, options: ClipOptions,
                       parts: Sequence[Mapping[str, Sequence[str]]]) -> dict[str, list[Phrases]]:
    """Return the phrases of each class with their embeddings; errors as in embed_phrases.

    Put phrases that change together into one part: the cache then keeps the other parts.
    """
    found: dict[str, list[Phrases]] = {}
    for part in parts:
        for name, rows in embed_phrases(weights, options, part).items():
            found.setdefault(name, []).append(Phrases(tuple(part[name]), rows))
    return found
