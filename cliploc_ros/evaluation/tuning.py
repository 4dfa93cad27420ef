# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choosing options on one half of the queries, and judging them on the other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.methods import Method
from cliploc_ros.evaluation.run import run_methods
from cliploc_ros.evaluation.summary import LIMITS_M, Summary, summarize
from cliploc_ros.evaluation.trials import Query, Result

#: What is tried, option after option; each starts from what the one before found.
GRID: dict[str, tuple[Any, ...]] = {
    'k': (1, 2, 3, 5, 8),
    'iou_threshold': (0.1, 0.15, 0.2, 0.25, 0.3),
    'iterations': (500, 1000, 2000, 5000, 10_000),
}
_LEAST_PRECISION = 0.99
# A dearer value must be better by more than this: half of the queries say no finer.
_WORTHWHILE = 0.01
_MIN_QUERIES = 8


@dataclass(frozen=True)
class Tuned:
    """What tuning chose, on which queries, and how that does on the others.

    Parameters
    ----------
    options : RelocalizerOptions
    before, after : Summary
        Of the options given and of those chosen, on the queries that did not choose.
    """

    options: RelocalizerOptions
    before: Summary
    after: Summary


def split(queries: Sequence[Query], seed: int) -> tuple[list[Query], list[Query]]:
    """Split queries into two halves at random, each in the order given.

    Raises
    ------
    OptionsError
        There are too few.
    """
    if len(queries) < _MIN_QUERIES:
        raise OptionsError(f'tuning needs at least {_MIN_QUERIES} queries, not {len(queries)}')
    chosen = np.zeros(len(queries), dtype=np.bool_)
    chosen[np.random.default_rng(seed).permutation(len(queries))[:len(queries) // 2]] = True
    return ([one for one, is_in in zip(queries, chosen, strict=True) if is_in],
            [one for one, is_in in zip(queries, chosen, strict=True) if not is_in])


def tune(landmark_map: LandmarkMap, start: RelocalizerOptions, queries: Sequence[Query], *,
         trials: int, workers: int, seed: int,
         advance: Callable[[list[Result]], object] = lambda results: None) -> Tuned:
    """Choose k, IoU threshold, number of samples and confidence asked for.

    Parameters
    ----------
    landmark_map : LandmarkMap
    start : RelocalizerOptions
        Where the search starts; matching and algorithm stay.
    queries : sequence of Query
    trials, workers : int
        As for run_methods.
    seed : int
        Of the split.
    advance : callable, optional
        Called as results come.
    """
    choosing, judging = split(queries, seed)

    def measure(options: Sequence[RelocalizerOptions], on: Sequence[Query]) -> list[Summary]:
        methods = [Method(f'{number}', one) for number, one in enumerate(options)]
        return summarize(run_methods(landmark_map, methods, on, trials=trials, workers=workers,
                                     advance=advance))

    chosen = start
    for name, values in candidates(start, len(landmark_map)).items():
        tried = [replace(chosen, **{name: value}) for value in values]
        chosen = _least_worthwhile(tried, measure(tried, choosing))
    confidence = least_confidence(measure([replace(chosen, min_confidence=0.0)], choosing)[0])
    chosen = replace(chosen, min_confidence=confidence)
    before, after = measure([start, chosen], judging)
    return Tuned(chosen, replace(before, method='as given'), replace(after, method='tuned'))


def candidates(start: RelocalizerOptions, landmarks: int) -> dict[str, list[Any]]:
    """Return the values to try of each option that matters, in rising order."""
    grid = {name: sorted({*values, getattr(start, name)}) for name, values in GRID.items()}
    grid['k'] = [k for k in grid['k'] if k <= landmarks]
    if not start.needs_similarities:
        del grid['k']
    if start.algorithm == 'bf':
        del grid['iterations']
    return grid


def count_searches(start: RelocalizerOptions, landmarks: int, queries: int, trials: int) -> int:
    """Return how many searches tuning makes."""
    trials = 1 if start.algorithm in ('auto', 'bf') else trials
    tried = sum(map(len, candidates(start, landmarks).values())) + 1
    return trials * (tried * (queries // 2) + 2 * (queries - queries // 2))


def _least_worthwhile(options: Sequence[RelocalizerOptions], summaries: Sequence[Summary]
                      ) -> RelocalizerOptions:
    """Return the first that is hardly worse than the best."""
    merits = [float(np.mean([one.success(limit) for limit in LIMITS_M])) for one in summaries]
    return next(one for one, merit in zip(options, merits, strict=True)
                if merit >= max(merits) - _WORTHWHILE)


def least_confidence(one: Summary, limit_m: float = 1.0) -> float:
    """Return the least confidence to ask for, so that believed poses are right often enough.

    Parameters
    ----------
    one : Summary
        Of options that ask for no confidence.
    limit_m : float
        What counts as right.

    Returns
    -------
    float
        With a precision of .99 on these queries; 1 if there is none.
    """
    confidence = one.confidence[one.accepted]
    right = (one.errors_m < limit_m)[one.accepted]
    levels: NDArray[np.float64] = np.unique(confidence)
    for level in levels:
        if right[confidence >= level].mean() >= _LEAST_PRECISION:
            return float(np.ceil(level * 10_000 - 1e-6) / 10_000)
    return 1.0


def as_parameter_file(options: RelocalizerOptions) -> str:
    """Return the options chosen as a ROS 2 parameter file for the relocalizer."""
    names = ('matching', 'algorithm', 'k', 'iterations', 'iou_threshold', 'min_confidence')
    values = {name: getattr(options, name) for name in names}
    return yaml.safe_dump({'relocalizer': {'ros__parameters': values}}, sort_keys=False)
