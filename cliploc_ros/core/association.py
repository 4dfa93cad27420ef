# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmark may a detection show? Candidates for sampling, and a mask for verification.

Matching types (Matsuzaki et al. 2024, Sec. IV-A3): *class* pairs equal detector classes, *clip*
each detection with the k landmarks whose labels match its crop best, *hybrid* samples from clip
and verifies with both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.similarity import Similarities, nearest_landmarks
from cliploc_ros.errors import OptionsError

MATCHINGS = ('class', 'clip', 'hybrid')


@dataclass(frozen=True)
class Candidates:
    """Correspondence candidates, in the order in which a sampler prefers them.

    Parameters
    ----------
    detections, landmarks : ndarray (c,) of int
        Indices of the pair.
    ranks : ndarray (c,) of int
        0 for a detection's most similar landmark, 1 for the next, and so on.
    similarities : ndarray (c,)
        Cosine similarity of crop and label; 0 where only the class is known.
    """

    detections: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    ranks: NDArray[np.int64]
    similarities: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.detections)

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Return (detection, landmark) of each candidate (c, 2)."""
        return np.stack([self.detections, self.landmarks], axis=1)

    def ordered(self, *keys: NDArray[np.float64] | NDArray[np.int64]) -> 'Candidates':
        """Return the candidates sorted by keys, the first key first; ties keep their order."""
        order = np.lexsort(keys[::-1])
        return Candidates(self.detections[order], self.landmarks[order], self.ranks[order],
                          self.similarities[order])


def same_class(detection_classes: tuple[str, ...], landmark_classes: tuple[str, ...]
               ) -> NDArray[np.bool_]:
    """Return a mask (n, L): detection and landmark have the same class name."""
    numbers = {name: number for number, name in enumerate(dict.fromkeys(landmark_classes))}
    of_landmarks = np.array([numbers[name] for name in landmark_classes], dtype=np.int64)
    of_detections = np.array([numbers.get(name, -1) for name in detection_classes],
                             dtype=np.int64)
    return of_detections[:, None] == of_landmarks[None]


def class_candidates(mask: NDArray[np.bool_]) -> Candidates:
    """Return every pair of equal class as a candidate, detection by detection."""
    detections, landmarks = np.nonzero(mask)
    zeros = np.zeros(len(detections))
    return Candidates(detections, landmarks, zeros.astype(np.int64), zeros)


def rarest_first(candidates: Candidates, mask: NDArray[np.bool_]) -> Candidates:
    """Return candidates of equal class, those of few landmarks before those of many.

    Where a class has few landmarks, a pair is the likelier to be right.

    Parameters
    ----------
    candidates : Candidates
    mask : ndarray (n, L) of bool
        See same_class.
    """
    return candidates.ordered(mask.sum(axis=1)[candidates.detections])


def check_k(k: int, landmark_count: int) -> None:
    """Refuse with an OptionsError a k that the map cannot give."""
    if not 1 <= k <= landmark_count:
        raise OptionsError(f'k = {k}, but the map has {landmark_count} landmarks: '
                           f'set k to {landmark_count} or less')


def nearest_candidates(similarities: Similarities, k: int) -> Candidates:
    """Return the k most similar landmarks of each detection as candidates, best first.

    Parameters
    ----------
    similarities : ndarray (n, L) or CropSimilarities
        Cosine similarity of each crop and label.
    k : int
        1 to L.

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


def candidate_mask(candidates: Candidates, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask (n, L) that is true where a pair is a candidate."""
    mask = np.zeros(shape, dtype=np.bool_)
    mask[candidates.detections, candidates.landmarks] = True
    return mask


def prosac_order(candidates: Candidates) -> Candidates:
    """Return the candidates by falling similarity (Chum and Matas 2005)."""
    return candidates.ordered(-candidates.similarities)


def balanced_order(candidates: Candidates) -> Candidates:
    """Return all nearest landmarks by falling similarity, then all second-nearest, and so on.

    The order of B-PROSAC (Matsuzaki et al. 2024, Fig. 3): it keeps large, confident detections
    from filling the head of the list.
    """
    return candidates.ordered(candidates.ranks, -candidates.similarities)


def joined(first: Candidates, second: Candidates, shape: tuple[int, int]) -> Candidates:
    """Return the candidates of both, those of the first before what the second adds.

    Parameters
    ----------
    first, second : Candidates
    shape : tuple of int
        Number of detections and of landmarks.
    """
    new = np.nonzero(~candidate_mask(first, shape)[second.detections, second.landmarks])[0]
    return Candidates(np.concatenate([first.detections, second.detections[new]]),
                      np.concatenate([first.landmarks, second.landmarks[new]]),
                      np.concatenate([first.ranks, second.ranks[new]]),
                      np.concatenate([first.similarities, second.similarities[new]]))
