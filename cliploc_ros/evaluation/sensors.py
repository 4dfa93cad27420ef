# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot knows besides its image, made of the true poses and of noise: simulated."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.evaluation.trials import Query


def with_vertical(queries: Sequence[Query], noise_deg: float = 0.0, seed: int = 0
                  ) -> tuple[Query, ...]:
    """Return queries that know the vertical, as an accelerometer does.

    Parameters
    ----------
    queries : sequence of Query
    noise_deg : float
        Standard deviation of the angle by which each vertical is turned, about a level axis of
        random direction [deg].
    seed : int
        Equal seeds give equal noise, whatever the queries' order.
    """
    found = []
    for query in queries:
        rng = np.random.default_rng([seed, query.number])
        up = _turned(query.map_from_camera[2, :3], np.radians(noise_deg) * rng.normal(), rng)
        found.append(replace(query, observation=replace(query.observation, up_in_camera=up)))
    return tuple(found)


def _turned(direction: NDArray[np.float64], angle: float, rng: np.random.Generator
            ) -> NDArray[np.float64]:
    """Return a direction turned by an angle [rad] about a random axis perpendicular to it."""
    axis = np.cross(direction, rng.normal(size=3))
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    return np.asarray(turn.apply(direction))
