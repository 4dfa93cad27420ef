# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of the results of methods, and the paper's table of them as text and files."""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise, zip_longest
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from cliploc_ros.offline.evaluation.trials import GIVEN, GIVEN_TOLERANCE_MS, Result

#: Limits of success [m]. The paper does not state its own; 1 m reproduces its level.
LIMITS_M = (0.25, 0.5, 1.0)
_RESAMPLES = 10_000
_HEADER = ('matching', 'algorithm', 'success within .25 / .5 / 1 m',
           'median error [m], [deg]; mean [m]', 'search [ms]', 'accepted', 'precision (95 %)',
           'false accepts')
# In the terminal, headers are wrapped to this width.
_HEADER_WIDTH = 12
_WITHIN_NOISE = '~'
# Columns of methods that use keyframes; the other methods leave them empty.
_KEYFRAMES = ('from objects / keyframes / both', 'keyframe inliers', 'keyframes [ms]')
_SOURCES = ('objects', 'keyframes', 'both')
# Columns of the CSV that poses of another program leave empty.
_OF_SEARCHES = ('mean_search_ms', 'search_ms_std', 'coverage', 'accepted', 'precision_1m',
                'precision_1m_low', 'precision_1m_high', 'recall_1m', 'wrongly_accepted',
                'crops_share')
_OF_LATEX = {'\\': r'\textbackslash{}', '~': r'\textasciitilde{}', '^': r'\textasciicircum{}',
             '±': r'$\pm$', **{char: rf'\{char}' for char in '&%$#_{}'}}


@dataclass(frozen=True)
class Summary:
    """Results of one method on q queries in t trials."""

    method: str
    queries: tuple[int, ...]  #: Their numbers
    #: (t, q): position and rotation error of the best pose; infinite if none was found
    errors_m: NDArray[np.float64]
    errors_deg: NDArray[np.float64]
    accepted: NDArray[np.bool_]  #: (t, q)
    confidence: NDArray[np.float64]  #: (t, q)
    search_ms: NDArray[np.float64]  #: (t, q)
    coverage: NDArray[np.float64]  #: (t, q)
    #: (t, q)
    best_iterations: NDArray[np.int64]
    hypotheses: NDArray[np.int64]
    boxes: NDArray[np.int64]  #: (q,)
    #: (t, q): infinite if no pose was found; empty if it was not recorded
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
    #: (t, q): the three are empty if no query was compared with keyframes
    keyframes_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    #: Whether another program found the poses: there are errors only, no searches and verdicts
    is_given: bool = False

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
    def solved(self) -> float:
        """Return the share of searches that found any pose."""
        return float(np.isfinite(self.errors_m).mean())

    @property
    def median_error_m(self) -> float:
        """Return the median position error [m]; the error without a pose is infinite."""
        return float(np.median(self.errors_m))

    @property
    def median_error_deg(self) -> float:
        """Return the median rotation error [deg]; the error without a pose is infinite."""
        return float(np.median(self.errors_deg))

    @property
    def mean_error_m(self) -> float:
        """Return the mean position error of the poses found [m]; NaN without any."""
        found = self.errors_m[np.isfinite(self.errors_m)]
        return float(found.mean()) if len(found) else float('nan')

    @property
    def error_deviations(self) -> tuple[float, float, float]:
        """Return the standard deviations over trials of median [m], median [deg] and mean [m].

        NaN where a trial has no finite value.
        """
        with np.errstate(invalid='ignore'):
            means = [errors[np.isfinite(errors)].mean() if np.isfinite(errors).any() else np.nan
                     for errors in self.errors_m]
            return (float(np.std(np.median(self.errors_m, axis=1))),
                    float(np.std(np.median(self.errors_deg, axis=1))), float(np.std(means)))

    @property
    def mean_search_ms(self) -> float:
        """Return the mean time of a search [ms]."""
        return float(self.search_ms.mean())

    @property
    def search_deviation_ms(self) -> float:
        """Return the standard deviation of the time over queries and trials [ms]."""
        return float(self.search_ms.std())

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

    The results are sorted by method, trial and query, as run_methods returns them.
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
        method, queries, column('error_m'), column('error_deg'), column('accepted'),
        column('confidence'), column('search_ms'), column('coverage'), column('best_iteration'),
        column('hypotheses'), column('boxes')[0], column('nees'),
        float(column('crops_share').mean()), dict(kinds.most_common()),
        is_given=results[0].source == GIVEN, **keyframes)


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
        Summaries of the same queries; the success of the other is subtracted.
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
    """Return the summary of the greatest success; with equal success, of the least error."""
    return max(summaries, key=lambda one: (one.success(limit_m), -one.median_error_m))


