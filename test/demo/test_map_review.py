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


def true_object(object_id, class_id, x, label='a thing'):
    return TrueObject(object_id, class_id, label, np.array([x, 0.0, 1.0]), np.full(3, 0.1),
                      np.array([0.0, 0.0, 0.0, 1.0]))


def test_each_object_has_at_most_one_landmark_and_others_are_explained():
    objects = [true_object('mug_1', 'mug', 0.0), true_object('mug_2', 'mug', 1.0),
               true_object('can_1', 'can', 2.0, HOSTILE), true_object('book_1', 'book', 3.0),
               true_object('box_1', 'box', 4.0), true_object('bowl_1', 'bowl', 5.0)]
    # spheres with a radius of 11 cm
    ids, classes = ('mug_a', 'mug_b', 'mug_c', 'mug_d', 'box_a'), ('mug',) * 4 + ('box',)
    centers = np.c_[[0.03, 0.06, 2.02, 8.0, 4.0], [0.04, 0.0, 0.0, 0.0, 0.02], np.ones(5)]
    built = LandmarkMap('map', ids, classes, classes, centers, np.full((5, 3), 0.11),
                        np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))
    left_out = [{'class_id': 'box', 'center': (3.0, 0.05, 1.0), 'reason': 'as box, nearer'},
                {'class_id': 'book', 'center': (3.0, 0.09, 1.0), 'reason': 'seen from one side'}]
    review = review_map(built, objects, {name: Sightings(shown, Counter()) for name, shown in (
        ('mug_2', 4), ('can_1', 6), ('book_1', 3))}, left_out)
    assert review.landmark_of == {'box_1': 'box_a', 'mug_1': review.landmark_of['mug_1']}
    # the nearer of the two is found
    assert {review.objects[one.object_row].object_id: (one.offset_m, one.size_ratio)
            for one in review.found} == {'box_1': pytest.approx((0.02, 1.1)),
                                         'mug_1': pytest.approx((0.05, 1.1))}
    assert {ids[landmark]: text for landmark, text in review.false.items()} == {
        'mug_b': 'a duplicate of mug_1', 'mug_c': f'can_1 is there: {HOSTILE}',
        'mug_d': 'nothing is there; bowl_1 is 3.00 m away'}
    assert {review.objects[row].object_id: text for row, text in review.missed.items()} == {
        'mug_2': '4 images show it; detected in none',
        'can_1': 'mapped as mug; 6 images show it; detected in none',
        'book_1': 'left out as book, seen from one side; 3 images show it; detected in none',
        'bowl_1': 'no image shows it'}
