# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compute statistics of results, and write the paper's table as text and files."""

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise, zip_longest
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cliploc_ros.core.geometry.transforms import SAME_ANSWER, invert_transform, pose_error
from cliploc_ros.offline.evaluation.methods import PAPER_METHODS
from cliploc_ros.offline.evaluation.trials import GIVEN, GIVEN_TOLERANCE_MS, Result

#: Limits of success [m]. The paper does not state its limit; 1 m reproduces its success rates.
LIMITS_M = (0.25, 0.5, 1.0)
#: Farther from the truth, a pose is wrong [m].
SUCCESS_M = LIMITS_M[-1]
_RESAMPLES = 10_000
_HEADER = ('matching', 'algorithm', 'success within .25 / .5 / 1 m',
           'median error [m], [deg]; mean [m]', 'search [ms]', 'accepted', 'precision (95 %)',
           'false accepts')
# Headers are wrapped to this width in the terminal.
_HEADER_WIDTH = 12
_WITHIN_NOISE = '~'
# Columns that are empty for methods without keyframes.
_KEYFRAMES = ('from objects / keyframes / both', 'keyframe inliers', 'keyframes [ms]')
_SOURCES = ('objects', 'keyframes', 'both')
# Columns of the CSV that are empty for poses of another program.
_OF_SEARCHES = ('mean_search_ms', 'search_ms_std', 'coverage', 'accepted', 'precision_1m',
                'precision_1m_low', 'precision_1m_high', 'recall_1m', 'wrongly_accepted',
                'crops_share')
# Columns of the LaTeX table, with their formats.
_LATEX = {'method': '', **dict.fromkeys(
    ('success_0.25m', 'success_0.5m', 'success_1m', 'accepted', 'precision_1m', 'median_error_deg',
     'mean_error_m'), '.2f'), 'median_error_m': '.3f', 'mean_search_ms': '.1f',
    'keyframes_ms': '.1f', 'wrongly_accepted': 'g'}
_OF_LATEX = {'\\': r'\textbackslash{}', '~': r'\textasciitilde{}', '^': r'\textasciicircum{}',
             '±': r'$\pm$', **{char: rf'\{char}' for char in '&%$#_{}'}}


