# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows to compare crops with that are made of labels, of images, or of both.

Similarities of crops with images are larger than those with labels, and spread more. Each kind is
divided by its spread over the map's landmarks, so that neither outweighs the other. A weighted sum
of similarities is the similarity with the weighted sum of the embeddings: a landmark keeps one
row, and a search costs what it costs with labels alone. Offsets that all landmarks share change
neither ranks nor standardized similarities, so they stay.
"""

import numpy as np

from cliploc_ros.core.index.similarities import LabelEmbeddings
from cliploc_ros.core.maps.landmark_embeddings import LandmarkEmbeddings

# Landmarks whose images stand for crops where spreads are measured.
_CROPS_SAMPLED = 1024


def with_images(labels: LabelEmbeddings, images: LandmarkEmbeddings, compare: str
                ) -> LabelEmbeddings:
    """Return a row for each landmark that compares crops with images, or with images and labels.

    A landmark without images keeps its label; where images alone are compared, its label's
    similarity is scaled and shifted to those of images.

    Parameters
    ----------
    labels : LabelEmbeddings
        Of L landmarks.
    images : LandmarkEmbeddings
        Of the same landmarks, at least one of them known.
    compare : str
        'image' or 'both'.
    """
    known = np.flatnonzero(images.is_known)
    means = images.means.astype(np.float32)
    # The deviation of a crop's similarities over the map, with labels and with images.
    sample = known[::-(-len(known) // _CROPS_SAMPLED)]
    crops = means[sample]
    with_labels = (crops @ labels.unique[labels.of_landmarks[sample]].T).std(axis=1).mean()
    others = ~np.eye(len(sample), dtype=np.bool_)  # a mean's similarity with itself says nothing
    with_means = (crops @ crops.T).std(axis=1, where=others).mean() if len(sample) > 1 else 0.0
    text_spread, image_spread = max(float(with_labels), 1e-6), max(float(with_means), 1e-6)
    rows = np.asarray(labels, dtype=np.float32)
    if compare == 'both':
        share = image_spread / (text_spread + image_spread)
        means[~images.is_known] = means[known].mean(axis=0)
        rows *= share
        means *= 1.0 - share
        rows += means
    else:
        rows -= rows.mean(axis=0)
        rows *= image_spread / text_spread
        rows += means[known].mean(axis=0)
        rows[known] = means[known]
    return LabelEmbeddings.of(rows)
