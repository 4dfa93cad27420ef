# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether accepted poses are right, and whether their covariances are true."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.acceptance.confidence import (
    Setting,
    Support,
    compared_frame,
    confidences,
    none_right,
    support,
    utilities,
)
from cliploc_ros.core.acceptance.verdict import Evidence, Rival, refusal
from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.scene import make_scene
from cliploc_ros.offline.evaluation.trials import make_queries
from studies.acceptance.troubles import exchange_landmarks

# 95 % of a chi-squared variable of six degrees of freedom lies below this.
CHI2_95 = 12.592


def pose_difference(estimate, truth):
    """Position [m] and rotation [rad] from an estimate to the truth, in ROS order."""
    turn = Rotation.from_matrix(truth[:3, :3] @ estimate[:3, :3].T).as_rotvec()
    return np.concatenate([truth[:3, 3] - estimate[:3, 3], turn])


@pytest.mark.full
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


@pytest.mark.parametrize('matching', ['hybrid', 'class'])
def test_another_place_is_hardly_ever_accepted(matching, office_map, queries, thresholds):
    """The map's own objects, at places that they exchanged: whatever fits is wrong."""
    asked = make_queries(queries, office_map, every_frame=True)[::3]
    accepted, options = [], RelocalizerOptions(matching=matching)
    for seed in range(2):
        elsewhere, _ = exchange_landmarks(office_map, asked, 1.0, np.random.default_rng(seed))
        relocalizer = Relocalizer(elsewhere, options)
        accepted += [relocalizer.relocalize([one.observation]).accepted for one in asked]
    print(f'\n{matching}: {sum(accepted)} of {len(accepted)} accepted in another place')
    assert np.mean(accepted) <= thresholds['trust']['accepted_elsewhere'][matching]


APART = np.array([[0, 0, 10, 10], [100, 0, 110, 10], [200, 0, 210, 10]], dtype=np.float64)


@pytest.fixture
def compared(office_map, queries):
    """A frame whose boxes are three that lie apart and one that nearly repeats the third."""
    boxes = np.concatenate([APART, [[201.0, 0.0, 210.0, 10.0]]])
    camera = Camera(640, 480, *queries.intrinsics_fx_fy_cx_cy)
    detections = Detections(boxes, ('chair', *office_map.class_ids[4:5], 'none', 'none'),
                            np.ones(4))
    similarities = np.zeros((4, len(office_map)), dtype=np.float32)
    similarities[1, 4] = 1.0
    scene = make_scene(camera.normalize_bboxes(boxes), office_map.centers, office_map.shapes,
                       np.ones((4, len(office_map)), dtype=bool), np.empty((0, 2), int), 0.2)
    return compared_frame(office_map, detections, scene, similarities, np.arange(len(boxes)))


@pytest.fixture
def measure(office_map):
    """Measure the support of a pose."""
    return partial(support, office_map)


def test_several_boxes_on_one_landmark_count_once(measure, compared, queries):
    found = measure([compared], queries[0].map_from_camera[None],
                    [[Match(0, 3, 0.5), Match(1, 3, 0.7), Match(2, 4, 0.6)]])
    assert (found.inliers, found.score) == (2, pytest.approx(1.3))


def test_several_landmarks_behind_one_box_count_once(measure, compared, queries):
    found = measure([compared], queries[0].map_from_camera[None],
                    [[Match(2, 1, 0.5), Match(3, 2, 0.7), Match(0, 3, 0.6)]])
    assert (found.inliers, found.score) == (2, pytest.approx(1.2))


def test_what_no_landmark_explains_counts_against_a_pose(measure, compared, queries,
                                                         office_map):
    poses = np.tile(queries[0].map_from_camera, (2, 1, 1))
    # chair and the class of landmark 4 are in the map, 'none' is not
    assert 'chair' in office_map.class_ids and 'none' not in office_map.class_ids
    assert measure([compared], poses[:1], [[Match(0, 3, 0.5), Match(1, 4, 0.5)]]).unexplained == 0
    assert measure([compared], poses[:1], [[Match(1, 4, 0.5), Match(2, 3, 0.5)]]).unexplained == 1
    # seen twice, missed twice: one object, as are those that are explained twice
    twice = measure([compared] * 2, poses, [[Match(1, 4, 0.5)]] * 2)
    assert (twice.inliers, twice.unexplained) == (1, 1)


