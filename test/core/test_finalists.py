# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of several poses stands for its place."""

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import SAME_PLACE, make_transform


def pose_at(x_m, yaw_deg=0.0):
    rotation = Rotation.from_euler('z', yaw_deg, degrees=True).as_matrix()
    return make_transform(rotation, np.array([x_m, 0.0, 0.0]))


FOUND = np.array([pose_at(0.0), pose_at(0.3), pose_at(2.0), pose_at(0.0, 30.0),
                  pose_at(2.1, 5.0)])


def distinct(order, most=np.inf):
    return [order[row] for row in SAME_PLACE.distinct(FOUND[np.array(order, dtype=int)], most)]


def test_the_first_in_the_given_order_stands_for_its_place():
    assert distinct([0, 1, 2, 3, 4]) == [0, 2, 3]
    assert distinct([4, 1, 3, 2, 0]) == [4, 1, 3]


def test_no_more_than_a_count():
    assert distinct([2, 0, 3], 2) == [2, 0]
    assert distinct([], 2) == []
