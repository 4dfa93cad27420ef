# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from reference import same_class

from cliploc_ros.core.map.landmark_map import ClassIndex
from cliploc_ros.core.search.frame_search import (
    balanced_order,
    class_candidates,
    joined,
    nearest_candidates,
    prosac_order,
)

SIMILARITIES = np.array([[0.9, 0.1, 0.5], [0.2, 0.8, 0.7]], dtype=np.float32)


def test_nearest_candidates_come_best_first():
    found = nearest_candidates(SIMILARITIES, 2)
    assert found.pairs.tolist() == [[0, 0], [0, 2], [1, 1], [1, 2]]
    assert found.ranks.tolist() == [0, 1, 0, 1]


def test_prosac_order_falls_with_similarity():
    order = prosac_order(nearest_candidates(SIMILARITIES, 2))
    assert order.pairs.tolist() == [[0, 0], [1, 1], [1, 2], [0, 2]]


def test_balanced_order_takes_all_first_neighbours_first():
    many = np.array([[0.9, 0.8, 0.7], [0.3, 0.2, 0.1]], dtype=np.float32)
    order = balanced_order(nearest_candidates(many, 3))
    assert order.pairs.tolist() == [[0, 0], [1, 0], [0, 1], [1, 1], [0, 2], [1, 2]]


@given(st.integers(1, 8), st.integers(1, 12), st.data())
def test_balanced_order_is_balanced(detections, landmarks, data):
    k = data.draw(st.integers(1, landmarks))
    similarities = np.random.default_rng(0).random((detections, landmarks), dtype=np.float32)
    order = balanced_order(nearest_candidates(similarities, k))
    # after each round of first, second, ... neighbours every detection has had equally many
    for rank in range(k):
        head = order.detections[:(rank + 1) * detections]
        assert (np.bincount(head, minlength=detections) == rank + 1).all()


def test_rare_classes_come_first_and_nothing_twice():
    index = ClassIndex.of(('a', 'a', 'a', 'b'))
    rare = class_candidates(index, index.classes_of(('a', 'b', 'a')), 100)
    assert rare.pairs.tolist() == [[1, 3], [0, 0], [0, 1], [0, 2], [2, 0], [2, 1], [2, 2]]
    similarities = np.array([[0.1, 0.9, 0.2, 0.3]] * 3, dtype=np.float32)
    both = joined(nearest_candidates(similarities, 1), rare, 4)
    assert both.pairs.tolist() == [[0, 1], [1, 1], [2, 1], [1, 3], [0, 0], [0, 2], [2, 0], [2, 2]]


@given(st.lists(st.sampled_from('abc'), min_size=1, max_size=9),
       st.sets(st.tuples(st.integers(0, 8), st.sampled_from('abcd')), max_size=12),
       st.lists(st.sampled_from('abcde'), max_size=6), st.integers(0, 20))
def test_landmarks_of_several_classes_agree_with_their_mask(landmarks, others, detections, limit):
    others = sorted((row, name) for row, name in others
                    if row < len(landmarks) and landmarks[row] != name)
    index = ClassIndex.of(landmarks, others)
    mask = same_class(tuple(detections), tuple(landmarks))
    for row, name in others:
        mask[[one == name for one in detections], row] = True
    classes = index.classes_of(detections)
    assert (class_candidates(index, classes).pairs == np.argwhere(mask)).all()
    rarest = class_candidates(index, classes, 100).pairs
    assert sorted(rarest.tolist()) == np.argwhere(mask).tolist()
    assert (class_candidates(index, classes, limit).pairs == rarest[:limit]).all()
    rows, columns = np.indices(mask.shape).reshape(2, -1)
    assert (index.have(columns, classes[rows]) == mask.ravel()).all()
    assert (np.diff(index.members[:, 0]) >= 0).all()  # in the map's order
    assert (index.of_landmarks == index.classes_of(landmarks)).all()