@dataclass(frozen=True)
class Summary:
    """Results of one method on q queries in t trials."""

    method: str
    queries: tuple[int, ...]  #: Numbers of the queries
    crops_share: float  #: Mean share of a query's crops that were compared with labels
    refusals: Mapping[str, int]  #: Number of refusals by kind, the most frequent first
    #: (t, q): position and rotation error of the best pose; infinite if none was found
    errors_m: NDArray[np.float64]
    errors_deg: NDArray[np.float64]
    accepted: NDArray[np.bool_]  #: (t, q)
    confidence: NDArray[np.float64]  #: (t, q)
    search_ms: NDArray[np.float64]  #: (t, q)
    coverage: NDArray[np.float64]  #: (t, q)
    sources: NDArray[np.str_]  #: (t, q): source of each pose, see Result
    keyframe_inliers: NDArray[np.int64]  #: (t, q)
    keyframes_ms: NDArray[np.float64]  #: (t, q)
    nees: NDArray[np.float64]  #: (t, q): see Result; infinite if unknown

    @property
    def has_keyframes(self) -> bool:
        """Return whether queries were compared with keyframes."""
        return bool((self.keyframes_ms > 0.0).any())

    @property
    def is_given(self) -> bool:
        """Return whether another program found the poses: only the errors have a meaning then."""
        return bool((self.sources == GIVEN).any())

    @property
    def looks_right(self) -> bool:
        """Return whether the poses found mostly look in the right direction."""
        return bool(np.median([0.0, *self.errors_deg[np.isfinite(self.errors_deg)]])
                    <= SAME_ANSWER.angle_deg)

    def success(self, limit_m: float) -> float:
        """Return the share of poses within a limit of the truth, accepted or not."""
        return float((self.errors_m < limit_m).mean())

    @property
    def solved(self) -> float:
        """Return the share of searches that found any pose."""
        return float(np.isfinite(self.errors_m).mean())

    @property
    def spreads(self) -> dict[str, tuple[float, float]]:
        """Return success rates and errors [m] [deg], each with its deviation over trials.

        Without a pose, an error is infinite. The mean is that of the poses found; NaN without any.
        A deviation is NaN where a trial has no finite value.
        """
        def mean(errors: NDArray[np.float64]) -> float:
            found = errors[np.isfinite(errors)]
            return float(found.mean()) if len(found) else np.nan

        def spread(of: Callable[[Any], Any], values: NDArray[Any]) -> tuple[float, float]:
            return float(of(values)), float(np.std([of(trial) for trial in values]))

        with np.errstate(invalid='ignore'):
            return {f'success_{limit:g}m': spread(np.mean, self.errors_m < limit)
                    for limit in LIMITS_M} | {
                'median_error_m': spread(np.median, self.errors_m),
                'median_error_deg': spread(np.median, self.errors_deg),
                'mean_error_m': spread(mean, self.errors_m)}

    def false_accepts(self) -> int:
        """Return the number of accepted poses that are wrong."""
        return int((self.accepted & ~(self.errors_m < SUCCESS_M)).sum())

    @property
    def of_accepted(self) -> tuple[NDArray[np.float64], int]:
        """Return the errors [m] of accepted poses, and how many are in their 95 % ellipsoid."""
        return self.errors_m[self.accepted], int(
            (self.nees[self.accepted] < chdtri(6, 0.05)).sum())

    def precision(self) -> float:
        """Return the share of accepted poses that are correct; 1 if no pose is accepted."""
        accepted = int(self.accepted.sum())
        return 1.0 - self.false_accepts() / accepted if accepted else 1.0

    def precision_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the precision (Wilson); 0 to 1 if no pose is accepted.

        The trials of a query are not independent, so they count as one sample.
        """
        count = self.accepted.sum() / len(self.accepted)
        return wilson_interval(self.precision() * count, count) if count else (0.0, 1.0)

    def recall(self) -> float:
        """Return the share of correct poses that are accepted; 1 if no pose is correct."""
        correct = self.errors_m < SUCCESS_M
        return float(self.accepted[correct].mean()) if correct.any() else 1.0


def wilson_interval(right: float, count: float, deviations: float = 1.96) -> tuple[float, float]:
    """Return the 95 % interval of a proportion, `right` of `count` samples (Wilson 1927)."""
    share, square = right / count, deviations**2
    middle = (share + square / (2 * count)) / (1 + square / count)
    half = deviations / (1 + square / count) * np.sqrt(
        share * (1 - share) / count + square / (4 * count**2))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def summarize(results: Iterable[Result]) -> list[Summary]:
    """Return a summary of each method.

    The results must be sorted by method, trial and query, as run_methods returns them.
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
    return Summary(
        method, queries, float(column('crops_share').mean()), dict(kinds.most_common()),
        *map(column, ('error_m', 'error_deg', 'accepted', 'confidence', 'search_ms', 'coverage',
                      'source', 'keyframe_inliers', 'keyframes_ms', 'nees')))


class Difference(NamedTuple):
    """Difference of the success rates of two methods, with its 95 % interval."""

    mean: float
    low: float
    high: float

    @property
    def is_noise(self) -> bool:
        """Return whether the queries are too few to separate the two methods."""
        return self.low <= 0.0 <= self.high


def compare(one: Summary, other: Summary) -> Difference:
    """Compare two methods on the same queries; the success rate of `other` is subtracted.

    The interval is that of the paired bootstrap (Efron and Tibshirani 1993): queries are drawn
    with replacement, 10,000 times.
    """
    assert one.queries == other.queries
    gains = (one.errors_m < SUCCESS_M).mean(axis=0) - (other.errors_m < SUCCESS_M).mean(axis=0)
    drawn = np.random.default_rng(0).integers(len(gains), size=(_RESAMPLES, len(gains)))
    low, high = np.quantile(gains[drawn].mean(axis=1), (0.025, 0.975))
    return Difference(float(gains.mean()), float(low), float(high))


def find_best(summaries: Sequence[Summary]) -> Summary:
    """Return the summary of highest success; of equal ones, that of least median error.

    A method whose cameras look elsewhere (median) is not the best one.
    """
    return max(summaries, key=lambda each: (each.looks_right, each.success(SUCCESS_M),
                                            -float(np.median(each.errors_m))))


# ---- the table ----------------------------------------------------------------------------------


