# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Similarities of crops and labels for maps of any size.

A label that several landmarks share is stored and compared once. The label embeddings of a loaded
map take 4 U d + 8 L bytes, for U different labels of d dimensions and L landmarks. With ViT-L-14
(d = 768), 1,000 labels take 3 MB, 100,000 take 310 MB, and 1,000,000 take 3.1 GB. A comparison
with 12 crops takes another .1 MB for each 1,000 labels.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import OptionsError

# Number of labels that determines mean and deviation of a crop's similarities to within 2 %.
_LABELS_SAMPLED = 4096


@dataclass(frozen=True)
class LabelEmbeddings:
    """The embeddings of a map's labels, without repetitions. NumPy sees an array (L, d)."""

    #: (U, d): one row for each different label: of unit length, or a weighted mean of unit rows
    unique: NDArray[np.float32]
    #: (L,): row of each landmark's label. Every row belongs to at least one landmark.
    of_landmarks: NDArray[np.int64]

    @staticmethod
    def of(embeddings: 'LabelEmbeddings | NDArray[np.float32]') -> 'LabelEmbeddings':
        """Convert an array (L, d), one row for each landmark, to label embeddings."""
        if isinstance(embeddings, LabelEmbeddings):
            return embeddings
        return LabelEmbeddings(embeddings, np.arange(len(embeddings)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the embedding of each landmark (L, d)."""
        return np.asarray(self.unique[self.of_landmarks], dtype=dtype)


@dataclass(frozen=True)
class CropSimilarities:
    """Cosine similarities of crops and landmarks, computed on demand.

    NumPy sees an array (n, L).
    """

    crops: NDArray[np.float32]  #: (n, d): unit rows
    labels: LabelEmbeddings

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of crops and of landmarks."""
        return len(self.crops), len(self.labels.of_landmarks)

    @cached_property
    def spread(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return mean and standard deviation (n,) of each crop, see sampled_spread."""
        sample = self.labels.of_landmarks[::-(-self.shape[1] // _LABELS_SAMPLED)]
        alike = self.crops @ self.labels.unique[sample].T
        return alike.mean(axis=1), alike.std(axis=1)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the similarities (n, L)."""
        whole = self.crops @ self.labels.unique.T
        return np.asarray(whole[:, self.labels.of_landmarks], dtype=dtype)


Similarities = NDArray[np.float32] | CropSimilarities


def nearest_landmarks(similarities: Similarities, k: int
                      ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the k landmarks (n, k) most similar to each crop, best first, and their similarities.

    Equal similarities keep the map's order.

    Parameters
    ----------
    similarities : ndarray (n, L) or CropSimilarities

    Raises
    ------
    OptionsError
        A similarity is not finite.
    """
    if isinstance(similarities, CropSimilarities):
        alike = similarities.crops @ similarities.labels.unique.T
        columns = similarities.labels.of_landmarks
    else:
        alike, columns = similarities, np.arange(similarities.shape[1])
    if not np.isfinite(alike).all():
        raise OptionsError('similarities contain values that are not finite')
    # sort only the landmarks that are among the best of some crop
    place = -min(k, alike.shape[1])
    least = np.partition(alike, place, axis=1)[:, place, None] if alike.size else alike
    landmarks = np.nonzero((alike >= least).any(axis=0)[columns])[0]
    values = alike[:, columns[landmarks]]
    order = np.argsort(-values, axis=1, kind='stable')[:, :k]
    return landmarks[order], np.take_along_axis(values, order, axis=1)


def pair_similarities(similarities: Similarities, crops: NDArray[np.int64],
                      landmarks: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the similarities (m,) of crops (m,) and landmarks (m,), pair by pair."""
    if not isinstance(similarities, CropSimilarities):
        return similarities[crops, landmarks]
    labels = similarities.labels.unique[similarities.labels.of_landmarks[landmarks]]
    return np.asarray(np.einsum('ij,ij->i', similarities.crops[crops], labels))


def sampled_spread(similarities: Similarities, crops: NDArray[np.int64]
                   ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean and standard deviation (m,) of the similarities of crops (m,) to landmarks.

    They are computed from landmarks at regular steps through the map: all landmarks of a map with
    up to _LABELS_SAMPLED, and at least half that number in a larger map.
    """
    if isinstance(similarities, CropSimilarities):
        means, deviations = similarities.spread
        return means[crops], deviations[crops]
    alike = similarities[crops, ::-(-similarities.shape[1] // _LABELS_SAMPLED)]
    return alike.mean(axis=1), alike.std(axis=1)
