# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Failures with a known cause are blamed on it."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.queries import load_queries
from cliploc_ros.evaluation.trials import make_queries
from studies import blame

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def right(shared_data):
    """The map, and a query whose pose is found."""
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    queries = make_queries(load_queries(folder / 'queries.npz', landmark_map.landmark_ids),
                           landmark_map)
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    return landmark_map, next(one for one in queries if len(one.observation.detections) >= 8
                              and not blame.blame(landmark_map, relocalizer, one, 0.5).cause)


def cause(landmark_map, query, **options):
    return blame.blame(landmark_map, Relocalizer(landmark_map, RelocalizerOptions(**options)),
                       query, 0.5).cause


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


def test_too_few_objects_are_to_blame(right):
    landmark_map, query = right
    observation = query.observation
    few = replace(query, observation=replace(
        observation, detections=observation.detections.select(np.arange(2)),
        similarities=observation.similarities[:2]))
    found = blame.blame(landmark_map, Relocalizer(landmark_map, RelocalizerOptions()), few, 0.5)
    assert found.cause == 'objects'
    assert found.candidates <= 2


@pytest.mark.parametrize('matching', ['hybrid', 'class'])
def test_more_sensors_know_more(shared_data, matching):
    folder = shared_data / 'tum_fr3_office'
    landmark_map = LandmarkMap.from_file(folder / 'map.yaml')
    queries = load_queries(folder / 'queries.npz', landmark_map.landmark_ids)
    modes = {one.name: one for one in blame.with_sensors(
        queries, landmark_map, False, matching, (0.8, 2.2))}
    assert {len(one.queries) for one in modes.values()} == {52}
    level = modes['vertical, height']
    assert level.queries[0].observation.up_in_camera is not None
    assert level.options.height_range_m == (0.8, 2.2)
    assert sum(len(one.neighbours) for one in modes['five images'].queries) == 206
    assert modes['five images'].queries[0].observation.up_in_camera is None
    assert all((one.observation.similarities is None) == (matching == 'class')
               for known in modes.values() for one in known.queries)


def test_the_table_counts_every_query(files, capsys):
    assert blame.run(['--queries', *[str(files / 'queries.npz')] * 2, '--map',
                      str(files / 'map.yaml'), '--matching', 'hybrid', '--height-range',
                      '-9', '9']) == 0
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert [row.split('|')[2].strip() for row in rows] == ['one image', 'vertical',
                                                           'vertical, height']
    for row in rows:
        queries, *counts, many = [int(cell) for cell in row.strip('|').split('|')[2:]]
        assert queries == sum(counts) == 24
        assert counts[0] >= 16, 'most are right'
        assert many <= sum(counts[1:])
