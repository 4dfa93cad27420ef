# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a method's results, and whether two methods differ by more than noise."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.evaluation.trials import Result

#: Limits of success [m]. The paper does not state its own; 1 m reproduces its level.
LIMITS_M = (0.25, 0.5, 1.0)
_RESAMPLES = 10_000


@dataclass(frozen=True)
class Summary:
    """Results of one method on q queries in t trials."""

    method: str
    queries: tuple[int, ...]  #: Their numbers
    #: (t, q): position error of the best pose; infinite where none was found
    errors_m: NDArray[np.float64]
    accepted: NDArray[np.bool_]  #: (t, q)
    confidence: NDArray[np.float64]  #: (t, q)
    search_ms: NDArray[np.float64]  #: (t, q)
    coverage: NDArray[np.float64]  #: (t, q)
    #: (t, q)
    best_iterations: NDArray[np.int64]
    hypotheses: NDArray[np.int64]
    boxes: NDArray[np.int64]  #: (q,)
    #: (t, q): infinite where no pose was found; empty where it was not recorded
    nees: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    #: Share of a query's crops that were compared with labels, on average
    crops_share: float = 1.0
    #: How many were refused, by kind, the most frequent first
    refusals: dict[str, int] = field(default_factory=dict)
    #: (t, q) of str: what each pose comes from, see Result
    sources: NDArray[np.str_] = field(default_factory=lambda: np.empty((0, 0), dtype=str))
    #: (t, q)
    keyframe_inliers: NDArray[np.int64] = field(
        default_factory=lambda: np.empty((0, 0), dtype=np.int64))
    #: (t, q): the three are empty where no query was compared with keyframes
    keyframes_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def has_keyframes(self) -> bool:
        """Return whether queries were compared with keyframes."""
        return self.sources.size > 0

    def success(self, limit_m: float) -> float:
        """Return the share of poses within a distance of the truth, accepted or not."""
        return float((self.errors_m < limit_m).mean())

    def success_deviation(self, limit_m: float) -> float:
        """Return the standard deviation of the success over trials."""
        return float((self.errors_m < limit_m).mean(axis=1).std())

    @property
    def median_error_m(self) -> float:
        """Return the median error [m]; a query without a pose counts as infinitely far."""
        return float(np.median(self.errors_m))

    @property
    def mean_error_m(self) -> float:
        """Return the mean error of the poses found [m]; NaN if there is none."""
        found = self.errors_m[np.isfinite(self.errors_m)]
        return float(found.mean()) if len(found) else float('nan')

    @property
    def mean_search_ms(self) -> float:
        """Return the mean time of a search [ms]."""
        return float(self.search_ms.mean())

    def false_accepts(self, limit_m: float = 1.0) -> int:
        """Return how many accepted poses are farther from the truth than a limit."""
        return int((self.accepted & ~(self.errors_m < limit_m)).sum())

    def precision(self, limit_m: float = 1.0) -> float:
        """Return the share of accepted poses that are right; 1 if none is accepted."""
        accepted = int(self.accepted.sum())
        return 1.0 - self.false_accepts(limit_m) / accepted if accepted else 1.0

    def precision_interval(self, limit_m: float = 1.0) -> tuple[float, float]:
        """Return the 95 % interval of the precision (Wilson); 0 to 1 if none is accepted.

        Trials of one query are not independent, so all trials count as one.
        """
        count = self.accepted.sum() / len(self.accepted)
        return wilson_interval(self.precision(limit_m) * count, count) if count else (0.0, 1.0)

    def recall(self, limit_m: float = 1.0) -> float:
        """Return the share of right poses that are accepted; 1 if none is right."""
        right = self.errors_m < limit_m
        return float(self.accepted[right].mean()) if right.any() else 1.0


def wilson_interval(right: float, count: float, deviations: float = 1.96) -> tuple[float, float]:
    """Return the 95 % interval of a share that was seen right times of count (Wilson 1927)."""
    share, square = right / count, deviations**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    half = deviations / (1 + square / count) * np.sqrt(
        share * (1 - share) / count + square / (4 * count**2))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def summarize(results: Iterable[Result]) -> list[Summary]:
    """Return a summary of each method, in their order.

    Parameters
    ----------
    results : iterable of Result
        Sorted by method, trial and query, as run_methods returns them.
    """
    return [_summary(method, list(rows))
            for method, rows in groupby(results, key=lambda result: result.method)]


def _summary(method: str, results: Sequence[Result]) -> Summary:
    queries = tuple(dict.fromkeys(result.query for result in results))

    def column(name: str) -> NDArray[Any]:
        values = [getattr(result, name) for result in results]
        values = [np.inf if value is None else value for value in values]
        return np.array(values).reshape(-1, len(queries))

    kinds = Counter(result.refusal_kind for result in results if result.refusal_kind)
    keyframes = {}
    if (column('keyframes_ms') > 0.0).any():
        keyframes = {'sources': column('source'), 'keyframe_inliers': column('keyframe_inliers'),
                     'keyframes_ms': column('keyframes_ms')}
    return Summary(
        method, queries, column('error_m'), column('accepted'), column('confidence'),
        column('search_ms'), column('coverage'), column('best_iteration'), column('hypotheses'),
        column('boxes')[0], column('nees'), float(column('crops_share').mean()),
        dict(kinds.most_common()), **keyframes)


@dataclass(frozen=True)
class Difference:
    """Success of one method less that of another, with its 95 % interval."""

    mean: float
    low: float
    high: float

    @property
    def is_noise(self) -> bool:
        """Return whether the queries are too few to separate the two."""
        return self.low <= 0.0 <= self.high


def compare(one: Summary, other: Summary, limit_m: float = 1.0, seed: int = 0) -> Difference:
    """Compare two methods on the same queries.

    The interval is that of the paired bootstrap (Efron and Tibshirani 1993): queries are drawn
    with replacement, 10,000 times.

    Parameters
    ----------
    one, other : Summary
        Of the same queries; the success of the other is subtracted.
    limit_m : float
        Limit of success.
    """
    assert one.queries == other.queries
    gains = ((one.errors_m < limit_m).mean(axis=0) - (other.errors_m < limit_m).mean(axis=0))
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(gains), size=(_RESAMPLES, len(gains)))
    low, high = np.quantile(gains[drawn].mean(axis=1), (0.025, 0.975))
    return Difference(float(gains.mean()), float(low), float(high))


def find_best(summaries: Sequence[Summary], limit_m: float = 1.0) -> Summary:
    """Return the summary of the greatest success; of equal ones that of the least error."""
    return max(summaries, key=lambda one: (one.success(limit_m), -one.median_error_m))
