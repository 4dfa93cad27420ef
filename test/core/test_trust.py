# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether accepted poses are right, and whether their covariances are true."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance import Evidence, one_to_one, refusal, strength
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.transforms import pose_error
from cliploc_ros.core.uncertainty import pose_covariance

# 95 % of a chi-squared variable of six degrees of freedom lies below this.
CHI2_95 = 12.592


def pose_difference(estimate, truth):
    """Position [m] and rotation [rad] from an estimate to the truth, in ROS order."""
    turn = Rotation.from_matrix(truth[:3, :3] @ estimate[:3, :3].T).as_rotvec()
    return np.concatenate([truth[:3, 3] - estimate[:3, 3], turn])


def test_accepted_poses_are_right_and_their_covariances_true(office_map, queries, observe,
                                                             thresholds):
    relocalizer = Relocalizer(office_map, RelocalizerOptions())
    right, accepted, within = [], [], []
    for frame in queries:
        result = relocalizer.relocalize([observe(frame)])
        near = result.solved and pose_error(result.map_from_camera, frame.map_from_camera)[0] < 1
        right.append(near)
        accepted.append(result.accepted)
        if near and result.accepted:
            difference = pose_difference(result.map_from_camera, frame.map_from_camera)
            within.append(difference @ np.linalg.solve(result.covariance, difference) < CHI2_95)
    right, accepted = np.array(right), np.array(accepted)
    precision = (right & accepted).sum() / accepted.sum()
    recall = (right & accepted).sum() / right.sum()
    print(f'\nof {accepted.sum()} accepted poses {precision:.3f} are within 1 m; of {right.sum()} '
          f'right ones {recall:.3f} are accepted; {np.mean(within):.3f} lie in their 95 % '
          'ellipsoid')
    assert precision >= thresholds['trust']['precision']
    assert recall >= thresholds['trust']['recall']
    low, high = thresholds['trust']['within_95']
    assert low <= np.mean(within) <= high


def test_several_boxes_on_one_landmark_count_once():
    evidence = Evidence(ious=(0.5, 0.7, 0.6), landmarks=(3, 3, 4), rival_score=0.0)
    assert one_to_one(evidence) == (2, pytest.approx(1.3))


def test_evidence_is_score_and_twice_the_margin():
    evidence = Evidence(ious=(0.8, 0.7), landmarks=(1, 2), rival_score=1.0)
    assert strength(evidence) == pytest.approx(1.5 + 2 * 0.5)


@pytest.mark.parametrize(('inliers', 'rival', 'reason'), [
    (3, 0.0, 'only 3 landmarks'), (5, 3.5, 'ambiguous'), (5, 1.0, '')])
def test_refusal_names_its_reason(inliers, rival, reason):
    evidence = Evidence((0.7,) * inliers, tuple(range(inliers)), rival)
    answer = refusal(evidence, RelocalizerOptions())
    assert answer.startswith(reason)
    assert bool(answer) == bool(reason)


def test_covariance_is_that_of_simulated_boxes(rng):
    """The linearized covariance against the scatter of poses solved from noisy boxes."""
    from cliploc_ros.core.p3p import solve_p3p
    from cliploc_ros.core.uncertainty import _VARIANCE_INFLATION
    centers = np.array([[-1.0, 0.2, 4.0], [1.2, -0.3, 5.0], [0.1, 0.9, 3.0]])
    seen = centers[:, :2] / centers[:, 2:]
    sizes, scatter = np.full((3, 2), 0.1), 0.01
    poses = []
    for _ in range(2_000):
        noisy = np.c_[seen + rng.normal(size=(3, 2)) * sizes * scatter, np.ones(3)]
        rotations, translations = solve_p3p(
            noisy / np.linalg.norm(noisy, axis=1, keepdims=True), centers)
        best = np.argmin(np.linalg.norm(translations, axis=1))
        pose = np.eye(4)
        pose[:3, :3] = rotations[best].T
        pose[:3, 3] = -rotations[best].T @ translations[best]
        poses.append(pose_difference(np.eye(4), pose))
    covariance = pose_covariance(np.eye(4), centers, sizes, scatter) / _VARIANCE_INFLATION
    expected = np.sqrt(np.diag(covariance))
    assert np.std(poses, axis=0) == pytest.approx(expected, rel=0.1)


def test_covariance_of_an_undetermined_pose_is_large_not_infinite():
    centers = np.array([[0.0, 0.0, 4.0]] * 3)
    covariance = pose_covariance(np.eye(4), centers, np.full((3, 2), 0.1), 0.1)
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert covariance.max() > 1
