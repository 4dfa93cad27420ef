# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a method's results come to, and whether two methods differ by more than noise."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.evaluation.trials import Result

#: Poses nearer than these [m] are reported as success. The paper does not state its own; 1 m
#: reproduces its level.
LIMITS_M = (0.25, 0.5, 1.0)
_RESAMPLES = 10_000


@dataclass(frozen=True)
class Summary:
    """Results of one method on q queries in t trials.

    Parameters
    ----------
    method : str
    queries : tuple of int
        Their numbers.
    errors_m : ndarray (t, q)
        Distance of the best pose from the truth; infinite where none was found.
    accepted : ndarray (t, q) of bool
    confidence : ndarray (t, q)
    search_ms : ndarray (t, q)
    coverage : ndarray (t, q)
    best_iterations, hypotheses : ndarray (t, q) of int
    boxes : ndarray (q,) of int
    nees : ndarray (t, q)
        Infinite where no pose was found; empty where it was not recorded.
    """

    method: str
    queries: tuple[int, ...]
    errors_m: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    search_ms: NDArray[np.float64]
    coverage: NDArray[np.float64]
    best_iterations: NDArray[np.int64]
    hypotheses: NDArray[np.int64]
    boxes: NDArray[np.int64]
    nees: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))

    def success(self, limit_m: float) -> float:
        """Return the share of poses within a distance of the truth, believed or not."""
        return float((self.errors_m < limit_m).mean())

    def success_deviation(self, limit_m: float) -> float:
        """Return the standard deviation of the success over trials."""
        return float((self.errors_m < limit_m).mean(axis=1).std())

    @property
    def median_error_m(self) -> float:
        """Return the median error; a query without any pose counts as infinitely far."""
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

    def wrongly_accepted(self, limit_m: float = 1.0) -> int:
        """Return how many believed poses are farther from the truth than a limit."""
        return int((self.accepted & ~(self.errors_m < limit_m)).sum())

    def precision(self, limit_m: float = 1.0) -> float:
        """Return the share of believed poses that are right; 1 if none is believed."""
        believed = int(self.accepted.sum())
        return 1.0 - self.wrongly_accepted(limit_m) / believed if believed else 1.0

    def recall(self, limit_m: float = 1.0) -> float:
        """Return the share of right poses that are believed; 1 if none is right."""
        right = self.errors_m < limit_m
        return float(self.accepted[right].mean()) if right.any() else 1.0


def summarize(results: Iterable[Result]) -> list[Summary]:
    """Return a summary for each method, in their order.

    Parameters
    ----------
    results : iterable of Result
        By method, trial and query, as run_methods returns them.
    """
    return [_summary(method, list(rows))
            for method, rows in groupby(results, key=lambda result: result.method)]


def _summary(method: str, results: Sequence[Result]) -> Summary:
    queries = tuple(dict.fromkeys(result.query for result in results))

    def column(name: str) -> NDArray[Any]:
        return np.array([getattr(result, name) for result in results]).reshape(-1, len(queries))

    errors = [np.inf if result.error_m is None else result.error_m for result in results]
    return Summary(
        method, queries, np.array(errors).reshape(-1, len(queries)), column('accepted'),
        column('confidence'), column('search_ms'), column('coverage'), column('best_iteration'),
        column('hypotheses'), column('boxes')[0],
        np.array([np.inf if result.nees is None else result.nees for result in results]
                 ).reshape(-1, len(queries)))


@dataclass(frozen=True)
class Difference:
    """By how much a method succeeds more often than another, with its 95 % interval."""

    mean: float
    low: float
    high: float

    @property
    def is_noise(self) -> bool:
        """Return whether the queries are too few to tell the two apart."""
        return self.low <= 0.0 <= self.high


def compare(one: Summary, other: Summary, limit_m: float = 1.0, seed: int = 0) -> Difference:
    """Compare two methods on the same queries.

    The queries are drawn again and again, with replacement (the paired bootstrap, Efron and
    Tibshirani 1993): what another building's queries would have given is uncertain by that.

    Parameters
    ----------
    one, other : Summary
        Of the same queries.
    limit_m : float
        What counts as success.
    seed : int

    Returns
    -------
    Difference
        Success of the one less that of the other.
    """
    assert one.queries == other.queries
    gains = ((one.errors_m < limit_m).mean(axis=0) - (other.errors_m < limit_m).mean(axis=0))
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(gains), size=(_RESAMPLES, len(gains)))
    low, high = np.quantile(gains[drawn].mean(axis=1), (0.025, 0.975))
    return Difference(float(gains.mean()), float(low), float(high))


def find_best(summaries: Sequence[Summary], limit_m: float = 1.0) -> Summary:
    """Return the summary of the greatest success, of equals the one of the least error."""
    return max(summaries, key=lambda one: (one.success(limit_m), -one.median_error_m))
