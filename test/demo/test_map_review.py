# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo's report on the map that it built: found, missed and false objects, with reasons."""

from collections import Counter

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_map import LandmarkMap
from demo.map_review import Sightings, review_map
from demo.truth import TrueObject

HOSTILE = '<script>alert("&")</script>'


def true_object(object_id, class_id, x, y=0.0, label='a thing'):
    return TrueObject(object_id, class_id, label, np.array([x, y, 1.0]), np.full(3, 0.1),
                      np.array([0.0, 0.0, 0.0, 1.0]))


def make_map(*landmarks):
    """Return a map of spheres with a radius of 11 cm: rows of id, class, x, y."""
    ids, classes, xs, ys = zip(*landmarks, strict=True)
    centers = np.c_[xs, ys, np.ones(len(ids))]
    return LandmarkMap('map', ids, classes, classes, centers, np.full((len(ids), 3), 0.11),
                       np.tile([0.0, 0.0, 0.0, 1.0], (len(ids), 1)))


@pytest.fixture
def review():
    objects = [true_object('mug_1', 'mug', 0.0), true_object('mug_2', 'mug', 1.0),
               true_object('can_1', 'can', 2.0, label=HOSTILE), true_object('book_1', 'book', 3.0),
               true_object('box_1', 'box', 4.0), true_object('bowl_1', 'bowl', 5.0)]
    built = make_map(('mug_a', 'mug', 0.03, 0.04), ('mug_b', 'mug', 0.06, 0.0),
                     ('mug_c', 'mug', 2.02, 0.0), ('mug_d', 'mug', 8.0, 0.0),
                     ('box_a', 'box', 4.0, 0.02))
    left_out = [{'class_id': 'box', 'center': (3.0, 0.05, 1.0), 'reason': 'as box, nearer'},
                {'class_id': 'book', 'center': (3.0, 0.09, 1.0), 'reason': 'seen from one side'}]
    sightings = {name: Sightings(shown, Counter())
                 for name, shown in (('mug_2', 4), ('can_1', 6), ('book_1', 3))}
    return review_map(built, objects, sightings, left_out)


def test_each_object_has_at_most_one_landmark_of_its_class(review):
    pairs = review.landmark_of
    assert pairs['box_1'] == 'box_a'
    assert pairs['mug_1'] in ('mug_a', 'mug_b')
    assert len(pairs) == 2
    offsets = {review.objects[one.object_row].object_id: one.offset_m for one in review.found}
    assert offsets['box_1'] == pytest.approx(0.02)
    assert offsets['mug_1'] == pytest.approx(0.05)  # the nearer of the two is found
    assert [result.size_ratio for result in review.found] == pytest.approx([1.1, 1.1])


def test_false_landmarks_say_what_is_there(review):
    ids = review.landmark_map.landmark_ids
    false = {ids[landmark]: text for landmark, text in review.false.items()}
    assert false == {'mug_b': 'a duplicate of mug_1', 'mug_c': f'can_1 is there: {HOSTILE}',
                     'mug_d': 'nothing is there; bowl_1 is 3.00 m away'}


def test_missed_objects_say_why(review):
    missed = {review.objects[row].object_id: text for row, text in review.missed.items()}
    assert missed == {
        'mug_2': '4 images show it; detected in none',
        'can_1': 'mapped as mug; 6 images show it; detected in none',
        'book_1': 'left out as book, seen from one side; 3 images show it; detected in none',
        'bowl_1': 'no image shows it'}
