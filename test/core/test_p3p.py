# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses from three points, and from two and a vertical."""

import cv2
import numpy as np
import pytest
from reference import bearings_of, nearest, solve_p3p
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.minimal_solvers import two_point


def random_problem(rng):
    """Return three points at random bearings and depths in front of a camera at a random pose."""
    seen = rng.uniform(-1, 1, (3, 3))
    seen[:, 2] = rng.uniform(0.5, 6.0, 3)
    seen[:, :2] *= seen[:, 2:]
    rotation = Rotation.from_rotvec(rng.normal(size=3) * 2).as_matrix()
    translation = rng.normal(size=3) * 2
    return seen, (seen - translation) @ rotation, rotation, translation


def test_recovers_random_poses(rng):
    worst = 0.0
    for _ in range(10_000):
        seen, points, rotation, translation = random_problem(rng)
        worst = max(worst, nearest(*solve_p3p(bearings_of(seen), points), rotation, translation))
    print(f'\n10,000 random poses recovered to {worst:.1e}')
    assert worst < 1e-8


def test_finds_what_opencv_finds(rng):
    found = 0
    for _ in range(2_000):
        seen, points, _, _ = random_problem(rng)
        bearings = bearings_of(seen)
        rotations, translations = solve_p3p(bearings, points)
        image = np.ascontiguousarray((seen[:, :2] / seen[:, 2:])[:, None])
        _, vectors, theirs = cv2.solveP3P(np.ascontiguousarray(points[:, None]), image,
                                          np.eye(3), None, cv2.SOLVEPNP_AP3P)
        for vector, translation in zip(vectors, theirs, strict=True):
            rotation = cv2.Rodrigues(vector)[0]
            again = bearings_of(points @ rotation.T + translation.ravel())
            if np.abs(again - bearings).max() > 1e-6:
                continue  # not a solution: OpenCV's own rounding near a double root
            found += 1
            # as near as the rounding of OpenCV 4.6; solutions of one problem differ far more
            assert nearest(rotations, translations, rotation, translation.ravel()) < 1e-3
    assert found > 3_000


def test_every_pose_found_is_a_solution_and_none_is_found_twice(rng):
    for _ in range(2_000):
        seen, points, _, _ = random_problem(rng)
        bearings = bearings_of(seen)
        rotations, translations = solve_p3p(bearings, points)
        for index, (rotation, translation) in enumerate(zip(rotations, translations,
                                                            strict=True)):
            assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-8
            assert np.linalg.det(rotation) > 0
            again = bearings_of(points @ rotation.T + translation)
            assert np.abs(again - bearings).max() < 1e-9
            assert nearest(rotations[:index], translations[:index], rotation,
                           translation) > 1e-9


@pytest.mark.parametrize('points', [
    np.zeros((3, 3)),
    np.array([[0.0, 0, 5], [0, 0, 5], [1, 0, 5]]),
    np.array([[0.0, 0, 5], [1, 0, 5], [2, 0, 5]]),
    np.full((3, 3), np.nan),
])
def test_degenerate_triangles_have_no_pose(points):
    bearings = bearings_of(np.array([[0.0, 0, 1], [0.2, 0, 1], [0.4, 0, 1]]))
    assert len(solve_p3p(bearings, points)[0]) == 0


UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def solve_two_point(bearings, points, up_in_camera, up_in_map):
    """Return the rotations (s, 3, 3) and translations (s, 3) from the kernel, s = 0 to 2."""
    rotations, translations = np.empty((2, 3, 3)), np.empty((2, 3))
    count = two_point(np.ascontiguousarray(bearings), np.ascontiguousarray(points),
                      np.concatenate([up_in_camera, up_in_map]), rotations, translations)
    return rotations[:count], translations[:count]


def random_pair(rng):
    """Return two points at random bearings and depths in front of a camera at a random pose."""
    seen = rng.uniform(-1, 1, (2, 3))
    seen[:, 2] = rng.uniform(0.5, 6.0, 2)
    seen[:, :2] *= seen[:, 2:]
    rotation = Rotation.from_rotvec(rng.normal(size=3) * 2).as_matrix()
    translation = rng.normal(size=3) * 2
    up_in_map = rng.normal(size=3)
    up_in_map /= np.linalg.norm(up_in_map)
    return seen, (seen - translation) @ rotation, rotation, translation, up_in_map


def test_two_points_recover_random_poses(rng):
    worst = 0.0
    for _ in range(10_000):
        seen, points, rotation, translation, up_in_map = random_pair(rng)
        poses = solve_two_point(bearings_of(seen), points, rotation @ up_in_map, up_in_map)
        worst = max(worst, nearest(*poses, rotation, translation))
    print(f'\n10,000 random poses recovered to {worst:.1e}')
    assert worst < 1e-9


def test_every_pose_found_is_an_upright_solution_and_none_is_found_twice(rng):
    twice = 0
    for _ in range(2_000):
        seen, points, rotation, _, up_in_map = random_pair(rng)
        up_in_camera = rotation @ up_in_map
        bearings = bearings_of(seen)
        rotations, translations = solve_two_point(bearings, points, up_in_camera, up_in_map)
        twice += len(rotations) == 2
        for index, (found, translation) in enumerate(zip(rotations, translations, strict=True)):
            assert np.abs(found @ found.T - np.eye(3)).max() < 1e-12
            assert np.linalg.det(found) > 0
            assert np.abs(found @ up_in_map - up_in_camera).max() < 1e-12
            assert np.abs(bearings_of(points @ found.T + translation) - bearings).max() < 1e-7
            assert nearest(rotations[:index], translations[:index], found, translation) > 1e-9
    assert twice > 100


@pytest.mark.parametrize('points', [
    np.zeros((2, 3)),                              # one point
    np.array([[0.0, 0, 1], [0, 0, 2]]),            # one above the other
    np.full((2, 3), np.nan),
])
def test_degenerate_pairs_have_no_pose(points):
    bearings = bearings_of(np.array([[0.0, 0, 1], [0.2, 0.1, 1]]))
    assert len(solve_two_point(bearings, points, *UP)[0]) == 0
