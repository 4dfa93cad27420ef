# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses from three points, and from two and a vertical."""

import cv2
import numpy as np
import pytest
from reference import nearest, solve_p3p
from scene import unit_rows
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.minimal_solvers import two_point


def random_problem(rng, count=3):
    """Return points at random bearings and depths in front of a camera at a random pose."""
    seen = rng.uniform(-1, 1, (count, 3))
    seen[:, 2] = rng.uniform(0.5, 6.0, count)
    seen[:, :2] *= seen[:, 2:]
    rotation = Rotation.from_rotvec(rng.normal(size=3) * 2).as_matrix()
    translation = rng.normal(size=3) * 2
    return seen, (seen - translation) @ rotation, rotation, translation


def solve(bearings, points, up_in_camera, up_in_map):
    """Return the rotations (s, 3, 3) and translations (s, 3) from three points or from two."""
    if len(points) == 3:
        return solve_p3p(bearings, points)
    rotations, translations = np.empty((2, 3, 3)), np.empty((2, 3))
    count = two_point(np.ascontiguousarray(bearings), np.ascontiguousarray(points),
                      np.concatenate([up_in_camera, up_in_map]), rotations, translations)
    return rotations[:count], translations[:count]


@pytest.mark.parametrize('count', [3, 2])
def test_recovers_random_poses_and_finds_solutions_only_none_twice(count, rng):
    worst, several = 0.0, 0
    for number in range(10_000):
        seen, points, rotation, translation = random_problem(rng, count)
        up_in_map, bearings = unit_rows(rng.normal(size=(1, 3)))[0], unit_rows(seen)
        rotations, translations = solve(bearings, points, rotation @ up_in_map, up_in_map)
        worst = max(worst, nearest(rotations, translations, rotation, translation))
        several += len(rotations) > 1
        for index, found in enumerate(rotations if number < 2_000 else ()):
            assert np.abs(found @ found.T - np.eye(3)).max() < 1e-8
            assert np.linalg.det(found) > 0
            again = unit_rows(points @ found.T + translations[index])
            assert np.abs(again - bearings).max() < 1e-7
            assert nearest(rotations[:index], translations[:index], found,
                           translations[index]) > 1e-9
            assert count == 3 or np.abs(found @ up_in_map - rotation @ up_in_map).max() < 1e-12
    print(f'\n10,000 random poses recovered to {worst:.1e}')
    assert worst < 1e-8
    assert several > 500


def test_finds_what_opencv_finds(rng):
    found = 0
    for _ in range(2_000):
        seen, points, _, _ = random_problem(rng)
        bearings = unit_rows(seen)
        rotations, translations = solve_p3p(bearings, points)
        image = np.ascontiguousarray((seen[:, :2] / seen[:, 2:])[:, None])
        _, vectors, theirs = cv2.solveP3P(np.ascontiguousarray(points[:, None]), image,
                                          np.eye(3), None, cv2.SOLVEPNP_AP3P)
        for vector, translation in zip(vectors, theirs, strict=True):
            rotation = cv2.Rodrigues(vector)[0]
            again = unit_rows(points @ rotation.T + translation.ravel())
            if np.abs(again - bearings).max() > 1e-6:
                continue  # not a solution: OpenCV's own rounding near a double root
            found += 1
            # as near as the rounding of OpenCV 4.6; solutions of one problem differ far more
            assert nearest(rotations, translations, rotation, translation.ravel()) < 1e-3
    assert found > 3_000


@pytest.mark.parametrize('points', [
    np.zeros((3, 3)),
    np.array([[0.0, 0, 5], [0, 0, 5], [1, 0, 5]]),
    np.array([[0.0, 0, 5], [1, 0, 5], [2, 0, 5]]),
    np.full((3, 3), np.nan),
    np.zeros((2, 3)),                              # one point
    np.array([[0.0, 0, 1], [0, 0, 2]]),            # one above the other
    np.full((2, 3), np.nan),
])
def test_degenerate_points_have_no_pose(points):
    bearings = unit_rows(np.array([[0.0, 0, 1], [0.2, 0.1, 1], [0.4, 0.2, 1]]))[:len(points)]
    assert len(solve(bearings, points, np.array([0.0, -1.0, 0.0]),
                     np.array([0.0, 0.0, 1.0]))[0]) == 0
