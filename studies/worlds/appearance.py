# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Similarities of crops and labels in a simulated world, from a weak or a strong encoder.

Objects are vectors: a part of their class, and a part of their model, which is how they look. A
crop is the vector of its object and noise, see cliploc_ros.offline.simulation.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.offline.simulation import CLASS_SHARE, shared_noise, similarities_of
from studies.worlds.things import CLASS_NAMES, rows_of

_SIZE = 128
# Of a vector's square: what tells an object from other ones of its model.
_OWN_SHARE = 0.1
# Top-1 rates of .85 to .4. The demo's CLIP, which knows its room, has .91. The simulated
# similarities of TUM fr3 have .52 to .54, those of a weak encoder.
_NOISE = (0.15, 0.6)


class Encoder(NamedTuple):
    """A simulated encoder: the vectors of classes (C, D), and the noise of its crops."""

    classes: NDArray[np.float64]
    noise: float

    @staticmethod
    def random(rng: np.random.Generator) -> 'Encoder':
        """Return a weak or a strong encoder."""
        return Encoder(_directions(len(CLASS_NAMES), rng), rng.uniform(*_NOISE))

    def vectors(self, class_ids: tuple[str, ...], models: NDArray[np.int64],
                rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the vectors (n, D) of n objects, of unit length."""
        looks = {kind: _directions(1, rng)[0]
                 for kind in dict.fromkeys(zip(class_ids, models.tolist(), strict=True))}
        rows = rows_of(class_ids)
        shared = np.array([looks[kind] for kind in zip(class_ids, models.tolist(), strict=True)])
        found = (np.sqrt(CLASS_SHARE) * self.classes[rows]
                 + np.sqrt(1.0 - CLASS_SHARE - _OWN_SHARE) * shared
                 + np.sqrt(_OWN_SHARE) * _directions(len(rows), rng))
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    def unknown(self, class_ids: tuple[str, ...]) -> NDArray[np.float64]:
        """Return the vectors (n, D) of crops that show nothing but look like some class."""
        return np.asarray(np.sqrt(CLASS_SHARE) * self.classes[rows_of(class_ids)])

    def biases(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return how all crops of each object differ from its vector (n, D)."""
        return np.asarray(rng.normal(size=(count, _SIZE)))

    def similarities(self, crops: NDArray[np.float64], biases: NDArray[np.float64],
                     bboxes_xyxy: NDArray[np.float64], labels: NDArray[np.float64],
                     rng: np.random.Generator) -> NDArray[np.float32]:
        """Return the similarities (n, L) of n crops and L labels."""
        noise = shared_noise(biases, rng.normal(size=crops.shape))
        return similarities_of(crops, self.noise, noise, bboxes_xyxy, labels)


def _directions(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return random unit vectors (count, D)."""
    found = rng.normal(size=(count, _SIZE))
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
