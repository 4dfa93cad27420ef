# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot knows before its camera shows anything: right, wrong, and at a twin."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.look_alikes import find_alike
from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import OPTICAL_FROM_BODY, Region
from cliploc_ros.offline.evaluation.trials import PosedQuery
from studies.acceptance.places import ALL, LEVEL, ONE
from studies.acceptance.troubles import Trouble, World, unchanged

# A wrong region is further from the truth than this, where the map is large enough [m].
_WRONG_M, _TRIES = 2.5, 50
_PROBABILITY = 0.9
_MODES = (ONE, LEVEL, ALL)


def _told(landmark_map: LandmarkMap, query: PosedQuery, spot: NDArray[np.float64],
          deviations: Sequence[float], rng: np.random.Generator) -> PosedQuery:
    """Return a query with a region around a spot (3,): x, y and yaw, with an error like that."""
    region = Region(landmark_map.frame_id, spot + rng.normal(size=3) * deviations,
                    np.diag(deviations) ** 2, _PROBABILITY)
    return replace(query, observation=replace(query.observation, region=region))


def _spot_of(map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    body = map_from_camera @ OPTICAL_FROM_BODY
    return np.array([*body[:2, 3], np.arctan2(body[1, 0], body[0, 0])])


def tell(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], wrong: float,
         rng: np.random.Generator, deviations: Sequence[float]) -> World:
    """Tell each query where it is; a share of them is told another spot of the map."""
    low, high = landmark_map.centers[:, :2].min(axis=0), landmark_map.centers[:, :2].max(axis=0)
    found = []
    for query in queries:
        spot = _spot_of(query.map_from_camera)
        if rng.random() < wrong:
            others = np.c_[rng.uniform(low, high, (_TRIES, 2)), rng.uniform(-np.pi, np.pi, _TRIES)]
            away = np.linalg.norm(others[:, :2] - spot[:2], axis=1)
            far = np.nonzero(away > _WRONG_M)[0]
            spot = others[far[0] if len(far) else int(away.argmax())]
        found.append(_told(landmark_map, query, spot, deviations, rng))
    return landmark_map, found


def tell_twin(landmark_map: LandmarkMap, queries: Sequence[PosedQuery], wrong: float,
              rng: np.random.Generator, deviations: Sequence[float] = ()) -> World:
    """Keep the queries whose place has a twin; each is told, where there are deviations, the twin.

    The worst case: the map cannot tell the two, and what is told is wrong.
    """
    found = []
    for query in queries:
        alike = find_alike(landmark_map, query.map_from_camera[:3, 3])
        twins = [move @ query.map_from_camera for move in alike.moves]
        twins = [one for one in twins if np.linalg.norm(
            one[:2, 3] - query.map_from_camera[:2, 3]) > RIGHT_M]
        if twins and len(deviations):
            found.append(_told(landmark_map, query, _spot_of(twins[0]), deviations, rng))
        elif twins:
            found.append(query)
    return landmark_map, found


_REGION, _POSE = (1.0, 1.0, 10.0), (0.3, 0.3, np.radians(15.0))


def _of(change: Callable[..., World], deviations: Sequence[float]) -> Callable[..., World]:
    return partial(change, deviations=deviations)


#: What the robot is told, and the share of queries for which that is wrong.
PRIORS = {
    'nothing told': Trouble(unchanged, modes=_MODES),
    'region of 1 m': Trouble(_of(tell, _REGION), (0.0, 0.1, 1.0), _MODES),
    'pose to .3 m and 15 degrees': Trouble(_of(tell, _POSE), (0.0, 0.1, 1.0), _MODES),
    'a twin exists, nothing told': Trouble(tell_twin, modes=_MODES),
    'a twin exists, told the twin': Trouble(_of(tell_twin, _POSE), (1.0,), _MODES)}
