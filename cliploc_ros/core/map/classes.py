# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The landmarks of a map by detector class."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ClassIndex:
    """The landmarks of each class: L landmarks, C classes, m memberships.

    A landmark is a member of its own class, and of others that the detector takes it for.
    """

    numbers: Mapping[str, int]  #: Number of each class name, 0 to C - 1; own classes come first
    of_landmarks: NDArray[np.int64]  #: (L,): number of each landmark's own class
    #: (m,): landmarks grouped by class, in the map's order within a class
    landmarks: NDArray[np.int64]
    starts: NDArray[np.int64]  #: (C + 1,): where each class begins in landmarks
    #: Of (landmark, class), its share over that of the landmark's most frequent class, 0 to 1;
    #: missing ones count 1
    weights: Mapping[tuple[int, int], float] = field(default_factory=dict)

    @staticmethod
    def of(landmark_classes: Sequence[str], others: Sequence[tuple[int, str]] = (),
           weights: Mapping[tuple[int, str], float] | None = None) -> 'ClassIndex':
        """Return the index of a map's classes.

        Parameters
        ----------
        others : sequence of (int, str)
            A landmark and another class of it, each pair once.
        weights : mapping, optional
            Of a landmark and a class of it, see ClassIndex.
        """
        names = [*landmark_classes, *(name for _, name in others)]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        classes = np.array([numbers[name] for name in names], dtype=np.int64)
        count = len(landmark_classes)
        landmarks = np.append(np.arange(count), [row for row, _ in others]).astype(np.int64)
        return ClassIndex(numbers, classes[:count], landmarks[np.lexsort((landmarks, classes))],
                          np.append(0, np.cumsum(np.bincount(classes))).astype(np.int64),
                          {(row, numbers[name]): weight
                           for (row, name), weight in (weights or {}).items()})

    @cached_property
    def members(self) -> NDArray[np.int64]:
        """Return the landmark and the class of each membership (m, 2), in the map's order."""
        classes = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))
        order = np.argsort(self.landmarks, kind='stable')
        return np.column_stack([self.landmarks[order], classes[order]])

    def are_own(self, classes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each class (n,) is a landmark's own, not one that it is taken for."""
        return np.asarray((classes >= 0) & (classes <= self.of_landmarks.max(initial=-1)))

    def have(self, landmarks: NDArray[np.int64], classes: NDArray[np.int64]
             ) -> NDArray[np.bool_]:
        """Return whether landmarks (p,) are members of classes (p,); below 0 is no class."""
        # a class below 0 gets a key below 0, which no member has
        keys = np.where(classes < 0, -1, landmarks * (len(self.starts) - 1) + classes)
        return np.asarray((self.of_landmarks[landmarks] == classes)
                          | np.isin(keys, self._other_keys))

    def shares(self, landmarks: NDArray[np.int64], classes: NDArray[np.int64]
               ) -> NDArray[np.float64]:
        """Return how often landmarks (p,) have classes (p,), over their most frequent class.

        1 where nothing is known but that they have it, 0 where they do not have it.
        """
        known = [self.weights.get(pair, 1.0) for pair in zip(landmarks.tolist(), classes.tolist(),
                                                             strict=True)]
        return np.asarray(self.have(landmarks, classes) * np.array(known, dtype=np.float64))

    @cached_property
    def _other_keys(self) -> NDArray[np.int64]:
        """Return a key for each landmark and class of it that is not its own."""
        landmarks, classes = self.members.T
        other = classes != self.of_landmarks[landmarks]
        return np.asarray(landmarks[other] * (len(self.starts) - 1) + classes[other])

    def classes_of(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the number of each class name (n,); -1 for classes that the map lacks."""
        return np.array([self.numbers.get(name, -1) for name in names], dtype=np.int64)

    def sizes_of(self, classes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many landmarks each class (n,) has; 0 for classes below 0."""
        return np.where(classes >= 0, np.diff(self.starts)[classes], 0)

    def pairs(self, classes: NDArray[np.int64], order: NDArray[np.int64],
              limit: int | None = None) -> NDArray[np.int64]:
        """Return the pairs (c, 2) of a detection and a landmark of its class.

        Parameters
        ----------
        classes : ndarray (n,) of int
            Class of each detection, see classes_of.
        order : ndarray (m,) of int
            The detections in the order in which they are paired.
        limit : int, optional
            The most pairs to return: the first ones.
        """
        taken = self.sizes_of(classes)[order]
        if limit is not None:
            taken = np.clip(limit - (np.cumsum(taken) - taken), 0, taken)
        detections = np.repeat(order, taken)
        within = np.arange(len(detections)) - np.repeat(np.cumsum(taken) - taken, taken)
        return np.column_stack([detections,
                                self.landmarks[self.starts[classes[detections]] + within]])
