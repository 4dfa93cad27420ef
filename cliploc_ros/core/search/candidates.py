# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correspondence candidates: the landmarks that a detection may show.

Matching types (Matsuzaki et al. 2024, Sec. IV-A3): *class* pairs equal detector classes, *clip*
each detection with the k landmarks whose labels are most similar to its crop, *hybrid* samples
from clip and verifies with both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.classes import ClassIndex
from cliploc_ros.core.map.similarities import Similarities, nearest_landmarks
from cliploc_ros.errors import OptionsError


@dataclass(frozen=True)
class Candidates:
    """Correspondence candidates, in the order in which a sampler prefers them."""

    #: (c,): indices of the pair
    detections: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    #: (c,): 0 for a detection's most similar landmark, 1 for the next, and so on
    ranks: NDArray[np.int64]
    #: (c,): cosine similarity of crop and label; 0 where only the class is known
    similarities: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.detections)

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Return (detection, landmark) of each candidate (c, 2)."""
        return np.stack([self.detections, self.landmarks], axis=1)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> 'Candidates':
        """Return some of the candidates."""
        return Candidates(self.detections[rows], self.landmarks[rows], self.ranks[rows],
                          self.similarities[rows])

    def moved(self, first: int) -> 'Candidates':
        """Return the candidates of a map whose landmarks begin at a row of several maps'."""
        return replace(self, landmarks=self.landmarks + first)

    def ordered(self, *keys: NDArray[np.float64] | NDArray[np.int64]) -> 'Candidates':
        """Return the candidates sorted by keys, the first key first; ties keep their order."""
        return self.select(np.lexsort(keys[::-1]))


def class_candidates(index: ClassIndex, classes: NDArray[np.int64]) -> Candidates:
    """Return every pair of equal class, detection by detection.

    Parameters
    ----------
    classes : ndarray (n,) of int
        Class of each detection, as the index numbers them; below 0 for none.
    """
    return _of_pairs(index.pairs(classes, np.arange(len(classes))))


def rarest_class_candidates(index: ClassIndex, classes: NDArray[np.int64], limit: int
                            ) -> Candidates:
    """Return pairs of equal class, at most limit, beginning with the rarest classes.

    The fewer landmarks a class has, the likelier a pair of it is right. Parameters are those of
    class_candidates.
    """
    rarest_first = np.argsort(index.sizes_of(classes), kind='stable')
    return _of_pairs(index.pairs(classes, rarest_first, limit))


def _of_pairs(pairs: NDArray[np.int64]) -> Candidates:
    zeros = np.zeros(len(pairs))
    return Candidates(pairs[:, 0], pairs[:, 1], zeros.astype(np.int64), zeros)


def check_k(k: int, landmark_count: int) -> None:
    """Refuse a k that exceeds the map with an OptionsError."""
    if not 1 <= k <= landmark_count:
        raise OptionsError(f'k = {k}, but the map has {landmark_count} landmarks: '
                           f'set k to {landmark_count} or less')


def nearest_candidates(similarities: Similarities, k: int) -> Candidates:
    """Return the k most similar landmarks of each detection as candidates, best first.

    Raises
    ------
    OptionsError
        The map has fewer than k landmarks.
    """
    detection_count, landmark_count = similarities.shape
    check_k(k, landmark_count)
    landmarks, values = nearest_landmarks(similarities, k)
    return Candidates(np.repeat(np.arange(detection_count), k), landmarks.ravel(),
                      np.tile(np.arange(k), detection_count), values.ravel().astype(np.float64))


def prosac_order(candidates: Candidates) -> Candidates:
    """Return the candidates by decreasing similarity (Chum and Matas 2005)."""
    return candidates.ordered(-candidates.similarities)


def balanced_order(candidates: Candidates) -> Candidates:
    """Return all nearest landmarks by decreasing similarity, then all second-nearest, and so on.

    The order of B-PROSAC (Matsuzaki et al. 2024, Fig. 3): it keeps large, confident detections
    from filling the head of the list.
    """
    return candidates.ordered(candidates.ranks, -candidates.similarities)


def concatenated(some: Sequence[Candidates]) -> Candidates:
    """Return the candidates of several lists, at least one, one list after the other."""
    return Candidates(np.concatenate([one.detections for one in some]),
                      np.concatenate([one.landmarks for one in some]),
                      np.concatenate([one.ranks for one in some]),
                      np.concatenate([one.similarities for one in some]))


def joined(first: Candidates, second: Candidates, landmark_count: int) -> Candidates:
    """Return the first candidates, followed by those of the second that are new."""
    known = first.detections * landmark_count + first.landmarks
    new = np.nonzero(~np.isin(second.detections * landmark_count + second.landmarks, known))[0]
    return concatenated([first, second.select(new)])
