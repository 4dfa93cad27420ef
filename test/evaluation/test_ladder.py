# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ladder on some of the real queries: every rung runs, the last beats the first."""

from dataclasses import replace

from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.ladder import climb, rungs, table_rows

GROUPS = 12


def test_each_rung_runs_and_the_last_is_the_best(shared_data):
    office = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(office / 'map.yaml')
    recorded = load_queries(office / 'queries.npz', landmark_map.landmark_ids)
    groups = sorted({frame.group for frame in recorded})[:GROUPS]
    some = replace(recorded, frames=tuple(one for one in recorded.frames if one.group in groups))
    ladder, done = rungs((0.8, 2.2)), []
    found = climb(landmark_map, some, ladder, advance=done.append)
    # the paper's method draws samples, and three rungs have noise; the other three repeat nothing
    assert sum(done) == (4 * 3 + 3) * GROUPS
    assert [one.method for one in found] == [rung.name for rung in ladder]
    assert len(table_rows(found)) == 1 + len(ladder)
    success = [one.success(0.5) for one in found]
    print(f'\nsuccess at 0.5 m, {GROUPS} queries: {" ".join(f"{rate:.2f}" for rate in success)}')
    assert success[-1] == max(success) > success[0]
    assert sum(one.false_accepts() for one in found) == 0