def test_labels_and_classes_support_a_pose(measure, compared, queries, office_map):
    poses, matches = queries[0].map_from_camera[None], [[Match(1, 4, 0.5)]]
    found = measure([compared], poses, matches)
    count = len(office_map)
    # one of all columns is 1, the others are 0
    assert found.likeness == pytest.approx(np.sqrt(count - 1), rel=1e-4)
    own = office_map.class_ids.count(office_map.class_ids[4])
    # as common as in any building, which is more than in this map
    common = CALIBRATION.common[office_map.class_ids[4]]
    assert common > own / count
    assert (found.rarity, found.unlabelled) == (pytest.approx(-np.log(common)), 0)
    by_class = measure([compared._replace(
        similarities=None, similarity_rows=np.full(4, -1))], poses, matches)
    assert (by_class.likeness, by_class.unlabelled) == (0.0, 1)
    assert by_class.misfit == found.misfit > 0


def test_an_object_in_several_frames_counts_once(measure, compared, queries):
    poses = np.tile(queries[0].map_from_camera, (2, 1, 1))
    once = measure([compared], poses[:1], [[Match(1, 4, 0.5)]])
    twice = measure([compared, compared], poses, [[Match(1, 4, 0.5)], [Match(1, 4, 0.7)]])
    assert twice == replace(once, score=pytest.approx(0.6))
    both = measure([compared, compared], poses, [[Match(1, 4, 0.5)], [Match(0, 3, 0.7)]])
    assert (both.inliers, both.score) == (2, pytest.approx(1.2))


def poses_at(*positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, 0, 3] = positions
    return poses


STRONG, WEAK = Support(7, 5.0, 10.0, 14.0, 14.0), Support(3, 1.5, 10.0, 2.0, 4.0)
ROOM, ORIGIN = Setting(40), (0.0, 0.0, 0.0)


def share(supports, poses, setting):
    """Return the confidences of poses that objects support."""
    return confidences(utilities(supports), poses, none_right(setting))


def test_confidence_is_shared_by_poses_that_differ():
    alone = share([STRONG], poses_at(0), ROOM)[0]
    first, second = share([STRONG, STRONG], poses_at(0, 5), ROOM)
    assert alone > 0.99
    assert first == pytest.approx(second)
    assert 0.45 < first <= 0.5


def test_poses_that_agree_speak_for_each_other():
    assert share([STRONG, STRONG], poses_at(0, 0.6), ROOM).min() > 0.99
    turned = poses_at(0, 0.6)
    turned[1, :3, :3] = Rotation.from_euler('z', 90, degrees=True).as_matrix()
    assert share([STRONG, STRONG], turned, ROOM).max() <= 0.5


def test_a_large_map_takes_confidence_and_a_known_vertical_gives_some():
    fair = Support(4, 3.0, 8.0, 6.0, 8.0)
    small, large, level, vague = (share([fair], poses_at(0), setting)[0] for setting in (
        Setting(20), Setting(2000), Setting(2000, 1.0), Setting(2000, 45.0)))
    assert large < level < small
    assert vague == large
    # a better vertical than any that the fit has seen says no more than the best of those
    assert (share([fair], poses_at(0), Setting(2000, 0.01))
            == share([fair], poses_at(0), Setting(2000, 0.5)))


def test_little_support_is_little_confidence():
    weak, rival = share([WEAK, WEAK], poses_at(0, 5), ROOM)
    assert weak + rival < 0.3
    assert share([Support()], poses_at(0), ROOM)[0] < 0.01


def test_confidences_of_poses_that_differ_add_up_to_one_at_most(rng):
    highest = 0.0
    for _ in range(200):
        count = rng.integers(1, 9)
        supports = [Support(int(rng.integers(0, 9)), rng.uniform(0, 9), rng.uniform(0, 30),
                            rng.uniform(0, 20)) for _ in range(count)]
        found = share(supports, poses_at(*5.0 * np.arange(count)), ROOM)
        # none is more certain than .9999, so none is less likely than .0001
        assert (found >= 0).all() and found.sum() <= 1.0 + 1e-4 * count
        highest = max(highest, found.sum())
    assert highest > 0.99, 'some of them are nearly certain'


