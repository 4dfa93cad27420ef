# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether maps and detections go wrong as said, and what that costs."""

import cv2
import numpy as np
import pytest

from cliploc_ros.evaluation.trials import make_queries
from studies.acceptance import robustness, troubles


@pytest.fixture(scope='module')
def questions(room, recording):
    return make_queries(recording, room)


@pytest.fixture
def changed(room, questions, rng):
    """Apply a change by so much."""
    return lambda change, level: change(room, questions, level, rng)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_landmarks_are_removed_with_their_similarities(changed, room, questions):
    fewer, asked = changed(troubles.remove_landmarks, 0.5)
    assert len(fewer) == len(room) - round(len(room) / 2)
    columns = [room.landmark_ids.index(one) for one in fewer.landmark_ids]
    np.testing.assert_array_equal(fewer.centers, room.centers[columns])
    np.testing.assert_array_equal(asked[-1].observation.similarities,
                                  questions[-1].observation.similarities[:, columns])


def test_landmarks_are_moved_by_a_distance(changed, room):
    distances = np.linalg.norm(changed(troubles.move_landmarks, 0.3)[0].centers - room.centers,
                               axis=1)
    assert distances.max() == pytest.approx(0.3)
    assert 0 < (distances > 0).sum() < len(room)


def test_landmarks_exchange_places(changed, room):
    other = changed(troubles.exchange_landmarks, 1.0)[0]
    assert other.labels == room.labels
    assert np.array_equal(np.sort(other.centers, axis=0), np.sort(room.centers, axis=0))
    assert (other.centers != room.centers).any(axis=1).all()
    some = changed(troubles.exchange_landmarks, 0.5)[0]
    assert (some.centers != room.centers).any(axis=1).sum() == round(len(room) / 2)


def test_landmarks_are_mislabelled(changed, room, questions):
    wrong, asked = changed(troubles.mislabel_landmarks, 0.5)
    assert sorted(wrong.labels) == sorted(room.labels)
    source = [room.labels.index(one) for one in wrong.labels]
    assert sum(row != own for own, row in enumerate(source)) == round(len(room) / 2)
    np.testing.assert_array_equal(asked[-1].observation.similarities,
                                  questions[-1].observation.similarities[:, source])


def test_a_share_of_the_objects_is_moved(changed, room):
    moved = changed(troubles.move_objects, 0.5)[0]
    distances = np.linalg.norm(moved.centers - room.centers, axis=1)
    assert (distances > 0).sum() == round(len(room) / 2)
    assert distances[distances > 0].min() >= 0.3
    assert distances.max() <= 3.0


def test_landmarks_are_doubled_with_their_similarities(changed, room, questions):
    double, asked = changed(troubles.double_landmarks, 0.1)
    count = len(room)
    assert len(double) == len(set(double.landmark_ids)) == 2 * count
    np.testing.assert_allclose(
        np.linalg.norm(double.centers[count:] - double.centers[:count], axis=1), 0.1)
    similarities = asked[-1].observation.similarities
    np.testing.assert_array_equal(similarities[:, :count], similarities[:, count:])
    np.testing.assert_array_equal(similarities[:, :count], questions[-1].observation.similarities)


def test_an_equal_room_is_added_beside(changed, room):
    twin = changed(troubles.add_equal_room, 2.0)[0]
    count = len(room)
    steps = twin.centers[count:] - twin.centers[:count]
    assert (steps == steps[0]).all()
    assert twin.centers[count:, 0].min() > twin.centers[:count, 0].max()
    assert twin.class_ids[:count] == twin.class_ids[count:]


def test_boxes_become_random_ones(changed, questions):
    asked = changed(troubles.random_detections, 10)[1]
    assert all(len(one.observation.detections) == 10 for one in asked)
    assert asked[0].observation.similarities.shape[0] == 10
    assert not np.array_equal(asked[0].observation.detections.bboxes_xyxy,
                              asked[1].observation.detections.bboxes_xyxy)


def test_detections_are_dropped_and_invented(changed, questions):
    before = sum(len(one.observation.detections) for one in questions)
    fewer = sum(len(one.observation.detections)
                for one in changed(troubles.drop_detections, 0.5)[1])
    assert 0.3 * before < fewer < 0.7 * before
    asked = changed(troubles.invent_detections, 0.5)[1]
    more = sum(len(one.observation.detections) for one in asked)
    assert 1.3 * before < more < 1.7 * before
    assert all(one.observation.similarities.shape[0] == len(one.observation.detections)
               for one in asked)


@pytest.mark.parametrize('trouble', robustness.TROUBLES, ids=lambda trouble: trouble.name)
def test_unchanged_queries_succeed_and_wrong_poses_are_refused(
        trouble, room, questions, tmp_path):
    summaries = list(robustness.measure(room, questions, trouble, seed=0))
    assert len(summaries) == len(trouble.levels)
    assert summaries[0].success(1.0) > 0.7
    assert sum(one.false_accepts() for one in summaries) <= 1
    image = cv2.imread(str(robustness.draw(tmp_path, [(trouble, summaries)] * 2)))
    assert image.shape[0] > 300 and image.std() > 20
