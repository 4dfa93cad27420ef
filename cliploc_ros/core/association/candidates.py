# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmark may a detection show? Candidates for sampling, and a mask for verification.

Matching types (Matsuzaki et al. 2024, Sec. IV-A3): *class* pairs equal detector classes, *clip*
each detection with the k landmarks whose labels match its crop best, *hybrid* samples from clip
and verifies with both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.association.similarities import (
    Similarities,
    nearest_landmarks,
    sampled_similarities,
)
from cliploc_ros.errors import OptionsError

MATCHINGS = ('class', 'clip', 'hybrid')
#: A k for each crop, see adaptive_candidates.
ADAPTIVE = 0
_ADAPTIVE_RANGE = 2, 8
# In deviations of the crop's similarity to the map's labels: what is nearer to the best than this
# may as well be the best. Of 17 rules tried it is the best one.
_ADAPTIVE_MARGIN = 0.5
# Of labels: so many tell a deviation to 2 %.
_LABELS_SAMPLED = 4096


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

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> 'Candidates':
        """Return some of the candidates."""
        return Candidates(self.detections[rows], self.landmarks[rows], self.ranks[rows],
                          self.similarities[rows])

    def ordered(self, *keys: NDArray[np.float64] | NDArray[np.int64]) -> 'Candidates':
        """Return the candidates sorted by keys, the first key first; ties keep their order."""
        return self.select(np.lexsort(keys[::-1]))


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


@dataclass(frozen=True)
class ClassIndex:
    """The landmarks of each class of a map: L landmarks, C classes.

    Parameters
    ----------
    numbers : mapping
        Number of each class name, 0 to C - 1.
    of_landmarks : ndarray (L,) of int
        Class number of each landmark.
    landmarks : ndarray (L,) of int
        Those of one class together, in the map's order.
    starts : ndarray (C + 1,) of int
        Where each class begins in landmarks.
    """

    numbers: Mapping[str, int]
    of_landmarks: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    starts: NDArray[np.int64]

    @staticmethod
    def of(landmark_classes: Sequence[str]) -> 'ClassIndex':
        """Return the index of a map's classes."""
        numbers = {name: number for number, name in enumerate(dict.fromkeys(landmark_classes))}
        of_landmarks = np.array([numbers[name] for name in landmark_classes], dtype=np.int64)
        return ClassIndex(numbers, of_landmarks, np.argsort(of_landmarks, kind='stable'),
                          np.append(0, np.cumsum(np.bincount(of_landmarks))).astype(np.int64))

    def classes_of(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the number of each name (n,); -1 for classes that the map does not have."""
        return np.array([self.numbers.get(name, -1) for name in names], dtype=np.int64)

    def sizes_of(self, classes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many landmarks each class (n,) has."""
        return np.where(classes >= 0, np.diff(self.starts)[classes], 0)

    def candidates(self, classes: NDArray[np.int64], *, rarest_first: bool = False,
                   limit: int | None = None) -> Candidates:
        """Return pairs of equal class, detection by detection, no more than a limit.

        Parameters
        ----------
        classes : ndarray (n,) of int
            Of each detection, see classes_of.
        rarest_first : bool
            Begin with detections whose class has few landmarks: there a pair is the likelier to
            be right.
        limit : int, optional
        """
        sizes = self.sizes_of(classes)
        order = np.argsort(sizes, kind='stable') if rarest_first else np.arange(len(classes))
        taken = sizes[order]
        if limit is not None:
            taken = np.clip(limit - (np.cumsum(taken) - taken), 0, taken)
        detections = np.repeat(order, taken)
        within = np.arange(len(detections)) - np.repeat(np.cumsum(taken) - taken, taken)
        landmarks = self.landmarks[self.starts[classes[detections]] + within]
        zeros = np.zeros(len(detections))
        return Candidates(detections, landmarks, zeros.astype(np.int64), zeros)


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


def adaptive_candidates(similarities: Similarities) -> Candidates:
    """Return as many of the most similar landmarks of each detection as may as well be the best.

    A crop that tells one label from all others has two candidates, one that many labels of the
    map fit equally well has eight.

    Parameters
    ----------
    similarities : ndarray (n, L) or CropSimilarities
        Cosine similarity of each crop and label.
    """
    detections, landmarks = similarities.shape
    least, most = _ADAPTIVE_RANGE
    nearest = nearest_candidates(similarities, min(most, landmarks))
    spread = sampled_similarities(similarities, np.arange(detections), _LABELS_SAMPLED)
    best = nearest.similarities[nearest.ranks == 0]
    margins = best - _ADAPTIVE_MARGIN * spread.std(axis=1)
    return nearest.select((nearest.ranks < least)
                          | (nearest.similarities >= margins[nearest.detections]))


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


def joined(first: Candidates, second: Candidates, landmark_count: int) -> Candidates:
    """Return the candidates of both, those of the first before what the second adds.

    Parameters
    ----------
    first, second : Candidates
    landmark_count : int
        Of the map.
    """
    known = first.detections * landmark_count + first.landmarks
    new = np.nonzero(~np.isin(second.detections * landmark_count + second.landmarks, known))[0]
    return Candidates(np.concatenate([first.detections, second.detections[new]]),
                      np.concatenate([first.landmarks, second.landmarks[new]]),
                      np.concatenate([first.ranks, second.ranks[new]]),
                      np.concatenate([first.similarities, second.similarities[new]]))
