# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One embedding for each landmark, made of all labels that describe it.

Different labels are encoded in parts, each once. U different labels of d numbers and R different
descriptions take 4 d (R + min(U, PART)) bytes while they load, besides their texts, and 4 d R
bytes afterwards.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from cliploc_ros.core.maps.landmark_details import WeightedLabels

#: The most labels that are encoded, cached and held at once: 134 MB of 512 numbers each.
PART = 65_536
# Descriptions that are mixed at once.
_BLOCK = 8_192


def mixed_rows(descriptions: Sequence[WeightedLabels],
               encode: Callable[[Sequence[str]], NDArray[np.float32]], embed_dim: int
               ) -> NDArray[np.float32]:
    """Return one embedding (R, embed_dim) for each description.

    It is the weighted mean of the embeddings of the labels, scaled to unit length. A single label
    keeps its embedding.

    Parameters
    ----------
    descriptions : sequence of R WeightedLabels
    encode : callable
        Returns the embeddings (m, embed_dim) of m labels, unit rows. It is called with sorted
        labels, at most PART at once.
    embed_dim : int
    """
    labels = sorted({label for one in descriptions for label, _ in one})
    weights = _weights(descriptions, labels)
    rows = np.zeros((len(descriptions), embed_dim), dtype=np.float32)
    for start in range(0, len(labels), PART):
        part = slice(start, start + PART)
        # passed on, not kept: the next part is encoded after this one is freed
        rows = _plus(rows, weights[:, part], encode(labels[part]))
    is_mixed = np.diff(weights.indptr) > 1
    for block in _blocks(len(rows)):
        lengths = np.sqrt(np.einsum('ij,ij->i', rows[block], rows[block]))
        rows[block] /= np.where(is_mixed[block], np.maximum(lengths, 1e-12), 1.0)[:, None]
    return rows


def _plus(rows: NDArray[np.float32], weights: csr_matrix, embeddings: NDArray[np.float32]
          ) -> NDArray[np.float32]:
    """Return rows with the weighted sums of some embeddings added, in the same memory."""
    for block in _blocks(len(rows)):
        rows[block] += weights[block] @ embeddings
    return rows


def _weights(descriptions: Sequence[WeightedLabels], labels: Sequence[str]) -> csr_matrix:
    """Return the share of each label in each description (R, U)."""
    columns = {label: column for column, label in enumerate(labels)}
    ends = np.cumsum([0, *map(len, descriptions)])
    shares = np.array([weight for one in descriptions for _, weight in one], dtype=np.float32)
    owners = np.repeat(np.arange(len(descriptions)), np.diff(ends))
    shares /= np.bincount(owners, shares, len(descriptions)).astype(np.float32)[owners]
    return csr_matrix((shares, [columns[label] for one in descriptions for label, _ in one], ends),
                      shape=(len(descriptions), len(labels)))


def _blocks(count: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]
