# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of a vocabulary's phrases: encoded once, class by class in the cache."""

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.files.storage import resolve_cache_dir
from cliploc_ros.mapping.labelling import Phrases
from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, ClipWeights
from cliploc_ros.models.devices import resolve_device
from cliploc_ros.models.label_embeddings import LabelCache

# The COCO classes and as many of a user; a file of ViT-L-14 takes 3 MB at most.
_MOST_FILES = 200

logger = logging.getLogger(__name__)


def embed_phrases(weights: ClipWeights, options: ClipOptions,
                  phrases: Mapping[str, Sequence[str]]) -> dict[str, NDArray[np.float32]]:
    """Return the embeddings (P, d) of the P phrases of each class, unit rows.

    The text tower is loaded once, and only if the cache lacks a class.

    Raises
    ------
    ModelError, OptionsError
        See cliploc_ros.models.clip_encoder.load_encoder.
    """
    cache = LabelCache(resolve_cache_dir(options.cache_dir) / 'phrases', _MOST_FILES)
    found = {name: cache.load(weights.key, texts, weights.embed_dim)
             for name, texts in phrases.items()}
    missing = {name: phrases[name] for name, rows in found.items() if rows is None}
    encoded = _encode(weights, options, missing) if missing else {}
    for name, rows in encoded.items():
        cache.store(weights.key, phrases[name], rows)
    return {name: rows for name, rows in (found | encoded).items() if rows is not None}


def phrases_of_classes(weights: ClipWeights, options: ClipOptions,
                       parts: Sequence[Mapping[str, Sequence[str]]]) -> dict[str, list[Phrases]]:
    """Return the phrases of each class with their embeddings.

    Parameters
    ----------
    parts : sequence of mapping of str to sequence of str
        Phrases by class. Those that change together belong into one part: the cache then keeps
        the others.

    Raises
    ------
    ModelError, OptionsError
        See embed_phrases.
    """
    embedded = [embed_phrases(weights, options, part) for part in parts]
    found: dict[str, list[Phrases]] = {}
    for part, rows in zip(parts, embedded, strict=True):
        for name, texts in part.items():
            found.setdefault(name, []).append(Phrases(tuple(texts), rows[name]))
    return found


def _encode(weights: ClipWeights, options: ClipOptions, phrases: Mapping[str, Sequence[str]]
            ) -> dict[str, NDArray[np.float32]]:
    texts = [text for of_class in phrases.values() for text in of_class]
    logger.warning('CLIP reads %d phrases of %d classes; the next run finds them in the cache',
                   len(texts), len(phrases))
    rows = encode_labels(weights, texts, resolve_device(options.device))
    ends = np.cumsum([len(of_class) for of_class in phrases.values()])
    return dict(zip(phrases, np.split(rows, ends[:-1]), strict=True))
