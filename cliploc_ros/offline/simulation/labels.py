# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Similarities of crops and labels as CLIP might give them, simulated.

A label is a vector: a part of its class and a part of its words, each word a random direction.
So labels of equal text are equal, and labels that share words are alike. A crop is the vector of
what it shows and noise, more for small boxes. Level and spread are those of the simulation that
the project's figures are measured with (top-1 about 0.6 on TUM fr3); no recording of CLIP fits
them to a user's images.
"""

import re
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap

_SIZE = 256
#: Of a vector's square: what all objects of a class share.
CLASS_SHARE = 0.3
_NOISE = 0.43
# Of the noise's variance: what all crops of one landmark share.
_SHARED_NOISE = 0.3
_STOP_WORDS = frozenset((
    'a', 'an', 'and', 'at', 'by', 'from', 'in', 'is', 'of', 'on', 'or', 'seen', 'standing', 'the',
    'to', 'with'))


@dataclass(frozen=True)
class LabelModel:
    """Labels and classes as vectors: L landmarks."""

    labels: NDArray[np.float64]  #: (L, D): unit vectors
    biases: NDArray[np.float64]  #: (L, D): how all crops of a landmark differ from its label

    @staticmethod
    def of(landmark_map: LandmarkMap) -> 'LabelModel':
        """Return the model of a map's labels."""
        vectors = np.array([
            np.sqrt(CLASS_SHARE) * _direction(f'class {class_id}')
            + np.sqrt(1.0 - CLASS_SHARE) * _label_vector(landmark_map, row)
            for row, class_id in enumerate(landmark_map.class_ids)])
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        biases = [np.sqrt(_SIZE) * _direction(f'crops of {name}')
                  for name in landmark_map.landmark_ids]
        return LabelModel(vectors, np.array(biases))

    def similarities(self, shown: NDArray[np.int64], class_ids: tuple[str, ...],
                     bboxes_xyxy: NDArray[np.float64], rng: np.random.Generator
                     ) -> NDArray[np.float32]:
        """Return the similarities (n, L) of n crops.

        Parameters
        ----------
        shown : ndarray (n,) of int
            The landmark that each box shows, -1 for none.
        class_ids : tuple of str
            Detector class of each box.
        bboxes_xyxy : ndarray (n, 4)
            [px].
        """
        count = len(shown)
        biases, known = np.zeros((count, _SIZE)), shown >= 0
        biases[known] = self.biases[shown[known]]
        crops = np.array([np.sqrt(CLASS_SHARE) * _direction(f'class {name}')
                          for name in class_ids]).reshape(count, _SIZE)
        crops[known] = self.labels[shown[known]]
        noise = rng.normal(size=(count, _SIZE))
        noise[known] = shared_noise(biases[known], noise[known])
        return similarities_of(crops, _NOISE, noise, bboxes_xyxy, self.labels)


def shared_noise(biases: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the noise (n, D) of crops, a part of which all crops of an object share."""
    return np.asarray(np.sqrt(1.0 - _SHARED_NOISE) * noise + np.sqrt(_SHARED_NOISE) * biases)


def similarities_of(crops: NDArray[np.float64], strength: float, noise: NDArray[np.float64],
                    bboxes_xyxy: NDArray[np.float64], labels: NDArray[np.float64]
                    ) -> NDArray[np.float32]:
    """Return the similarities (n, L) of crops (n, D) with labels (L, D).

    The strength of the noise (n, D) is that of a box with sides of 64 px. Smaller boxes have more
    noise, and lower similarities.
    """
    sizes = np.sqrt(np.prod(np.maximum(bboxes_xyxy[:, 2:] - bboxes_xyxy[:, :2], 1.0), axis=1))
    levels = np.log2(sizes / 64.0)[:, None]
    seen = crops + strength * np.clip(1.0 - 0.45 * levels, 0.4, 2.2) * noise
    raised = (seen @ labels.T - 0.35) * 1.1 + 0.55 * levels
    return np.asarray(0.15 + 0.17 / (1.0 + np.exp(-raised)), dtype=np.float32)


def _label_vector(landmark_map: LandmarkMap, row: int) -> NDArray[np.float64]:
    """Return the mean vector of a landmark's labels."""
    labels = landmark_map.details[row].labels if landmark_map.details else None
    vectors = []
    for text, weight in labels or ((landmark_map.labels[row], 1.0),):
        words = [word for word in re.findall(r'\w+', text.lower()) if word not in _STOP_WORDS]
        vectors.append(weight * _unit(np.sum([*map(_direction, words or [text])], axis=0)))
    return _unit(np.sum(vectors, axis=0))


def _direction(text: str) -> NDArray[np.float64]:
    """Return the unit vector (D,) of a text: random, but always the same."""
    rng = np.random.default_rng(zlib.crc32(text.encode('utf-8', 'replace')))
    return _unit(rng.normal(size=_SIZE))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
