# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Failures with a known cause are blamed on it."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation import blame
from cliploc_ros.evaluation.trials import make_queries


@pytest.fixture(scope='module')
def right(shared_data):
    """The map, and a query whose pose is found."""
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    queries = make_queries(load_queries(folder / 'queries.npz', landmark_map.landmark_ids),
                           landmark_map)
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    return landmark_map, next(one for one in queries if len(one.observation.detections) >= 8
                              and not blame.blame(landmark_map, relocalizer, one, 0.5))


def cause(landmark_map, query, **options):
    return blame.blame(landmark_map, Relocalizer(landmark_map, RelocalizerOptions(**options)),
                       query, 0.5)


def test_a_map_of_another_place_is_to_blame(right):
    landmark_map, query = right
    order = np.roll(np.arange(len(landmark_map)), 1)
    elsewhere = replace(landmark_map, centers=landmark_map.centers[order])
    assert cause(elsewhere, query) == 'map'


def test_similarities_that_name_others_leave_no_candidates(right):
    landmark_map, query = right
    similarities = np.zeros_like(query.observation.similarities)
    similarities[:, 0] = 1.0
    misled = replace(query, observation=replace(query.observation, similarities=similarities))
    assert cause(landmark_map, misled, algorithm='b-prosac', k=1) == 'candidates'


def test_a_search_that_ends_at_once_is_to_blame(right):
    landmark_map, query = right
    assert cause(landmark_map, query, algorithm='ransac', iterations=1) == 'search'


def test_the_table_counts_every_query(shared_data, capsys):
    folder = shared_data / 'tum_fr3_office'
    assert blame.run(['--queries', str(folder / 'queries.npz'), '--map',
                      str(folder / 'map.yaml')]) == 0
    heading, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert heading.startswith('52 queries')
    for row in rows:
        counts = [int(number) for number in row.split()[-5:]]
        assert sum(counts) == 52
        assert counts[0] >= 40, 'most are right'