def table_rows(summaries: Sequence[Summary]) -> list[tuple[str, ...]]:
    """Return the cells of the table, its header first.

    A '~' marks methods that the queries are too few to separate from the best method. Columns are
    added for the share of solved queries if a method has unsolved queries, and for the sources of
    poses if a method used keyframes. All summaries must be of the same queries.
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


def _row(summary: Summary, best: Summary) -> tuple[str, ...]:
    matching, algorithm = (summary.method.split('_', 1) if summary.method in PAPER_METHODS
                           else (summary.method, ''))
    several, spreads = len(summary.errors_m) > 1, summary.spreads
    rates = ' / '.join(_rate(value) + (f'±{_rate(off)}' if several else '')
                       for name, (value, off) in spreads.items() if name.startswith('success'))
    if summary is not best and compare(summary, best).is_noise:
        rates += f' {_WITHIN_NOISE}'

    def error(name: str, digits: int) -> str:
        value, off = spreads[name]
        spread = f'±{off:.{digits}f}' if several and np.isfinite(off) else ''
        return f'{value:.{digits}f}{spread}'

    errors = (f'{error("median_error_m", 3)}, {error("median_error_deg", 2)}; '
              f'{error("mean_error_m", 2)}')
    if summary.is_given:
        return (matching, algorithm, rates, errors, '', '', '', '')
    cut = '' if summary.coverage.min() == 1.0 else f' ({summary.coverage.mean():.0%} tried)'
    interval = ' to '.join(map(_rate, summary.precision_interval()))
    return (matching, algorithm, rates, errors,
            f'{summary.search_ms.mean():.1f}±{summary.search_ms.std():.1f}{cut}',
            _rate(float(summary.accepted.mean())),
            f'{_rate(summary.precision())} ({interval})' if summary.accepted.any() else '-',
            f'{summary.false_accepts()} of {int(summary.accepted.sum())}')


def _rate(value: float) -> str:
    return f'{value:.2f}'.removeprefix('0')


def notes(summaries: Sequence[Summary]) -> list[str]:
    """Return sentences that explain the table."""
    best = find_best(summaries)
    counts = [len(summary.errors_m) for summary in summaries if not summary.is_given]
    alone = ' (1 for bf and auto, which draw no samples)' if min(counts) < max(counts) else ''
    over = 'trials, of the time over searches' if max(counts) > 1 else 'searches'
    lines = [f'{len(best.queries)} queries, trials: {max(counts)}{alone}; ± is the standard '
             f'deviation over {over}.',
             'Confidences are fitted on simulated worlds.']
    lines += [f'{summary.method}: poses of another program; {np.isinf(summary.errors_m).sum()} of '
              f'{len(summary.queries)} queries have none within {GIVEN_TOLERANCE_MS} ms.'
              for summary in summaries if summary.is_given]
    for summary in summaries:
        errors, inside = summary.of_accepted
        if errors.size:
            worst = int(np.where(summary.accepted, summary.errors_m, -1.0).max(axis=0).argmax())
            lines.append(f'{summary.method} accepted: worst error {errors.max():.2f} m (query '
                         f'{summary.queries[worst]} of results.json); {inside} of {errors.size} '
                         'poses in their 95 % ellipsoid.')
    lines += [f'{summary.method} refused: {_kinds(summary)}.'
              for summary in summaries if summary.refusals]
    lines += [f'{summary.method} compared {summary.crops_share:.0%} of the crops of a query with '
              'labels on average.'
              for summary in summaries if 0.0 < summary.crops_share < 1.0]
    if any(summary.has_keyframes for summary in summaries):
        lines.append('Keyframes: number of poses from each source, median number of inlier '
                     'points, mean time outside the search.')
    lines += [f'{summary.method}: the poses are turned by {np.median(summary.errors_deg):.0f} '
              'degrees (median), and success judges positions only.'
              for summary in summaries if not summary.looks_right]
    if any(_WITHIN_NOISE in cell for row in table_rows(summaries)[1:] for cell in row):
        lines.append(f'{_WITHIN_NOISE}: the queries are too few to separate it from {best.method} '
                     '(at 1 m; paired bootstrap, 95 %).')
    return lines


def _kinds(summary: Summary) -> str:
    return ', '.join(f'{count} {kind}' for kind, count in summary.refusals.items())


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


def as_latex(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the main columns of csv_rows in LaTeX, for booktabs, with one number in a cell."""
    names = [name for name in rows[0] if name in _LATEX or name.startswith('paper_')]
    lines = [[name.replace('_', ' ') for name in names], *(
        [f'{float(row[name]):{_LATEX[name]}}' if _LATEX.get(name) and row[name] != ''
         else str(row[name]) for name in names] for row in rows)]
    head, *body = [' & '.join(''.join(_OF_LATEX.get(char, char) for char in cell) for cell in line)
                   + r' \\' for line in lines]
    return '\n'.join([r'% needs \usepackage{booktabs}',
                      rf'\begin{{tabular}}{{l{"r" * len(names[1:])}}}', r'\toprule', head,
                      r'\midrule', *body, r'\bottomrule', r'\end{tabular}', ''])