# ---- the table ----------------------------------------------------------------------------------


def table_rows(summaries: Sequence[Summary]) -> list[tuple[str, ...]]:
    """Return the cells of the table, its header first.

    A '~' marks methods that the queries are too few to separate from the best one. A column has
    the share of solved queries where a method left some unsolved. Where a method used keyframes,
    there are columns for the source of its poses. All summaries are of the same queries.
    """
    best = find_best(summaries)
    rows = [_HEADER, *(_row(summary, best) for summary in summaries)]
    if any(summary.solved < 1.0 for summary in summaries):
        solved = ['solved', *(_rate(summary.solved) for summary in summaries)]
        rows = [(*row, cell) for row, cell in zip(rows, solved, strict=True)]
    if not any(summary.has_keyframes for summary in summaries):
        return rows
    cells = [(' / '.join(str(int((summary.sources == source).sum())) for source in _SOURCES),
              f'{np.median(summary.keyframe_inliers):.0f}', f'{summary.keyframes_ms.mean():.1f}')
             if summary.has_keyframes else ('',) * len(_KEYFRAMES) for summary in summaries]
    return [row + more for row, more in zip(rows, [_KEYFRAMES, *cells], strict=True)]


def _row(one: Summary, best: Summary) -> tuple[str, ...]:
    matching, algorithm = (one.method.split('_', 1) if one.method in PAPER_METHODS
                           else (one.method, ''))
    several = len(one.errors_m) > 1
    rates = ' / '.join(
        _rate(one.success(limit)) + (f'±{_rate(one.success_deviation(limit))}' if several else '')
        for limit in LIMITS_M)
    if one is not best and compare(one, best).is_noise:
        rates += f' {_WITHIN_NOISE}'
    median_m, median_deg, mean_m = (
        f'{value:.{digits}f}' + (f'±{off:.{digits}f}' if several and np.isfinite(off) else '')
        for value, off, digits in zip(
            (one.median_error_m, one.median_error_deg, one.mean_error_m), one.error_deviations,
            (3, 2, 2), strict=True))
    errors = f'{median_m}, {median_deg}; {mean_m}'
    if one.is_given:
        return (matching, algorithm, rates, errors, '', '', '', '')
    cut = '' if one.coverage.min() == 1.0 else f' ({one.coverage.mean():.0%} tried)'
    return (matching, algorithm, rates, errors,
            f'{one.mean_search_ms:.1f}±{one.search_deviation_ms:.1f}{cut}',
            _rate(float(one.accepted.mean())),
            f'{_rate(one.precision())} ({" to ".join(map(_rate, one.precision_interval()))})',
            f'{one.false_accepts()} of {int(one.accepted.sum())}')


def _rate(value: float) -> str:
    return f'{value:.2f}'.removeprefix('0')


def notes(summaries: Sequence[Summary]) -> list[str]:
    """Return sentences that explain the table."""
    best = find_best(summaries)
    counts = [len(summary.errors_m) for summary in summaries if not summary.is_given]
    alone = ' (one of bf and auto, which draw no samples)' if min(counts) < max(counts) else ''
    over = 'trials, of the time over searches' if max(counts) > 1 else 'searches'
    lines = [f'{len(best.queries)} queries, trials: {max(counts)}{alone}; ± is the standard '
             f'deviation over {over}.',
             'Confidences are fitted on simulated worlds.']
    lines += [f'{one.method}: poses of another program; {np.isinf(one.errors_m).sum()} of '
              f'{len(one.queries)} queries have none within {GIVEN_TOLERANCE_MS} ms.'
              for one in summaries if one.is_given]
    lines += [f'{one.method} refused: {_kinds(one)}.' for one in summaries if one.refusals]
    lines += [f'{one.method} compared {one.crops_share:.0%} of the crops of a query with labels, '
              'on average: --crops all compares all.'
              for one in summaries if 0.0 < one.crops_share < 1.0]
    if any(summary.has_keyframes for summary in summaries):
        lines.append('Keyframes: number of poses from each source, median of the points that '
                     'agree, and mean time outside the search; --no-keyframes leaves them out.')
    if len(summaries) > 1:
        lines.append(f'{_WITHIN_NOISE}: the queries are too few to separate it from {best.method} '
                     '(at 1 m; paired bootstrap, 95 %).')
    return lines


def _kinds(one: Summary) -> str:
    return ', '.join(f'{count} {kind}' for kind, count in one.refusals.items())


