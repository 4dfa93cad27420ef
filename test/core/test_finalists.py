# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of several refined poses stands for its place."""

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.finalists import Finalist, first_of_each_place


def pose_at(x_m, yaw_deg=0.0):
    rotation = Rotation.from_euler('z', yaw_deg, degrees=True).as_matrix()
    return Finalist(rotation, -rotation @ np.array([x_m, 0.0, 0.0]), 1.0, 1, 0,
                    np.arange(3))


FOUND = [pose_at(0.0), pose_at(0.3), pose_at(2.0), pose_at(0.0, 30.0), pose_at(2.1, 5.0)]


def test_the_first_in_the_given_order_stands_for_its_place():
    assert first_of_each_place([0, 1, 2, 3, 4], FOUND, 8) == [0, 2, 3]
    assert first_of_each_place([4, 1, 3, 2, 0], FOUND, 8) == [4, 1, 3]


def test_no_more_than_a_count():
    assert first_of_each_place([2, 0, 3], FOUND, 2) == [2, 0]
    assert first_of_each_place([], FOUND, 2) == []