def relative_errors(results: Iterable[Result], truth: Mapping[int, NDArray[np.float64]]
                    ) -> dict[str, tuple[float, float]]:
    """Return the median relative pose error [m, deg] of each method (Sturm et al. 2012).

    This is the error of the motion from each query with a pose to the next query with a pose.
    Methods with fewer than two poses are left out. `truth` has the true pose of each query by its
    number.
    """
    errors: dict[str, list[tuple[float, float]]] = {}
    solved = [(result, np.array(result.map_from_camera)) for result in results
              if result.map_from_camera is not None]
    for (method, _), trial in groupby(solved, key=lambda pair: (pair[0].method, pair[0].trial)):
        ordered = sorted(trial, key=lambda pair: pair[0].timestamp)
        for (result, pose), (next_result, next_pose) in pairwise(ordered):
            true = invert_transform(truth[result.query]) @ truth[next_result.query]
            errors.setdefault(method, []).append(
                pose_error(invert_transform(pose) @ next_pose, true))
    return {method: tuple(np.median(pairs, axis=0).tolist()) for method, pairs in errors.items()}


def csv_rows(summaries: Sequence[Summary],
             relative: Mapping[str, tuple[float, float]] | None = None) -> list[dict[str, Any]]:
    """Return the statistics of each method by name; `relative` comes from relative_errors."""
    best = find_best(summaries)
    rows: list[dict[str, Any]] = []
    for summary in summaries:
        difference, (low, high) = compare(summary, best), summary.precision_interval()
        spreads = summary.spreads
        values = {name: value for name, (value, _) in spreads.items()}
        values |= {f'{name}_std': deviation for name, (_, deviation) in spreads.items()}
        rates = {name: values.pop(name) for name in [*values] if name.startswith('success')}
        rows.append({
            'method': summary.method, 'queries': len(summary.queries),
            'trials': len(summary.errors_m), **rates, 'solved': summary.solved, **values,
            **dict(zip(('relative_error_m', 'relative_error_deg'),
                       (relative or {}).get(summary.method, ('', '')), strict=True)),
            'mean_search_ms': float(summary.search_ms.mean()),
            'search_ms_std': float(summary.search_ms.std()),
            'coverage': float(summary.coverage.mean()),
            'accepted': float(summary.accepted.mean()), 'precision_1m': summary.precision(),
            'precision_1m_low': low, 'precision_1m_high': high, 'recall_1m': summary.recall(),
            'wrongly_accepted': summary.false_accepts(), 'less_than_best_1m': difference.mean,
            'less_than_best_low': difference.low, 'less_than_best_high': difference.high,
            'crops_share': summary.crops_share, 'refused_by_kind': _kinds(summary),
            **dict.fromkeys([*(f'from_{source}' for source in _SOURCES), 'keyframe_inliers',
                             'keyframes_ms'], '')})
        if summary.has_keyframes:
            rows[-1] |= {f'from_{source}': float((summary.sources == source).mean())
                         for source in _SOURCES}
            rows[-1] |= {'keyframe_inliers': float(np.median(summary.keyframe_inliers)),
                         'keyframes_ms': float(summary.keyframes_ms.mean())}
        if not summary.accepted.any():
            rows[-1] |= dict.fromkeys([name for name in rows[-1] if 'precision' in name], '')
        if summary.is_given:
            rows[-1] |= dict.fromkeys(_OF_SEARCHES, '')
    return rows


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return CSV of rows that have equal columns. Numbers have six digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator='\n')
    writer.writeheader()
    for row in rows:
        writer.writerow({name: f'{value:.6g}' if isinstance(value, float) else value
                         for name, value in row.items()})
    return text.getvalue()
