# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive answers: what each tells that those before it did not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.geometry.transforms import make_transform, pose_difference
from cliploc_ros.core.localizer import succeed

OWN = np.diag([0.04, 0.01, 0.02, 0.001, 0.002, 0.003])


def at(x=0.0, degrees=0.0):
    return make_transform(Rotation.from_euler('z', degrees, degrees=True).as_matrix(),
                          np.array([x, 0.0, 0.0]))


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


def test_a_contradiction_makes_both_answers_less_certain():
    _, known = succeed(None, at(), at(), 2.0 * OWN)
    agreeing, contradicting = (succeed(known, at(), at(x), OWN) for x in (0.0, 1.5))
    doubt = 1.5**2 / (3.0 * OWN[0, 0]) / chi2.ppf(0.99, 6)
    assert doubt == pytest.approx(1.115, abs=1e-3)
    np.testing.assert_allclose(contradicting[0], doubt * agreeing[0], rtol=1e-9)
    np.testing.assert_allclose(contradicting[1].covariance, doubt * agreeing[1].covariance,
                               rtol=1e-9)
    just_agreeing = succeed(known, at(), at(1.4), OWN)
    np.testing.assert_allclose(just_agreeing[0], agreeing[0], rtol=1e-9)


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
