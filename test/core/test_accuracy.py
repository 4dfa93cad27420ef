# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare poses of the office's real queries with the limits in test/thresholds.yaml."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.offline.evaluation import trials
from cliploc_ros.offline.evaluation.methods import Method
from cliploc_ros.offline.evaluation.summary import summarize

pytestmark = [pytest.mark.full, pytest.mark.once]

LIMITS_M = (0.25, 0.5, 1.0)
OPTIONS = RelocalizerOptions(crops='all')
HEIGHTS = replace(OPTIONS, height_range_m=(0.8, 2.2))


@pytest.fixture
def judge(office_map):
    """Return the results of queries by seed, and the share within their 95 % ellipsoids."""
    def run(options, *queries):
        results = [result for trial, its in enumerate(queries)
                   for result in trials.run_trial(office_map, Method('auto', options), trial, its)]
        found, = summarize(results)
        within = float(np.mean([result.nees < chi2.ppf(0.95, 6) for result in results
                                if result.accepted and result.error_m < 1.0]))
        print(f'\nsuccess {[round(found.success(limit), 3) for limit in LIMITS_M]}, precision '
              f'{found.precision():.3f}, recall {found.recall():.3f}, {within:.3f} within')
        return found, within
    return run


@pytest.mark.parametrize('iterations', [500, 10000])
def test_accepted_poses_are_right_and_their_covariances_true(iterations, office_map, queries,
                                                             judge, thresholds):
    limits = thresholds['trust'][iterations]
    found, within = judge(replace(OPTIONS, iterations=iterations),
                          trials.make_queries(queries, office_map, every_frame=True))
    assert found.precision() >= limits['precision'] and found.recall() >= limits['recall']
    low, high = limits['within_95']
    assert low <= within <= high


@pytest.mark.parametrize('case', ['nothing', 'height', 'vertical_0_deg', 'vertical_1_deg',
                                  'vertical_3_deg'])
def test_success_with_what_is_known(case, office_map, queries, judge, thresholds):
    least, asked = thresholds['known'][case], [trials.make_queries(queries, office_map)]
    if case.startswith('vertical'):
        error_deg = float(case.split('_')[1])
        asked = [trials.with_vertical(asked[0], error_deg, seed)
                 for seed in range(3 if error_deg else 1)]
    found, _ = judge(OPTIONS if case == 'nothing' else HEIGHTS, *asked)
    assert all(found.success(limit) >= one
               for limit, one in zip(LIMITS_M, least['success'], strict=True))
    assert np.median(found.errors_m[np.isfinite(found.errors_m)]) <= least['median_m']
    assert found.false_accepts() == 0


@pytest.mark.parametrize('case', ['nothing', 'vertical_1_deg'])
def test_five_frames_joined_by_odometry(case, office_map, queries, judge, thresholds):
    """The 52 queries have neighbours; a step has noise of 1 cm and 0.5 degrees on each axis."""
    least = thresholds['fused'][case]
    frames = trials.make_queries(queries, office_map, every_frame=True)
    if case != 'nothing':
        frames = trials.with_vertical(frames, 1.0, 0)
    frames = trials.with_neighbours(frames, [frame.group for frame in frames], 0.01, 0.5, 0)
    asked = [frame for frame in frames if frame.is_main]
    found, within = judge(OPTIONS if case == 'nothing' else HEIGHTS, asked)
    assert all(found.success(limit) >= one
               for limit, one in zip(LIMITS_M, least['success'], strict=True))
    assert found.false_accepts() == 0 and found.recall() >= least['recall']
    assert within >= 0.9
