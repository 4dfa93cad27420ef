# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The landmarks of a map by detector class."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ClassIndex:
    """The landmarks of each class: L landmarks, C classes.

    Parameters
    ----------
    numbers : mapping
        Number of each class name, 0 to C - 1.
    of_landmarks : ndarray (L,) of int
        Class number of each landmark.
    landmarks : ndarray (L,) of int
        Landmarks grouped by class, in the map's order within a class.
    starts : ndarray (C + 1,) of int
        Where each class begins in landmarks.
    """

    numbers: Mapping[str, int]
    of_landmarks: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    starts: NDArray[np.int64]

    @staticmethod
    def of(landmark_classes: Sequence[str]) -> 'ClassIndex':
        """Return the index of a map's class names, one for each landmark."""
        numbers = {name: number for number, name in enumerate(dict.fromkeys(landmark_classes))}
        of_landmarks = np.array([numbers[name] for name in landmark_classes], dtype=np.int64)
        return ClassIndex(numbers, of_landmarks, np.argsort(of_landmarks, kind='stable'),
                          np.append(0, np.cumsum(np.bincount(of_landmarks))).astype(np.int64))

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
