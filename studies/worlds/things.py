# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Things indoors: their sizes, and the objects of a world."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import shape_matrices

#: Semi-axes [m] and height of the centre [m] of COCO's classes of things indoors. Means of the
#: ellipsoids of TUM fr3's two maps: keyboard, mouse, cell phone, book, bottle, cup, scissors and
#: teddy bear; tv between its monitors and a television. The others are guesses.
TYPICAL = {
    'chair': (0.25, 0.25, 0.45, 0.45), 'couch': (0.9, 0.45, 0.4, 0.4),
    'potted plant': (0.2, 0.2, 0.35, 0.5), 'bed': (1.0, 0.8, 0.3, 0.3),
    'dining table': (0.8, 0.5, 0.38, 0.38), 'toilet': (0.2, 0.3, 0.4, 0.4),
    'bench': (0.7, 0.2, 0.25, 0.25), 'refrigerator': (0.35, 0.35, 0.85, 0.85),
    'suitcase': (0.25, 0.15, 0.35, 0.35), 'backpack': (0.18, 0.14, 0.25, 0.3),
    'handbag': (0.18, 0.1, 0.15, 0.7), 'umbrella': (0.1, 0.1, 0.4, 0.45),
    'tv': (0.4, 0.08, 0.26, 1.3), 'clock': (0.15, 0.04, 0.15, 1.9),
    'microwave': (0.25, 0.18, 0.15, 1.1), 'oven': (0.3, 0.3, 0.4, 0.4),
    'sink': (0.28, 0.22, 0.1, 0.9), 'toaster': (0.14, 0.1, 0.1, 1.0),
    'laptop': (0.17, 0.12, 0.12, 0.85), 'keyboard': (0.24, 0.13, 0.07, 0.76),
    'mouse': (0.06, 0.05, 0.03, 0.76), 'cell phone': (0.05, 0.1, 0.03, 0.76),
    'book': (0.12, 0.17, 0.05, 0.8), 'vase': (0.08, 0.08, 0.15, 0.95),
    'bottle': (0.05, 0.05, 0.14, 0.88), 'wine glass': (0.04, 0.04, 0.1, 0.85),
    'cup': (0.07, 0.07, 0.09, 0.82), 'bowl': (0.09, 0.09, 0.05, 0.81),
    'scissors': (0.06, 0.11, 0.05, 0.77), 'teddy bear': (0.22, 0.16, 0.34, 0.6),
    'sports ball': (0.11, 0.11, 0.11, 0.11), 'fire hydrant': (0.15, 0.15, 0.4, 0.4),
}
CLASS_NAMES = tuple(sorted(TYPICAL))
#: What stands on the floor, what lies on a table, and what is on a shelf.
FURNITURE = ('chair', 'couch', 'potted plant', 'dining table', 'refrigerator', 'suitcase',
             'backpack', 'bench', 'teddy bear', 'sports ball', 'umbrella')
ON_TABLES = ('laptop', 'keyboard', 'mouse', 'cell phone', 'book', 'vase', 'bottle', 'cup', 'bowl',
             'scissors', 'handbag', 'teddy bear')
ON_SHELVES = ('bottle', 'book', 'cup', 'bowl', 'vase', 'wine glass', 'teddy bear', 'toaster')
ON_WALLS = ('tv', 'clock')
# Of each axis; volumes differ like those of the bottles, books and mice of TUM fr3, whose
# logarithms of the mean axis deviate by .11 to .17.
_GROWTH = (0.75, 1.3)


class Thing(NamedTuple):
    """One object: where its centre is [m], how it is turned [rad], and how it looks.

    Things of one class and model look alike.
    """

    name: str
    x: float
    y: float
    z: float
    yaw: float
    model: int
    whole: int = 0  #: Number of what it is a part of; 0 for a thing of its own


class Objects(NamedTuple):
    """The objects of a world, n of them."""

    class_ids: tuple[str, ...]
    models: NDArray[np.int64]  #: (n,): objects of one class and model look alike
    #: (n, 3): [m]
    centers: NDArray[np.float64]
    semi_axes: NDArray[np.float64]
    yaws: NDArray[np.float64]  #: (n,): about the vertical [rad]
    wholes: NDArray[np.int64]  #: (n,): what each is a part of; 0 for nothing else

    @property
    def quats_xyzw(self) -> NDArray[np.float64]:
        """Return the rotations (n, 4) from the objects' axes into the world's."""
        zero = np.zeros(len(self.yaws))
        return np.stack([zero, zero, np.sin(0.5 * self.yaws), np.cos(0.5 * self.yaws)], axis=1)

    @property
    def shapes(self) -> NDArray[np.float64]:
        """Return the shape matrices (n, 6), see cliploc_ros.core.geometry.ellipsoid."""
        return shape_matrices(self.semi_axes, self.quats_xyzw)


def rows_of(class_ids: Sequence[str]) -> list[int]:
    """Return the rows in CLASS_NAMES of classes."""
    return [CLASS_NAMES.index(name) for name in class_ids]


def make_objects(things: Sequence[Thing], rng: np.random.Generator) -> Objects:
    """Return things as objects; those of one class and model have the same size."""
    models = np.array([one.model for one in things])
    sizes = np.array([TYPICAL[CLASS_NAMES[row]][:3] for row in rows_of([
        one.name for one in things])])
    growth = {kind: rng.uniform(*_GROWTH, 3)
              for kind in dict.fromkeys((one.name, one.model) for one in things)}
    sizes *= [growth[one.name, one.model] for one in things]
    return Objects(tuple(one.name for one in things), models,
                   np.array([[one.x, one.y, one.z] for one in things]), sizes,
                   np.array([one.yaw for one in things]), np.array([one.whole for one in things]))