def as_text(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for the terminal."""
    header, *body = rows
    titles = list(zip_longest(*(wrap(title, _HEADER_WIDTH) for title in header), fillvalue=''))
    widths = [max(map(len, column)) for column in zip(*titles, *body, strict=True)]
    rule = ['-' * width for width in widths]
    return '\n'.join(
        '  '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [*titles, rule, *body])


def as_markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ['| ' + ' | '.join(row) + ' |' for row in rows]
    return '\n'.join([lines[0], '|' + '---|' * len(rows[0]), *lines[1:]])


def as_latex(rows: Sequence[Sequence[str]]) -> str:
    """Return a table in LaTeX, for the package booktabs."""
    head, *body = [' & '.join(map(_latex, row)) + r' \\' for row in rows]
    columns = 'l' * len(rows[0])
    return '\n'.join([rf'\begin{{tabular}}{{{columns}}}', r'\toprule', head, r'\midrule', *body,
                      r'\bottomrule', r'\end{tabular}', ''])


def _latex(text: str) -> str:
    return ''.join(_OF_LATEX.get(char, char) for char in text)


def relative_errors(results: Iterable[Result], truth: Mapping[int, NDArray[np.float64]]
                    ) -> dict[str, tuple[float, float]]:
    """Return the median relative pose error [m, deg] of each method (Sturm et al. 2012).

    It is the error of the motion from each query to the next one in time, where both have a pose.
    Methods without such a pair are left out. The true poses are given by the number of the query.
    """
    errors: dict[str, list[tuple[float, float]]] = {}
    solved = [(result, np.array(result.map_from_camera)) for result in results
              if result.map_from_camera is not None]
    for (method, _), trial in groupby(solved, key=lambda one: (one[0].method, one[0].trial)):
        ordered = sorted(trial, key=lambda one: one[0].timestamp)
        for (one, pose), (following, next_pose) in pairwise(ordered):
            true = invert_transform(truth[one.query]) @ truth[following.query]
            errors.setdefault(method, []).append(
                pose_error(invert_transform(pose) @ next_pose, true))
    return {method: tuple(np.median(some, axis=0).tolist()) for method, some in errors.items()}


def as_csv(summaries: Sequence[Summary],
           relative: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Return a line of figures for each method, with its relative_errors."""
    best = find_best(summaries)
    rows: list[dict[str, Any]] = []
    for one in summaries:
        difference, (low, high) = compare(one, best), one.precision_interval()
        rows.append({
            'method': one.method, 'queries': len(one.queries), 'trials': len(one.errors_m),
            **{f'success_{limit:g}m': one.success(limit) for limit in LIMITS_M},
            **{f'success_{limit:g}m_std': one.success_deviation(limit) for limit in LIMITS_M},
            'solved': one.solved, 'median_error_m': one.median_error_m,
            'median_error_deg': one.median_error_deg, 'mean_error_m': one.mean_error_m,
            **dict(zip(('median_error_m_std', 'median_error_deg_std', 'mean_error_m_std'),
                       one.error_deviations, strict=True)),
            **dict(zip(('relative_error_m', 'relative_error_deg'),
                       (relative or {}).get(one.method, ('', '')), strict=True)),
            'mean_search_ms': one.mean_search_ms, 'search_ms_std': one.search_deviation_ms,
            'coverage': float(one.coverage.mean()),
            'accepted': float(one.accepted.mean()), 'precision_1m': one.precision(),
            'precision_1m_low': low, 'precision_1m_high': high, 'recall_1m': one.recall(),
            'wrongly_accepted': one.false_accepts(), 'less_than_best_1m': difference.mean,
            'less_than_best_low': difference.low, 'less_than_best_high': difference.high,
            'crops_share': one.crops_share, 'refused_by_kind': _kinds(one),
            **dict.fromkeys([*(f'from_{source}' for source in _SOURCES), 'keyframe_inliers',
                             'keyframes_ms'], '')})
        if one.has_keyframes:
            rows[-1] |= {f'from_{source}': float((one.sources == source).mean())
                         for source in _SOURCES}
            rows[-1] |= {'keyframe_inliers': float(np.median(one.keyframe_inliers)),
                         'keyframes_ms': float(one.keyframes_ms.mean())}
        if one.is_given:
            rows[-1] |= dict.fromkeys(_OF_SEARCHES, '')
    return csv_text(rows)


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows with equal names of columns as CSV, numbers with six digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator='\n')
    writer.writeheader()
    for row in rows:
        writer.writerow({name: f'{value:.6g}' if isinstance(value, float) else value
                         for name, value in row.items()})
    return text.getvalue()


def as_json(results: Sequence[Result]) -> str:
    """Return all results, one on each line."""
    lines = ',\n'.join(json.dumps(result.as_dict()) for result in results)
    return f'[\n{lines}\n]\n'
