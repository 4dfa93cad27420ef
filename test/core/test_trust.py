# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether accepted poses are right, and whether their covariances are true."""


import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance import Evidence, Match, refusal, support
from cliploc_ros.core.camera import Camera
from cliploc_ros.core.observation import Detections, Observation
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


@pytest.mark.parametrize('iterations', [500, 10000])
def test_accepted_poses_are_right_and_their_covariances_true(iterations, office_map, queries,
                                                             observe, thresholds):
    limits = thresholds['trust'][iterations]
    right, accepted, within = [], [], []
    relocalizer = Relocalizer(office_map, RelocalizerOptions(iterations=iterations))
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
    print(f'\n{iterations} iterations: of {accepted.sum()} accepted poses {precision:.3f} are '
          f'within 1 m; of {right.sum()} right ones {recall:.3f} are accepted; '
          f'{np.mean(within):.3f} lie in their 95 % ellipsoid')
    assert precision >= limits['precision']
    assert recall >= limits['recall']
    low, high = limits['within_95']
    assert low <= np.mean(within) <= high


APART = np.array([[0, 0, 10, 10], [100, 0, 110, 10], [200, 0, 210, 10]], dtype=np.float64)


def test_several_boxes_on_one_landmark_count_once():
    found = support([[Match(0, 3, 0.5), Match(1, 3, 0.7), Match(2, 4, 0.6)]], [APART])
    assert (found.inliers, found.score) == (2, pytest.approx(1.3))


def test_several_landmarks_behind_one_box_count_once():
    boxes = np.array([[0, 0, 100, 100], [2, 0, 100, 100], [0, 0, 50, 50]], dtype=np.float64)
    found = support([[Match(0, 1, 0.5), Match(1, 2, 0.7), Match(2, 3, 0.6)]], [boxes])
    assert (found.inliers, found.score) == (2, pytest.approx(1.3))


def test_nothing_supports_nothing():
    assert support([[]], [APART]).inliers == 0


def test_evidence_is_score_and_twice_the_margin():
    assert Evidence(2, score=1.5, rival_score=1.0).strength == pytest.approx(1.5 + 2 * 0.5)


@pytest.mark.parametrize(('evidence', 'options', 'reason'), [
    (Evidence(3, 2.5, 0.0), {}, 'only 3 objects'),
    (Evidence(5, 3.5, 3.5), {}, 'ambiguous: evidence'),
    (Evidence(8, 6.0, 5.5), {}, 'ambiguous: a pose elsewhere'),
    (Evidence(8, 6.0, 5.5), {'max_rival': 0.95}, ''),
    (Evidence(5, 3.5, 1.0, coverage=0.5), {'algorithm': 'bf'},
     'the search was cut short after 50 %'),
    (Evidence(5, 3.5, 1.0, coverage=0.5, tried=100), {},
     'the search was cut short after 100 hypotheses'),
    (Evidence(5, 3.5, 1.0, coverage=0.5, tried=5000), {}, ''),
    (Evidence(5, 3.5, 1.0, coverage=0.5, tried=5000, meetings=2), {}, 'the search met this pose'),
    (Evidence(5, 3.5, 1.0, meetings=0), {}, ''),
    (Evidence(5, 3.5, 1.0, meetings=2), {'algorithm': 'ransac'}, 'the search met this pose'),
    (Evidence(5, 3.5, 1.0, meetings=3), {'algorithm': 'ransac'}, ''),
    (Evidence(5, 3.5, 1.0), {'iterations': 100, 'algorithm': 'b-prosac'},
     'iterations = 100 are too few'),
    (Evidence(5, 3.5, 1.0), {'iterations': 100, 'algorithm': 'bf'}, ''),
    (Evidence(5, 3.5, 1.0), {}, ''),
])
def test_refusal_names_its_reason(evidence, options, reason):
    answer = refusal(evidence, RelocalizerOptions(**options))
    assert answer.startswith(reason)
    assert bool(answer) == bool(reason)


def garbage(rng, kind):
    """Ten boxes that mean nothing: anywhere, nearly one, five of them twice, or the image."""
    corners = rng.uniform((0, 0), (600, 440), (10, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(10, 200, (10, 2))], axis=1)
    if kind == 'nearly one box':
        boxes = boxes[:1] + rng.normal(0, 2, (10, 4))
    elif kind == 'repeated boxes':
        boxes = np.repeat(boxes[:5], 2, axis=0)
    elif kind == 'the whole image':
        boxes = np.array([[0.0, 0.0, 640.0, 480.0]]) + rng.normal(0, 5, (10, 4))
    return boxes


@pytest.mark.parametrize('kind', ['random boxes', 'nearly one box', 'repeated boxes',
                                  'the whole image'])
def test_garbage_is_hardly_ever_accepted(kind, office_map, rng, thresholds):
    relocalizer = Relocalizer(office_map, RelocalizerOptions(matching='class',
                                                             algorithm='ransac'))
    classes = np.array(sorted(set(office_map.class_ids)))
    accepted = 0
    for _ in range(200):
        detections = Detections(garbage(rng, kind), tuple(map(str, rng.choice(classes, 10))),
                                np.full(10, 0.9)).usable(640, 480, 50)
        accepted += relocalizer.relocalize([Observation(
            Camera(640, 480, 535.4, 539.2, 320.1, 247.6), detections)]).accepted
    print(f'\n{kind}: {accepted} of 200 garbage frames accepted')
    assert accepted <= thresholds['trust']['garbage_accepted_of_200']


def test_every_box_twice_is_no_more_evidence(office_map, queries, observe):
    relocalizer = Relocalizer(office_map, RelocalizerOptions(iterations=2000))
    wrong = 0
    for frame in queries.main_frames():
        once = observe(frame)
        rows = np.repeat(np.arange(len(once.detections)), 2)
        twice = Observation(once.camera, once.detections.select(rows), once.similarities[rows])
        result = relocalizer.relocalize([twice])
        wrong += result.accepted and pose_error(result.map_from_camera,
                                                frame.map_from_camera)[0] > 1.0
    assert wrong == 0


def test_a_search_cut_short_is_refused(office_map, queries, observe):
    relocalizer = Relocalizer(office_map, RelocalizerOptions(
        matching='class', algorithm='bf', time_budget_s=0.0))
    relocalizer.warm_up()
    results = [relocalizer.relocalize([observe(frame)]) for frame in queries.main_frames()]
    cut = [result for result in results if result.coverage < 1.0]
    assert len(cut) > 10
    assert not any(result.accepted for result in cut)
    assert max(result.search_ms for result in results) < 500


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
