# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings that crops are compared with: those of a map's labels, its images, or both."""

import logging
from collections.abc import Sequence

from cliploc_ros.core.map.joined_map import JoinedMap, parts_of
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    concatenated,
    embeddings_path,
    load_embeddings_of_map,
    with_images,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.similarities import LabelEmbeddings
from cliploc_ros.errors import MapError
from cliploc_ros.models.clip_encoder import LoadedEncoder, embed_labels, load_encoder
from cliploc_ros.models.clip_weights import resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions

logger = logging.getLogger(__name__)


def load_encoder_for_map(options: ClipOptions, landmark_map: LandmarkMap,
                         map_files: Sequence[str], compare: str) -> LoadedEncoder:
    """Load CLIP and the embeddings that crops are compared with; errors as in load_encoder.

    ``map_files`` are the files of the maps, with image embeddings next to them; empty: no image
    embeddings. ``compare`` is one of COMPARED. If a map has no image embeddings of this encoder,
    only labels are compared, because similarities to images and to labels are not comparable
    between maps.
    """
    loaded = load_encoder(options, landmark_map.weighted_labels)
    return loaded._replace(label_embeddings=_compared(
        loaded.label_embeddings, loaded.encoder.key, landmark_map, map_files, compare))


def embed_map(options: ClipOptions, landmark_map: LandmarkMap, map_files: Sequence[str],
              compare: str) -> LabelEmbeddings:
    """Return the embeddings of a map for an encoder already loaded; see load_encoder_for_map."""
    weights = resolve_clip_weights(options)
    return _compared(embed_labels(weights, options, landmark_map.weighted_labels), weights.key,
                     landmark_map, map_files, compare)


def _compared(labels: LabelEmbeddings, key: str, landmark_map: LandmarkMap,
              map_files: Sequence[str], compare: str) -> LabelEmbeddings:
    images = None if compare == 'text' else _images_of_all(key, labels.shape[1], landmark_map,
                                                           map_files)
    if images is not None:
        labels = with_images(labels, images, compare)
    if isinstance(landmark_map, JoinedMap):
        return labels.in_parts([len(part.landmark_map) for part in landmark_map.parts])
    return labels


def _images_of_all(key: str, embed_dim: int, landmark_map: LandmarkMap, map_files: Sequence[str]
                   ) -> LandmarkEmbeddings | None:
    """Return the image embeddings of all maps; None unless each map has some of this encoder."""
    parts = parts_of(landmark_map)
    if len(map_files) != len(parts):
        return None
    found = {file: _images(key, embed_dim, part.landmark_map, file)
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


def _images(key: str, embed_dim: int, landmark_map: LandmarkMap, map_file: str
            ) -> LandmarkEmbeddings | None:
    """Return the image embeddings of a map by this encoder; None if there are none."""
    try:
        images = load_embeddings_of_map(map_file, landmark_map.landmark_ids,
                                        landmark_map.map_set)
    except MapError as error:
        logger.warning('only labels are compared: %s', error)
        return None
    if images is None or not images.is_known.any():
        return None
    if images.encoder_key != key or images.means.shape[1] != embed_dim:
        logger.warning('only labels are compared: %s was made with the encoder %s, not %s; build '
                       'the map again with this encoder', embeddings_path(map_file),
                       images.encoder_key, key)
        return None
    return images
