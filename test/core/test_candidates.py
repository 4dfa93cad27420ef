# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Candidates of each detection by class, label and image, in small and large maps."""

import threading
import time
from dataclasses import replace
from math import comb

import numpy as np
import pytest
import scene as scenes
from hypothesis import given
from hypothesis import strategies as st
from reference import candidate_mask, same_class, verify
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.geometry.ellipsoid import Poses, ellipse_bboxes, project_ellipsoids
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.culling import FEW, visible_members
from cliploc_ros.core.map.landmark_details import LEAST_CLASS_SHARE, LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import with_images
from cliploc_ros.core.map.landmark_map import ClassIndex, LandmarkMap
from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings, nearest_landmarks
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search import frame_search
from cliploc_ros.core.search.scene import make_scene
from cliploc_ros.core.search.strategies import Leaders, draw_ransac, search_samples
from cliploc_ros.errors import OptionsError


def test_rare_classes_come_first_and_nothing_twice():
    index = ClassIndex.of(('a', 'a', 'a', 'b'), {})
    rare = frame_search.class_candidates(index, index.classes_of(('a', 'b', 'a')), 100)
    assert rare.pairs.tolist() == [[1, 3], [0, 0], [0, 1], [0, 2], [2, 0], [2, 1], [2, 2]]
    similarities = np.array([[0.1, 0.9, 0.2, 0.3]] * 3, dtype=np.float32)
    both = frame_search.joined(frame_search.nearest_candidates(similarities, 1), rare, 4)
    assert both.pairs.tolist() == [[0, 1], [1, 1], [2, 1], [1, 3], [0, 0], [0, 2], [2, 0], [2, 2]]


def sorted_whole(similarities, k):
    order = np.argsort(-similarities, axis=1, kind='stable')[:, :k]
    return order, np.take_along_axis(similarities, order, axis=1)


@pytest.mark.parametrize('landmarks', [1, 40, 2048, 2049, 9_000])
def test_nearest_are_those_of_a_whole_sort(rng, landmarks):
    similarities = rng.random((5, landmarks), dtype=np.float32).round(2)  # with many equals
    k = min(landmarks, 7)
    found, values = nearest_landmarks(similarities, k)
    wanted, best = sorted_whole(similarities, k)
    assert (found == wanted).all()
    assert (values == best).all()


@given(st.integers(1, 12), st.integers(1, 40), st.integers(0, 2**32 - 1), st.data())
def test_a_shared_label_counts_for_each_landmark(labels, landmarks, seed, data):
    rng = np.random.default_rng(seed)
    used, of_landmarks = np.unique(rng.integers(0, labels, landmarks), return_inverse=True)
    embeddings = LabelEmbeddings(scenes.unit_rows(rng.standard_normal(
        (len(used), 16), dtype=np.float32)), of_landmarks)
    similarities = CropSimilarities(scenes.unit_rows(rng.standard_normal(
        (4, 16), dtype=np.float32)), embeddings)
    k = data.draw(st.integers(1, landmarks))
    found, values = nearest_landmarks(similarities, k)
    assert similarities.shape == (4, landmarks)
    wanted, best = sorted_whole(np.asarray(similarities), k)
    assert (found == wanted).all()
    np.testing.assert_allclose(values, best, atol=1e-6)


def test_what_is_not_finite_is_refused():
    similarities = np.zeros((2, 3_000), dtype=np.float32)
    similarities[1, 2_999] = np.nan
    with pytest.raises(OptionsError, match='not finite'):
        nearest_landmarks(similarities, 3)


