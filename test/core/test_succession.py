# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive answers, and a filter that takes each for an independent measurement."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform, pose_difference
from cliploc_ros.core.succession import succeed
from cliploc_ros.evaluation.worlds.continuous import COVARIANCES, Filter, walk_squares

OWN = np.diag([0.04, 0.01, 0.02, 0.001, 0.002, 0.003])


def at(x=0.0, degrees=0.0):
    return make_transform(Rotation.from_euler('z', degrees, degrees=True).as_matrix(),
                          np.array([x, 0.0, 0.0]))


def test_a_filter_of_a_standing_robot_stays_as_certain_as_one_answer():
    known, fused = None, None
    for _ in range(300):
        given, known = succeed(known, at(), at(), OWN)
        fused = Filter(at(), given, at()) if fused is None else fused.updated(at(), given)
    assert np.linalg.eigvalsh(fused.covariance - 0.95 * OWN).min() > 0.0
    np.testing.assert_allclose(known.covariance, fused.covariance, rtol=1e-6, atol=1e-12)


def test_a_better_answer_tells_what_it_knows_better():
    _, known = succeed(None, at(), at(), OWN)
    better = OWN.copy()
    better[1, 1] = 0.001
    given, after = succeed(known, at(), at(), better)
    assert after.covariance[1, 1] == pytest.approx(0.001, rel=1e-2)
    assert after.covariance[0, 0] == pytest.approx(0.04, rel=1e-2)
    assert given[1, 1] < 0.002 and given[0, 0] > 100.0


def test_a_robot_that_drove_on_is_told_anew():
    _, known = succeed(None, at(), at(), OWN)
    near, far = (succeed(known, at(way), at(way), OWN)[0] for way in (0.5, 50.0))
    assert near[0, 0] > 10.0 * OWN[0, 0]
    assert far[0, 0] < 2.0 * OWN[0, 0]


@pytest.mark.parametrize('answers', [1, 20])
def test_an_outlier_hardly_moves_the_filter_and_a_misled_one_recovers(answers):
    known = None
    for _ in range(answers):
        _, known = succeed(known, at(), at(), 0.01 * OWN)
    _, misled = succeed(known, at(), at(0.4), 0.01 * OWN)
    assert np.linalg.norm(pose_difference(at(), misled.map_from_camera)[:3]) < 0.25
    for _ in range(10):
        _, misled = succeed(misled, at(), at(), 0.01 * OWN)
    assert np.linalg.norm(pose_difference(at(), misled.map_from_camera)[:3]) < 0.1


def test_a_filter_of_a_walk_is_consistent():
    """Images of simulated rooms, one after the other, as in continuous mode."""
    squares = np.concatenate([walk_squares('room', seed) for seed in (0, 1, 2)])
    assert len(squares) >= 20
    within = dict(zip(COVARIANCES, (squares < 20.06).mean(axis=0), strict=True))
    print(f'\n{len(squares)} states within 3 sigma: {within}')
    assert within['for a filter'] >= 0.95
    assert within['for a filter'] > within['their own']
