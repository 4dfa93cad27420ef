# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How alike crops and labels are, for maps of any size: never more than a block of it at once.

A label that many landmarks share is kept and compared once. With U different labels of d numbers,
L landmarks and n crops the memory is 4 U d + 8 L bytes for as long as the map is loaded, and
about 0.6 MB for 12 crops, whatever the map, while they are compared: 1,000 labels of ViT-L-14
(d = 768) take 3 MB, 100,000 take 310 MB, and 1,000,000 take 3.1 GB.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import OptionsError

# Labels compared at once: a block stays in the processor's cache, between product and selection.
_BLOCK = 2048


@dataclass(frozen=True)
class LabelEmbeddings:
    """The embeddings of a map's labels, each different label once. An array (L, d) to NumPy.

    Parameters
    ----------
    unique : ndarray (U, d) float32
        Unit rows, one for each different label.
    of_landmarks : ndarray (L,) of int
        The row of each landmark's label; every row is some landmark's.
    """

    unique: NDArray[np.float32]
    of_landmarks: NDArray[np.int64]

    @staticmethod
    def of(embeddings: 'LabelEmbeddings | NDArray[np.float32]') -> 'LabelEmbeddings':
        """Return embeddings (L, d), one for each landmark, as if all labels differed."""
        if isinstance(embeddings, LabelEmbeddings):
            return embeddings
        return LabelEmbeddings(embeddings, np.arange(len(embeddings)))

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of landmarks, and of an embedding's numbers."""
        return len(self.of_landmarks), self.unique.shape[1]

    @cached_property
    def landmarks(self) -> NDArray[np.int64]:
        """Return the landmarks (L,), those of one label together, in the map's order."""
        return np.argsort(self.of_landmarks, kind='stable')

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Return where each label's landmarks begin in landmarks (U + 1,)."""
        counts = np.bincount(self.of_landmarks, minlength=len(self.unique))
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the embedding of each landmark (L, d)."""
        return np.asarray(self.unique[self.of_landmarks], dtype=dtype)


@dataclass(frozen=True)
class CropSimilarities:
    """Cosine similarities of crops and landmarks, computed when they are asked for.

    An array (n, L) to NumPy.

    Parameters
    ----------
    crops : ndarray (n, d) float32
        Unit rows.
    labels : LabelEmbeddings
    """

    crops: NDArray[np.float32]
    labels: LabelEmbeddings

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of crops and of landmarks."""
        return len(self.crops), len(self.labels.of_landmarks)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the similarities (n, L)."""
        whole = self.crops @ self.labels.unique.T
        return np.asarray(whole[:, self.labels.of_landmarks], dtype=dtype)


Similarities = NDArray[np.float32] | CropSimilarities


def nearest_landmarks(similarities: Similarities, k: int
                      ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the k landmarks (n, k) most similar to each crop, best first, and how similar.

    Of equally similar ones those that the map has first.

    Parameters
    ----------
    similarities : ndarray (n, L) or CropSimilarities
    k : int
        1 to L.

    Raises
    ------
    OptionsError
        A similarity is not finite.
    """
    if not isinstance(similarities, CropSimilarities):
        return _nearest_columns(_column_blocks(similarities), len(similarities), k)
    labels = similarities.labels
    found, values = _nearest_columns(_label_blocks(similarities), len(similarities.crops),
                                     min(k, len(labels.unique)))
    if len(labels.unique) == len(labels.of_landmarks):
        landmarks = labels.landmarks[found]
        return _best(landmarks, values, k)
    return _expanded(labels, found, values, k)


def _column_blocks(similarities: NDArray[np.float32]
                   ) -> Iterator[tuple[int, NDArray[np.float32]]]:
    for start in range(0, similarities.shape[1], _BLOCK):
        yield start, similarities[:, start:start + _BLOCK]


def _label_blocks(similarities: CropSimilarities) -> Iterator[tuple[int, NDArray[np.float32]]]:
    unique = similarities.labels.unique
    for start in range(0, len(unique), _BLOCK):
        yield start, similarities.crops @ unique[start:start + _BLOCK].T


def _nearest_columns(blocks: Iterator[tuple[int, NDArray[np.float32]]], count: int, k: int
                     ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the k greatest of each row (count, k), as columns and values, best first."""
    columns = np.empty((count, 0), dtype=np.int64)
    values = np.empty((count, 0), dtype=np.float32)
    for start, block in blocks:
        if not np.isfinite(block).all():
            raise OptionsError('similarities hold values that are not finite')
        chosen = _greatest(block, k)
        columns = np.concatenate([columns, chosen + start], axis=1)
        values = np.concatenate([values, np.take_along_axis(block, chosen, axis=1)], axis=1)
        columns, values = _best(columns, values, k)
    return columns, values


def _greatest(block: NDArray[np.float32], k: int) -> NDArray[np.int64]:
    """Return the columns of each row's k greatest values, in no order; of equals the first."""
    count, width = block.shape
    if k >= width:
        return np.tile(np.arange(width), (count, 1))
    chosen = np.argpartition(block, width - k, axis=1)[:, width - k:]
    least = np.take_along_axis(block, chosen, axis=1).min(axis=1, keepdims=True)
    # partitions take any of equals
    for row in np.nonzero((block >= least).sum(axis=1) > k)[0]:
        chosen[row] = np.argsort(-block[row], kind='stable')[:k]
    return chosen


def _best(columns: NDArray[np.int64], values: NDArray[np.float32], k: int
          ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the k best of each row, best first, and of equals the lower column first."""
    order = np.lexsort((columns, -values), axis=1)[:, :k]
    return np.take_along_axis(columns, order, axis=1), np.take_along_axis(values, order, axis=1)


def _expanded(labels: LabelEmbeddings, found: NDArray[np.int64], values: NDArray[np.float32],
              k: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the k best landmarks of each row's best labels (n, <= k)."""
    counts = np.minimum(np.diff(labels.starts)[found], k)
    rows = np.repeat(np.arange(len(found)), counts.sum(axis=1))
    counts = counts.ravel()
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    landmarks = labels.landmarks[np.repeat(labels.starts[found.ravel()], counts) + within]
    alike = np.repeat(values.ravel(), counts)
    order = np.lexsort((landmarks, -alike, rows))
    ranks = np.arange(len(rows)) - np.searchsorted(rows, rows)
    taken = order[ranks < k]  # of each row at least k, since its k best labels have as many
    return landmarks[taken].reshape(-1, k), alike[taken].reshape(-1, k)


def pair_similarities(similarities: Similarities, crops: NDArray[np.int64],
                      landmarks: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the similarities (m,) of pairs of a crop (m,) and a landmark (m,)."""
    if not isinstance(similarities, CropSimilarities):
        return similarities[crops, landmarks]
    labels = similarities.labels.unique[similarities.labels.of_landmarks[landmarks]]
    return np.asarray(np.einsum('ij,ij->i', similarities.crops[crops], labels))


def sampled_similarities(similarities: Similarities, crops: NDArray[np.int64], most: int
                         ) -> NDArray[np.float32]:
    """Return the similarities (m, s) of crops (m,) with landmarks spread over the map.

    Of a small map these are all landmarks, of others at least half of the most asked for.
    """
    step = -(-similarities.shape[1] // most)
    if not isinstance(similarities, CropSimilarities):
        return similarities[crops, ::step]
    labels = similarities.labels.unique[similarities.labels.of_landmarks[::step]]
    return similarities.crops[crops] @ labels.T