def make_world(count, seed=0, classes=12):
    """Return a map around a camera at its origin, and the camera's observation of it."""
    rng = np.random.default_rng(seed)
    centers = np.c_[rng.uniform(-4, 4, (count, 2)), rng.uniform(-8, 8, count)]
    landmark_map = scenes.map_of([f'class {number}' for number in rng.integers(0, classes, count)],
                                 centers, rng.uniform(0.1, 0.4, (count, 3)))
    landmark_map = replace(landmark_map, quats_xyzw=scenes.unit_rows(
        np.random.default_rng(seed).normal(size=(count, 4))))
    boxes = ellipse_bboxes(project_ellipsoids(np.eye(4), centers, landmark_map.shapes))
    seen = np.nonzero((np.abs(boxes) < 0.6).all(axis=1))[0][:10]
    pixels = 500 * (boxes[seen] + rng.normal(0, 0.004, (len(seen), 4))) + [320, 240, 320, 240]
    similarities = rng.normal(0.2, 0.02, (len(seen), count)).astype(np.float32)
    similarities[np.arange(len(seen)), seen] += 0.05
    detections = Detections(pixels, tuple(landmark_map.class_ids[row] for row in seen),
                            np.ones(len(seen)))
    return landmark_map, Observation(scenes.CAMERA, detections, similarities)


