# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's table: its ten methods on the same queries."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.transforms import pose_error

#: The ten rows of the paper's Table 1: class has no similarities to order candidates by.
METHODS = ('class_bf', 'class_ransac', 'clip_bf', 'clip_ransac', 'clip_prosac', 'clip_b-prosac',
           'hybrid_bf', 'hybrid_ransac', 'hybrid_prosac', 'hybrid_b-prosac')
LIMITS_M = (0.25, 0.5, 1.0)
Query = tuple[Observation, NDArray[np.float64]]


@dataclass(frozen=True)
class Row:
    """How a method did on all queries and trials.

    Parameters
    ----------
    method : str
        As the paper names it, matching_algorithm.
    errors_m : ndarray (trials, queries)
        Distance from the truth [m]; infinite where no pose was found.
    accepted : ndarray (trials, queries) of bool
        Which of the poses the default acceptance lets pass.
    search_ms : float
        Mean time of a search [ms]; of one cut short, what it took divided by its coverage.
    coverage : float
        Mean share of its samples that the search could try.
    """

    method: str
    errors_m: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    search_ms: float
    coverage: float

    def success(self, limit_m: float) -> float:
        """Return the share of poses within a distance of the truth."""
        return float((self.errors_m < limit_m).mean())


def measure(method: str, landmark_map: LandmarkMap, queries: Sequence[Query], *, trials: int,
            iterations: int, bf_budget_s: float, advance: Callable[[], object] = lambda: None
            ) -> Row:
    """Run a method on all queries, with other seeds in each trial.

    Parameters
    ----------
    method : str
        One of `METHODS`.
    landmark_map : LandmarkMap
    queries : sequence of (Observation, (4, 4) array)
        Each with the true map_from_camera.
    trials : int
        bf, which draws nothing, runs once.
    iterations : int
        Samples of a search.
    bf_budget_s : float
        bf is cut short after so long [s] a query.
    advance : callable, optional
        Called after each query.
    """
    matching, algorithm = method.split('_')
    exhaustive = algorithm == 'bf'
    found, errors, times_ms = [], [], []
    for seed in range(1 if exhaustive else trials):
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(
            matching=matching, algorithm=algorithm, iterations=iterations, random_seed=seed,
            k=min(3, len(landmark_map)),
            time_budget_s=bf_budget_s if exhaustive else float('inf')))
        relocalizer.warm_up()
        for observation, truth in queries:
            start = time.perf_counter()
            found.append(relocalizer.relocalize([observation]))
            elapsed_ms = (time.perf_counter() - start) * 1e3
            pose = found[-1].map_from_camera
            errors.append(np.inf if pose is None else pose_error(pose, truth)[0])
            times_ms.append(elapsed_ms / max(found[-1].coverage, 1e-9))
            advance()
    shape = -1, len(queries)
    return Row(method, np.array(errors).reshape(shape),
               np.array([result.accepted for result in found]).reshape(shape),
               float(np.mean(times_ms)), float(np.mean([result.coverage for result in found])))


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the table as Markdown, in the paper's order."""
    lines = ['| method | success .25 / .5 / 1 m | median error m | search ms | accepted: share, '
             'wrong by > 1 m |', '|---|---|---|---|---|']
    for row in rows:
        rates = ' / '.join(f'{row.success(limit):.2f}' for limit in LIMITS_M)
        wrong = int((row.accepted & ~(row.errors_m <= 1.0)).sum())
        cut = '' if row.coverage > 0.999 else f' ({row.coverage:.0%} tried)'
        lines.append(f'| {row.method} | {rates} | {np.median(row.errors_m):.3f} | '
                     f'{row.search_ms:,.0f}{cut} | {row.accepted.mean():.2f}, {wrong} of '
                     f'{row.errors_m.size} |')
    return '\n'.join(lines)
