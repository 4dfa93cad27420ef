# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, see_room

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import ALGORITHMS, RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError


@pytest.fixture
def observation(room) -> Observation:
    """Return the observation of a perfect detector and a good encoder in the room."""
    similarities = np.full((len(room), len(room)), 0.2, dtype=np.float32)
    np.fill_diagonal(similarities, np.linspace(0.3, 0.4, len(room)))
    return Observation(CAMERA, see_room(room), similarities, 123)


METHODS = [('class', 'bf'), ('class', 'ransac')] + [
    (matching, algorithm) for matching in ('clip', 'hybrid') for algorithm in ALGORITHMS]


@pytest.mark.parametrize(('matching', 'algorithm'), METHODS)
def test_every_method_finds_a_perfect_view(matching, algorithm, room, observation):
    options = RelocalizerOptions(matching=matching, algorithm=algorithm, iterations=2000)
    result = Relocalizer(room, options).relocalize([observation])
    assert result.accepted
    # box centres and ellipsoid centres differ slightly by perspective
    error_m, error_deg = pose_error(result.map_from_camera, MAP_FROM_CAMERA)
    assert error_m < 0.05 and error_deg < 1.0
    assert len(result.matches) == 12
    assert all(match.detection == match.landmark for match in result.matches)
    assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_equal_seeds_repeat_and_negative_ones_vary(room, observation):
    def scores(seed):
        options = RelocalizerOptions(algorithm='ransac', iterations=5, random_seed=seed)
        return [Relocalizer(room, options).relocalize([observation]).score for _ in range(5)]
    assert len(set(scores(1))) == 1
    assert len(set(scores(-1))) > 1


@pytest.mark.parametrize(('rows', 'options'), [
    ([], {}), ([0, 1], {}), ([0, 1, 2], {'matching': 'class'}),
    ([0, 1, 2], {'min_inliers': 4})])
def test_three_boxes_give_a_pose_that_is_refused_and_fewer_none(rows, options, room, observation):
    rows = np.array(rows, dtype=np.int64)
    result = Relocalizer(room, RelocalizerOptions(**options)).relocalize([replace(
        observation, detections=observation.detections.select(rows),
        similarities=observation.similarities[rows])])
    assert not result.accepted and result.solved == (len(rows) == 3)
    assert result.solved or f'{len(rows)} detections' in result.reason


def test_bf_stops_when_its_time_is_over_and_says_so(room, observation):
    options = RelocalizerOptions(matching='class', algorithm='bf', time_budget_s=0.0)
    result = Relocalizer(room, options).relocalize([observation])
    assert 0.0 < result.coverage < 1.0
    assert not result.accepted and result.reason.startswith('search stopped')


def test_missing_or_misshaped_similarities_and_a_large_k_are_named(room, observation):
    relocalizer = Relocalizer(room, RelocalizerOptions())
    for similarities in (None, observation.similarities[:, :3]):
        with pytest.raises(OptionsError, match=r'shape \(12, 12\)'):
            relocalizer.relocalize([replace(observation, similarities=similarities)])
    with pytest.raises(OptionsError, match='k = 13'):
        Relocalizer(room, RelocalizerOptions(k=13))


def test_boxes_turned_inside_out_are_left_out(room, observation):
    boxes = observation.detections.bboxes_xyxy.copy()
    boxes[:3] = boxes[:3][:, [2, 3, 0, 1]]
    result = Relocalizer(room, RelocalizerOptions()).relocalize([replace(
        observation, detections=replace(observation.detections, bboxes_xyxy=boxes))])
    assert result.accepted
    assert sorted(match.detection for match in result.matches) == list(range(3, 12))


@pytest.mark.parametrize('change', [
    {'matching': 'magic'}, {'algorithm': 'b-prosac', 'matching': 'class'}, {'k': 0},
    {'iou_threshold': 1.5}, {'iou_threshold': float('nan')}, {'time_budget_s': -1.0},
    {'min_inliers': 2}, {'min_confidence': -1.0}, *({'height_range_m': heights} for heights in (
        (1.0, 1.0), (float('nan'), 2.0), (1.0,)))])
def test_impossible_options_are_named(change):
    with pytest.raises(OptionsError, match=next(iter(change))):
        RelocalizerOptions(**change)


def test_usable_detections_leave_out_what_cannot_be_seen():
    boxes = np.array([[10, 10, 50, 50], [np.nan, 0, 1, 1], [50, 50, 10, 10], [700, 10, 720, 30],
                      [-20, -20, 5, 5], [-1e30, 0, 1e30, 9], [60, 60, 90, np.inf],
                      [20, 20, 20, 40]], dtype=np.float64)
    detections = Detections(boxes, tuple('abcdefgh'), np.linspace(0.1, 0.8, 8))
    assert detections.usable(640, 480, 50).class_ids == ('a', 'e')
    assert detections.usable(640, 480, 1).class_ids == ('e',)
