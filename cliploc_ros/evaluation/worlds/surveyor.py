# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a simulated world, with what is wrong in maps: places, doubles, gaps, labels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.landmark_details import LandmarkDetails
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.evaluation.worlds.things import Objects

_MOVED_M = (0.3, 3.0)
_SHAPE_DEVIATION, _TILT_DEG = 0.08, 5.0


class Survey(NamedTuple):
    """A map, and the object that each landmark is and is described as (L,)."""

    landmark_map: LandmarkMap
    objects: NDArray[np.int64]
    described: NDArray[np.int64]


class MapErrors(NamedTuple):
    """Shares of landmarks with some error, and the deviation of all positions [m]."""

    sigma_m: float
    missing: float
    doubled: float
    moved: float
    mislabelled: float
    states_sigma: bool

    @staticmethod
    def random(rng: np.random.Generator) -> 'MapErrors':
        """Return the errors of an ordinary map. The ranges are guesses."""
        return MapErrors(rng.uniform(0.005, 0.04), rng.uniform(0.0, 0.25),
                         rng.uniform(0.0, 0.06), rng.uniform(0.0, 0.1), rng.uniform(0.0, 0.06),
                         bool(rng.random() < 0.5))


def survey(objects: Objects, errors: MapErrors, rng: np.random.Generator) -> Survey:
    """Return a map of some objects, with errors."""
    kept = np.nonzero(rng.random(len(objects.class_ids)) >= errors.missing)[0]
    if len(kept) < 3:  # a map of fewer localizes nothing
        kept = np.arange(len(objects.class_ids))
    rows = np.concatenate([kept, kept[rng.random(len(kept)) < errors.doubled]])
    described = rows.copy()
    wrong = np.nonzero(rng.random(len(rows)) < errors.mislabelled)[0]
    described[wrong] = rng.choice(rows, len(wrong))
    sigmas = errors.sigma_m * np.exp(0.4 * rng.normal(size=len(rows)))
    centers = objects.centers[rows] + sigmas[:, None] * rng.normal(size=(len(rows), 3))
    moved = rng.random(len(rows)) < errors.moved
    angles = rng.uniform(0.0, 2.0 * np.pi, len(rows))
    steps = np.where(moved, rng.uniform(*_MOVED_M, len(rows)), 0.0)
    centers[:, :2] += steps[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes = objects.semi_axes[rows] * np.exp(_SHAPE_DEVIATION * rng.normal(size=(len(rows), 3)))
    tilts = Rotation.from_rotvec(np.radians(_TILT_DEG) * rng.normal(size=(len(rows), 3)))
    names = tuple(objects.class_ids[row] for row in described)
    details = tuple(LandmarkDetails(position_sigma=float(one)) for one in sigmas) \
        if errors.states_sigma else ()
    return Survey(LandmarkMap(
        'map', tuple(f'{name.replace(" ", "_")}_{number}' for number, name in enumerate(names)),
        names, names, centers, axes,
        (tilts * Rotation.from_quat(objects.quats_xyzw[rows])).as_quat(), details),
        rows, described)
