# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of results, and what is noise."""


import numpy as np
import pytest

from cliploc_ros.offline.evaluation.figures import (
    precision_recall,
)
from cliploc_ros.offline.evaluation.summary import (
    Summary,
    as_markdown,
    as_text,
    compare,
    find_best,
    notes,
    summarize,
    table_rows,
    wilson_interval,
)
from cliploc_ros.offline.evaluation.trials import Result


def make_summary(errors, method='auto', accepted=None, confidence=None):
    errors = np.atleast_2d(np.array(errors, dtype=float))
    shape = errors.shape
    return Summary(
        method, tuple(range(shape[1])), errors,
        np.zeros(shape, bool) if accepted is None else np.atleast_2d(accepted),
        np.zeros(shape) if confidence is None else np.atleast_2d(confidence), np.full(shape, 2.0),
        np.ones(shape), np.ones(shape, int), np.full(shape, 500), np.full(shape[1], 5))


def make_result(**changes):
    fields = {
        'method': 'clip_bf', 'trial': 0, 'query': 3, 'timestamp': 1.5, 'boxes': 4, 'solved': True,
        'accepted': True, 'map_from_camera': np.eye(4).tolist(), 'error_m': 0.5, 'error_deg': 2.0,
        'score': 3.0, 'confidence': 0.5, 'nees': 3.0, 'inliers': 4, 'hypotheses': 9,
        'best_iteration': 2, 'coverage': 1.0, 'reason': '', 'search_ms': 1.0}
    return Result(**(fields | changes))


def test_success_and_errors():
    one = make_summary([[0.1, 0.4, np.inf, 3.0], [0.1, 0.9, 0.2, 3.0]])
    assert one.success(0.25) == 3 / 8
    assert one.success(1.0) == 5 / 8
    assert one.success_deviation(1.0) == pytest.approx(0.125)
    assert one.median_error_m == pytest.approx((0.4 + 0.9) / 2)
    assert one.mean_error_m == pytest.approx((0.1 + 0.4 + 3.0 + 0.1 + 0.9 + 0.2 + 3.0) / 7)


def test_precision_and_recall():
    one = make_summary([0.1, 0.4, 2.0, np.inf], accepted=[True, False, True, False])
    assert (one.false_accepts(), one.precision(), one.recall()) == (1, 0.5, 0.5)
    none = make_summary([np.inf, np.inf])
    assert (none.precision(), none.recall()) == (1.0, 1.0)
    assert none.precision_interval() == (0.0, 1.0)
    assert np.isnan(none.mean_error_m)


def test_the_interval_of_the_precision_counts_queries():
    """Trials of one query are not independent, so more trials do not narrow it."""
    once = make_summary([0.1] * 10, accepted=[True] * 10)
    often = make_summary([[0.1] * 10] * 5, accepted=[[True] * 10] * 5)
    assert once.precision_interval() == (pytest.approx(0.722, abs=1e-3), 1.0)
    assert often.precision_interval() == once.precision_interval()


def test_wilson_interval():
    low, high = wilson_interval(10, 10)
    assert (low, high) == (pytest.approx(0.722, abs=1e-3), 1.0)
    low, high = wilson_interval(5, 10)
    assert (low, high) == (pytest.approx(0.237, abs=1e-3), pytest.approx(0.763, abs=1e-3))


def test_summaries_keep_the_order_and_the_missing():
    results = [make_result(trial=trial, query=query, error_m=None if query == 7 else 0.1 * trial)
               for trial in range(3) for query in (3, 7)]
    one, = summarize(results)
    assert one.queries == (3, 7)
    assert one.errors_m.tolist() == [[0.0, np.inf], [0.1, np.inf], [0.2, np.inf]]


def test_what_is_noise():
    good, same = make_summary([0.1] * 50), make_summary([0.1] * 50)
    bad = make_summary([2.0] * 25 + [0.1] * 25)
    assert compare(good, same).is_noise
    assert not compare(good, bad).is_noise
    assert compare(good, bad).mean == 0.5
    slightly = make_summary([2.0] * 2 + [0.1] * 48)
    assert compare(good, slightly).is_noise


def test_the_table_marks_noise_and_cut_searches():
    good = make_summary([[0.1] * 40] * 2, 'hybrid_bf')
    near = make_summary([[0.1] * 39 + [2.0]] * 2, 'clip_ransac')
    bad = make_summary([[2.0] * 40] * 2, 'mine')
    assert find_best([bad, near, good]) is good
    rows = table_rows([good, near, bad])
    assert rows[1][:3] == ('hybrid', 'bf', '1.00 / 1.00 / 1.00 ± .00')
    assert rows[2][2].endswith(' ~')
    assert rows[3][:3] == ('mine', '', '.00 / .00 / .00 ± .00')
    assert as_markdown(rows).splitlines()[2].startswith('| hybrid | bf | 1.00')
    assert all(len(line) < 130 for line in as_text(rows).splitlines())
    assert rows[1][-2:] == ('1.00 (.00 to 1.00)', '0 of 0')
    assert 'fitted on simulated' in notes([good, near])[1]
    assert 'hybrid_bf' in notes([good, near])[2]


def test_precision_falls_as_recall_rises():
    one = make_summary([0.1, 0.1, 2.0, 0.1, np.inf], confidence=[5.0, 4.0, 3.0, 3.0, 9.0])
    recall, precision = precision_recall(one)
    assert recall.tolist() == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert precision.tolist() == pytest.approx([1.0, 1.0, 0.75])
    assert len(precision_recall(make_summary([2.0, np.inf]))[0]) == 0