@pytest.mark.parametrize(('evidence', 'options', 'reason'), [
    (Evidence(3, 0.995), {'min_inliers': 4}, '3 objects matched < 4; turn the camera'),
    (Evidence(3, 0.995), {}, ''),
    (Evidence(5, 0.5, rival=Rival(0.3, ORIGIN)), {},
     'confidence 0.50 < 0.99; ambiguous, another pose has 0.3; '),
    (Evidence(5, 0.5, rival=Rival(0.1, ORIGIN)), {},
     'confidence 0.50 < 0.99; 5 objects matched, 0 unexplained; '),
    (Evidence(8, 0.95), {'min_confidence': 0.9}, ''),
    (Evidence(8, 0.98999), {}, 'confidence 0.98 < 0.99; 8 objects matched'),
    (Evidence(8, 0.29), {}, 'confidence 0.29 < 0.99; 8 objects matched'),
    (Evidence(5, 0.995, coverage=0.5), {'algorithm': 'bf'},
     'search stopped after 50 % of the samples'),
    (Evidence(5, 0.995, coverage=0.5, tried=100), {},
     'search stopped after 100 < 500 hypotheses'),
    (Evidence(5, 0.995, coverage=0.5, tried=5000), {}, ''),
    (Evidence(5, 0.995, coverage=0.5, tried=5000, meetings=2), {},
     'confidence 0.91 < 0.99; pose met only 2 times in 5000 samples; raise iterations'),
    (Evidence(5, 0.995, meetings=1), {'algorithm': 'ransac'}, 'confidence 0.77 < 0.99; pose met'),
    (Evidence(5, 0.995), {'iterations': 100, 'algorithm': 'b-prosac'}, 'iterations 100 < 500'),
    (Evidence(5, 0.995, earlier=(0.0,) * 6), {},
     'mean confidence 0.14 < 0.5 of the last 7 frames in this pose'),
    (Evidence(5, 0.995, earlier=(0.0, 0.99, 0.0)), {}, 'mean confidence 0.49 < 0.5'),
    (Evidence(5, 0.995, earlier=(0.0, 0.99)), {}, '')])
def test_refusal_names_its_reason(evidence, options, reason):
    refused = refusal(evidence, RelocalizerOptions(**{'min_confidence': 0.99} | options))
    answer = refused.reason if refused else ''
    assert answer.startswith(reason)
    assert bool(answer) == bool(reason)
    assert len(f'refused: {answer}') <= 120


def test_no_refusal_names_a_rival_at_the_same_place(office_map, queries, observe):
    """Poses that agree with the best one to 1 m and 45 degrees are no rivals."""
    relocalizer, ambiguous = Relocalizer(office_map, RelocalizerOptions()), 0
    for frame in queries.main_frames():
        found = relocalizer.relocalize([observe(frame)])
        if 'ambiguous' in found.reason:
            ambiguous += 1
            best = found.hypotheses[0]
            errors = [pose_error(one.map_from_camera, best.map_from_camera)
                      for one in found.hypotheses]
            elsewhere = [one.confidence for one, (metres, degrees) in zip(
                found.hypotheses, errors, strict=True) if metres >= 1.0 or degrees >= 45.0]
            assert 0.0 < found.evidence.rival.likely <= 1.0 - best.confidence
            assert found.evidence.rival.likely <= max(elsewhere) / (
                found.evidence.found * found.evidence.certainty) + 1e-9
    assert ambiguous > 1


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


@pytest.mark.full
@pytest.mark.parametrize('kind', ['random boxes', 'nearly one box', 'repeated boxes',
                                  'the whole image'])
def test_garbage_is_never_accepted(kind, office_map, rng):
    relocalizer = Relocalizer(office_map, RelocalizerOptions(matching='class',
                                                             algorithm='ransac'))
    classes = np.array(sorted(set(office_map.class_ids)))
    accepted = 0
    for _ in range(100):
        detections = Detections(garbage(rng, kind), tuple(map(str, rng.choice(classes, 10))),
                                np.full(10, 0.9)).usable(640, 480, 50)
        accepted += relocalizer.relocalize([Observation(
            Camera(640, 480, 535.4, 539.2, 320.1, 247.6), detections)]).accepted
    print(f'\n{kind}: {accepted} of 200 garbage frames accepted')
    assert accepted == 0