@pytest.mark.parametrize('kind', ['class', 'clip', 'hybrid'])
@pytest.mark.parametrize('count', [50, 2000])
def test_verification_is_that_of_masks(count, kind, rng):
    """In a large map, landmarks out of sight are culled."""
    landmark_map, observation = make_world(count, classes=max(12, count // 50))
    options = RelocalizerOptions(matching=kind)
    scene, left_out = frame_search.match_frame(landmark_map, observation, options)
    assert left_out == 0
    classes = same_class(observation.detections.class_ids, landmark_map.class_ids)
    nearest = candidate_mask(frame_search.nearest_candidates(observation.similarities, options.k),
                             classes.shape)
    mask = {'class': classes, 'clip': nearest, 'hybrid': classes | nearest}[kind]
    candidates = np.zeros(mask.shape, dtype=bool)
    candidates[tuple(scene.pairs.T)] = True
    assert (candidates == mask).all()
    plain = make_scene(scenes.CAMERA.normalize_bboxes(observation.detections.bboxes_xyxy),
                       landmark_map.centers, landmark_map.shapes, mask, scene.pairs, 0.2)
    scored = 0
    for _ in range(200):
        pose = make_transform(Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(),
                              rng.normal(0, 0.3, 3))
        rotation, translation = pose[:3, :3].copy(), pose[:3, 3].copy()
        expected = verify(plain, rotation, translation)
        found = verify(scene, rotation, translation)
        assert found.score == expected.score
        assert (found.landmarks == expected.landmarks).all()
        scored += expected.score > 0
    assert scored > 20
    at_origin, members = Poses(np.eye(3)[None], np.zeros((1, 3))), len(scene.groups.members)
    visible = np.empty((2, members), dtype=np.int64)
    assert visible_members(scene.groups, at_origin, 0, visible) <= 0.5 * members
    leaders = Leaders.none_yet(300)
    assert [*search_samples(scene, draw_ransac(scene.pairs, 300, rng), leaders)]
    ranked = leaders.ranked()
    assert len(ranked) > 10
    for row in ranked:
        assert leaders.scores[row] == pytest.approx(verify(
            plain, leaders.rotations[row], leaders.translations[row]).score, abs=1e-9)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('far', [1e10, 1e155, 1e300, np.inf, np.nan])
@pytest.mark.parametrize('count', [50, 400])
def test_a_box_that_no_lens_sees_changes_nothing(count, far):
    landmark_map, observation = make_world(count)
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions())
    alone = relocalizer.relocalize([observation])
    seen = observation.detections
    detections = scenes.with_boxes(seen, [[0.0, 0, far, far], [-far, -far, far, far]],
                                   seen.class_ids[:2])
    similarities = np.r_[observation.similarities, observation.similarities[:2]]
    found = relocalizer.relocalize([replace(observation, detections=detections,
                                            similarities=similarities)])
    assert alone.solved
    assert (found.map_from_camera == alone.map_from_camera).all()


def test_too_many_candidates_are_cut_and_said(monkeypatch):
    landmark_map, observation = make_world(400)
    whole, _ = frame_search.match_frame(landmark_map, observation, RelocalizerOptions())
    monkeypatch.setattr(frame_search, 'MAX_CANDIDATES', 60)
    cut, left_out = frame_search.match_frame(landmark_map, observation, RelocalizerOptions())
    assert len(cut.pairs) < len(whole.pairs) <= len(cut.pairs) + left_out
    assert (cut.pairs == whole.pairs[:len(cut.pairs)]).all()
    share = comb(len(cut.pairs), 3) / comb(len(cut.pairs) + left_out, 3)
    found = Relocalizer(landmark_map, RelocalizerOptions(iterations=1_000_000)).relocalize(
        [observation])
    assert 0 < found.coverage <= share


@pytest.mark.parametrize('limit', [1, 77, 2_000])
def test_no_more_are_tried_than_asked_for(limit):
    """The duration of a block has no influence, so that equal options give equal results."""
    landmark_map, observation = make_world(400)
    options = RelocalizerOptions(iterations=limit)
    first = Relocalizer(landmark_map, options).relocalize([observation])
    again = Relocalizer(landmark_map, replace(options)).relocalize([observation])
    assert first.tried == again.tried == limit
    assert (first.map_from_camera == again.map_from_camera).all() if first.solved \
        else not again.solved


def test_other_programs_do_not_cut_a_search_but_the_end_of_its_request_does():
    """The thread waits for ten times its budget, as on a busy machine."""
    landmark_map, observation = make_world(60)
    relocalizer = Relocalizer(landmark_map, RelocalizerOptions(time_budget_s=0.05))
    relocalizer.warm_up()
    waiting = relocalizer.begin(1)
    threading.Event().wait(0.6)
    assert not waiting.search_end().is_over and not waiting.refinement_end.is_over
    late = relocalizer.begin(1, request=time.monotonic())
    assert late.search_end().is_over and late.refinement_end.is_over
    cut = Localizer(relocalizer).answer(Query((observation,)), deadline=time.monotonic())
    assert cut.tried < Localizer(relocalizer).answer(Query((observation,))).tried
    assert cut.refusal_kind == RefusalKind.SEARCH_CUT_SHORT
    assert cut.reason.endswith('; raise timeout_s') and 'budget' not in cut.reason


def see(classes) -> Observation:
    """Return a perfect view of the room by a detector with these classes."""
    return Observation(scenes.CAMERA, replace(scenes.SEEN, class_ids=tuple(classes)))


def weighted(landmark_map: LandmarkMap, share: float) -> LandmarkMap:
    """Return a map in which every landmark is detected as 'z' in a share of its boxes."""
    return replace(landmark_map, details=tuple(
        LandmarkDetails(class_weights=((name, 1.0 - share), ('z', share)))
        for name in landmark_map.class_ids))


@pytest.mark.parametrize('landmarks', [len(scenes.ROOM), FEW + 20])
def test_a_detection_of_a_second_class_finds_its_landmark(landmarks):
    """A small map uses pairs, a large map the culling tree."""
    landmark_map = scenes.with_others(scenes.ROOM, landmarks)
    mistaken = see('zz' + ''.join(scenes.ROOM.class_ids[2:-2]) + 'zz')
    plain = Relocalizer(landmark_map, scenes.BY_CLASS).relocalize([mistaken])
    both = Relocalizer(weighted(landmark_map, 0.3), scenes.BY_CLASS).relocalize([mistaken])
    assert len(plain.matches) == len(scenes.ROOM) - 4
    assert len(both.matches) == len(scenes.ROOM)
    assert {match.detection: match.landmark for match in both.matches} == {
        row: row for row in range(len(scenes.ROOM))}
    assert pose_error(both.map_from_camera, scenes.MAP_FROM_CAMERA)[0] < 0.05
    # 'z' gives no information: every landmark may be detected as 'z'
    its, plain_its = both.hypotheses[0].support, plain.hypotheses[0].support
    assert its.rarity == pytest.approx(plain_its.rarity)
    assert both.confidence >= plain.confidence


@pytest.mark.parametrize(('share', 'is_candidate'), [
    (LEAST_CLASS_SHARE * 0.99, False), (LEAST_CLASS_SHARE * 1.01, True)])
def test_a_rare_class_makes_no_candidate(share, is_candidate):
    seen = see('z' * len(scenes.ROOM))
    scene, _ = frame_search.match_frame(weighted(scenes.ROOM, share), seen, scenes.BY_CLASS)
    assert len(scene.pairs) == (len(seen.detections)**2 if is_candidate else 0)


def test_a_class_that_a_landmark_is_only_taken_for_is_not_expected():
    """A person walking through the view does not count against the pose."""
    frame = Observation(scenes.CAMERA, scenes.with_boxes(scenes.SEEN, [[5.0, 5, 60, 90]], 'z'))
    for landmark_map in (scenes.ROOM, weighted(scenes.ROOM, 0.3)):
        found = Relocalizer(landmark_map, scenes.BY_CLASS).relocalize([frame])
        assert found.accepted and found.evidence.unexplained == 0
    named = replace(scenes.ROOM, class_ids=('z', *scenes.ROOM.class_ids[1:]))
    assert Relocalizer(named, scenes.BY_CLASS).relocalize([frame]).evidence.unexplained > 0


COUNT, SIZE = 50, 64


@pytest.fixture
def world(rng):
    """Return labels, images and crops of one space, with labels and images apart as in CLIP."""
    objects, gap = (scenes.unit_rows(rng.normal(size=(count, SIZE))) for count in (COUNT, 2))
    labels, means, crops = (scenes.unit_rows(rows).astype(np.float32) for rows in (
        gap[0] + 0.25 * objects, gap[1] + objects,
        gap[1] + objects + 0.06 * rng.normal(size=objects.shape)))
    images = scenes.embeddings_of(map(str, range(COUNT)), means)
    return LabelEmbeddings.of(labels), images, crops


def test_labels_and_images_spread_alike(world):
    labels, images, crops = world
    both = crops @ np.asarray(with_images(labels, images, 'both')).T
    with_labels, with_means = crops @ labels.unique.T, crops @ images.means.T
    share = np.linalg.lstsq(np.stack([with_labels.ravel(), with_means.ravel()], axis=1),
                            both.ravel(), rcond=None)[0]
    assert share.sum() == pytest.approx(1.0, abs=1e-3)  # a weighted mean of two cosines
    alone = np.array([with_labels.std(axis=1).mean(), with_means.std(axis=1).mean()])
    assert alone[1] > 1.8 * alone[0]
    spreads = share * alone
    assert 0.6 < spreads[0] / spreads[1] < 1.6
    assert np.abs(both).max() <= 1.0


@pytest.mark.parametrize('compare', ['image', 'both'])
def test_a_landmark_without_images_keeps_its_label(world, compare):
    labels, images, crops = world
    means = images.means.copy()
    means[:10] = 0.0
    rows = with_images(labels, replace(images, means=means), compare)
    similarities = crops @ np.asarray(rows).T
    known, unknown = similarities[:, 10:], similarities[:, :10]
    # without images it is neither the best nor the worst of all crops
    assert abs(unknown.mean() - known.mean()) < similarities.std(axis=1).mean()
    own = np.arange(10)
    assert (np.argmax(unknown[own], axis=1) == own).mean() > 0.8
    found, _ = nearest_landmarks(CropSimilarities(crops, rows), 1)
    assert (found[:, 0] == np.arange(len(crops))).mean() > 0.7
