# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What crops are compared with: the labels of a map, its images, or both."""

import logging

from cliploc_ros.core.index.image_rows import with_images
from cliploc_ros.core.index.similarities import LabelEmbeddings
from cliploc_ros.core.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
)
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError
from cliploc_ros.models.clip_encoder import LoadedEncoder, embed_labels, load_encoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights

logger = logging.getLogger(__name__)


def load_encoder_for_map(options: ClipOptions, landmark_map: LandmarkMap, map_file: str,
                         compare: str) -> LoadedEncoder:
    """Load CLIP and the embeddings that it compares crops with.

    Parameters
    ----------
    options : ClipOptions
    landmark_map : LandmarkMap
    map_file : str
        The map's file, which has its image embeddings next to it; '' for none.
    compare : str
        One of COMPARED. Where the map has no images of this encoder, labels alone are compared.

    Raises
    ------
    ModelError, OptionsError
        See load_encoder.
    """
    loaded = load_encoder(options, landmark_map.weighted_labels)
    return loaded._replace(label_embeddings=_compared(
        loaded.label_embeddings, loaded.encoder.key, landmark_map, map_file, compare))


def embed_map(options: ClipOptions, landmark_map: LandmarkMap, map_file: str, compare: str
              ) -> LabelEmbeddings:
    """Return the embeddings of another map for an encoder that stays, see load_encoder_for_map."""
    return _compared(embed_labels(options, landmark_map.weighted_labels),
                     resolve_clip_weights(options).key, landmark_map, map_file, compare)


def _compared(labels: LabelEmbeddings, key: str, landmark_map: LandmarkMap, map_file: str,
              compare: str) -> LabelEmbeddings:
    if compare == 'text':
        return labels
    images = _images(key, labels.shape[1], landmark_map, map_file)
    if images is None:
        return labels
    logger.info('%s: images of %d of %d landmarks', embeddings_path(map_file),
                int(images.is_known.sum()), len(images))
    return with_images(labels, images, compare)


def _images(key: str, embed_dim: int, landmark_map: LandmarkMap, map_file: str
            ) -> LandmarkEmbeddings | None:
    """Return the image embeddings of a map, if there are some of this encoder."""
    if not map_file:
        return None
    try:
        images = load_embeddings_of_map(map_file, landmark_map.landmark_ids)
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
