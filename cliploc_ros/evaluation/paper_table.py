# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's table as text, Markdown and CSV, and all results as JSON."""

import csv
import io
import json
from collections.abc import Sequence

import numpy as np

from cliploc_ros.evaluation.methods import PAPER_METHODS
from cliploc_ros.evaluation.summary import LIMITS_M, Summary, compare, find_best
from cliploc_ros.evaluation.trials import Result

_HEADER = ('matching', 'algorithm', 'success at .25 / .5 / 1 m', 'error [m]: median, mean',
           'search [ms]', 'accepted', 'precision (95 %)', 'false accepts')
_WITHIN_NOISE = '~'
# Columns of methods that use keyframes; the other methods leave them empty.
_KEYFRAMES = ('pose by objects / keyframes / both', 'keyframe inliers', 'keyframes [ms]')
_SOURCES = ('objects', 'keyframes', 'both')


def table_rows(summaries: Sequence[Summary]) -> list[tuple[str, ...]]:
    """Return the cells of the table, its header first.

    A '~' marks methods that the queries are too few to separate from the best one. Where a method
    used keyframes, there are columns for the source of its poses.

    Parameters
    ----------
    summaries : sequence of Summary
        Of the same queries.
    """
    best = find_best(summaries)
    rows = [_HEADER, *(_row(one, best) for one in summaries)]
    if not any(one.has_keyframes for one in summaries):
        return rows
    cells = [(' / '.join(str(int((one.sources == source).sum())) for source in _SOURCES),
              f'{np.median(one.keyframe_inliers):.0f}', f'{one.keyframes_ms.mean():.1f}')
             if one.has_keyframes else ('',) * len(_KEYFRAMES) for one in summaries]
    return [row + more for row, more in zip(rows, [_KEYFRAMES, *cells], strict=True)]


def _row(one: Summary, best: Summary) -> tuple[str, ...]:
    matching, algorithm = (one.method.split('_', 1) if one.method in PAPER_METHODS
                           else (one.method, ''))
    rates = ' / '.join(_rate(one.success(limit)) for limit in LIMITS_M)
    if len(one.errors_m) > 1:
        rates += f' ± {_rate(one.success_deviation(LIMITS_M[-1]))}'
    if one is not best and compare(one, best).is_noise:
        rates += f' {_WITHIN_NOISE}'
    cut = '' if one.coverage.min() == 1.0 else f' ({one.coverage.mean():.0%} tried)'
    return (matching, algorithm, rates, f'{one.median_error_m:.3f}, {one.mean_error_m:.2f}',
            f'{one.mean_search_ms:.1f}{cut}', _rate(float(one.accepted.mean())),
            f'{_rate(one.precision())} ({" to ".join(map(_rate, one.precision_interval()))})',
            f'{one.false_accepts()} of {int(one.accepted.sum())}')


def _rate(value: float) -> str:
    return f'{value:.2f}'.removeprefix('0')


def notes(summaries: Sequence[Summary]) -> list[str]:
    """Return sentences that explain the table."""
    best = find_best(summaries)
    counts = [len(one.errors_m) for one in summaries]
    alone = ' (one of bf and auto, which draw no samples)' if min(counts) < max(counts) else ''
    over = '; ± is the standard deviation over trials, at 1 m' if max(counts) > 1 else ''
    lines = [f'{len(best.queries)} queries, trials: {max(counts)}{alone}{over}.',
             'Confidences are fitted on simulated worlds.']
    lines += [f'{one.method} refused: {_kinds(one)}.' for one in summaries if one.refusals]
    lines += [f'{one.method} compared {one.crops_share:.0%} of the crops of a query with labels, '
              'on average: --crops all compares all.'
              for one in summaries if 0.0 < one.crops_share < 1.0]
    if any(one.has_keyframes for one in summaries):
        lines.append('Keyframes: number of poses from each source, median of the points that '
                     'agree, and mean time besides the search; --no-keyframes leaves them out.')
    if len(summaries) > 1:
        lines.append(f'{_WITHIN_NOISE}: the queries are too few to separate it from {best.method} '
                     '(at 1 m; paired bootstrap, 95 %).')
    return lines


def _kinds(one: Summary) -> str:
    return ', '.join(f'{count} {kind}' for kind, count in one.refusals.items())


def as_text(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for the terminal."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ['  '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
             for row in rows]
    return '\n'.join([lines[0], '-' * len(lines[0]), *lines[1:]])


def as_markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ['| ' + ' | '.join(row) + ' |' for row in rows]
    return '\n'.join([lines[0], '|' + '---|' * len(rows[0]), *lines[1:]])


def as_csv(summaries: Sequence[Summary]) -> str:
    """Return a line of figures for each method."""
    best = find_best(summaries)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(['method', 'queries', 'trials', *(f'success_{limit:g}m' for limit in LIMITS_M),
                     *(f'success_{limit:g}m_std' for limit in LIMITS_M), 'median_error_m',
                     'mean_error_m', 'mean_search_ms', 'coverage', 'accepted', 'precision_1m',
                     'precision_1m_low', 'precision_1m_high', 'recall_1m', 'wrongly_accepted',
                     'less_than_best_1m', 'less_than_best_low', 'less_than_best_high',
                     'crops_share', 'refused_by_kind', *(f'from_{source}' for source in _SOURCES),
                     'keyframe_inliers', 'keyframes_ms'])
    for one in summaries:
        difference = compare(one, best)
        writer.writerow([
            one.method, len(one.queries), len(one.errors_m),
            *(one.success(limit) for limit in LIMITS_M),
            *(one.success_deviation(limit) for limit in LIMITS_M), one.median_error_m,
            one.mean_error_m, one.mean_search_ms, float(one.coverage.mean()),
            float(one.accepted.mean()), one.precision(), *one.precision_interval(), one.recall(),
            one.false_accepts(), difference.mean, difference.low, difference.high,
            one.crops_share, _kinds(one),
            *([*(float((one.sources == source).mean()) for source in _SOURCES),
               float(np.median(one.keyframe_inliers)), float(one.keyframes_ms.mean())]
              if one.has_keyframes else [''] * 5)])
    return text.getvalue()


def as_json(results: Sequence[Result]) -> str:
    """Return all results, one on each line."""
    lines = ',\n'.join(json.dumps(result.as_dict()) for result in results)
    return f'[\n{lines}\n]\n'
