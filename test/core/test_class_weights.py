# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects that the detector takes for one class and then for another."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.culling import FEW
from cliploc_ros.core.map.landmark_details import LEAST_CLASS_SHARE, LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import match_frame

ROOM = make_room()
BY_CLASS = RelocalizerOptions(matching='class')


def see(classes) -> Observation:
    """A perfect view of the room by a detector that gives these classes."""
    seen = see_room(ROOM)
    return Observation(CAMERA, Detections(seen.bboxes_xyxy, tuple(classes), seen.scores))


def weighted(landmark_map: LandmarkMap, share: float) -> LandmarkMap:
    """Every landmark looks like a 'z' in a share of its boxes."""
    return replace(landmark_map, details=tuple(
        LandmarkDetails(class_weights=((name, 1.0 - share), ('z', share)))
        for name in landmark_map.class_ids))


def with_others(landmark_map: LandmarkMap, count: int) -> LandmarkMap:
    """The map with more landmarks, far away."""
    rng = np.random.default_rng(5)
    return LandmarkMap(
        'map', landmark_map.landmark_ids + tuple(f'far_{i}' for i in range(count)),
        landmark_map.labels + ('far',) * count, landmark_map.class_ids + ('far',) * count,
        np.r_[landmark_map.centers, rng.uniform(60, 90, (count, 3))],
        np.r_[landmark_map.semi_axes, np.full((count, 3), 0.2)],
        np.r_[landmark_map.quats_xyzw, np.tile([0.0, 0, 0, 1], (count, 1))])


@pytest.mark.parametrize('landmarks', [len(ROOM), FEW + 20])
def test_a_detection_of_a_second_class_finds_its_landmark(landmarks):
    """By pairs in a small map, by the tree of culling in a large one."""
    landmark_map = with_others(ROOM, landmarks - len(ROOM))
    mistaken = see('zz' + ''.join(ROOM.class_ids[2:-2]) + 'zz')
    plain = Relocalizer(landmark_map, BY_CLASS).relocalize([mistaken])
    both = Relocalizer(weighted(landmark_map, 0.3), BY_CLASS).relocalize([mistaken])
    assert len(plain.matches) == len(ROOM) - 4
    assert len(both.matches) == len(ROOM)
    assert {match.detection: match.landmark for match in both.matches} == {
        row: row for row in range(len(ROOM))}
    assert pose_error(both.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05
    # 'z' says nothing: every landmark may look like one
    its, plain_its = both.hypotheses[0].support, plain.hypotheses[0].support
    assert its.rarity == pytest.approx(plain_its.rarity)
    assert both.confidence >= plain.confidence


@pytest.mark.parametrize(('share', 'is_candidate'), [
    (LEAST_CLASS_SHARE * 0.99, False), (LEAST_CLASS_SHARE * 1.01, True)])
def test_a_rare_class_makes_no_candidate(share, is_candidate):
    scene, _ = match_frame(weighted(ROOM, share), see('z' * len(ROOM)), BY_CLASS)
    assert len(scene.pairs) == (len(ROOM)**2 if is_candidate else 0)


def test_a_landmark_has_its_own_class_even_if_its_weights_lack_it():
    landmark_map = replace(ROOM, details=(LandmarkDetails(class_weights=(('z', 1.0),)),
                                          *[LandmarkDetails()] * (len(ROOM) - 1)))
    scene, _ = match_frame(landmark_map, see([*'az', *'q' * (len(ROOM) - 2)]), BY_CLASS)
    own = [row for row, name in enumerate(ROOM.class_ids) if name == 'a']
    assert sorted(scene.pairs.tolist()) == [[0, row] for row in own] + [[1, 0]]


def test_hybrid_matching_verifies_each_pair_once():
    """CLIP's pairs and those of the classes share some: neither adds them twice."""
    landmark_map = weighted(with_others(ROOM, FEW), 0.3)
    similarities = np.eye(len(ROOM), len(landmark_map), dtype=np.float32)
    observation = replace(see('z' * len(ROOM)), similarities=similarities)
    scene, _ = match_frame(landmark_map, observation, RelocalizerOptions(k=1))
    assert len(scene.potential.detections) == 0  # the tree offers them all
    assert set(scene.sorted_landmarks.numbers) == set(range(len(landmark_map)))
    assert len(np.unique(scene.pairs, axis=0)) == len(scene.pairs)
    assert scene.pairs[:len(ROOM)].tolist() == [[row, row] for row in range(len(ROOM))]


def test_a_class_that_a_landmark_is_only_taken_for_is_not_expected():
    """A person who walks through the view does not count against the pose."""
    seen = see_room(ROOM)
    detections = Detections(np.r_[seen.bboxes_xyxy, [[5.0, 5, 60, 90]]],
                            (*seen.class_ids, 'z'), np.ones(len(seen) + 1))
    frame = Observation(CAMERA, detections)
    for landmark_map in (ROOM, weighted(ROOM, 0.3)):
        found = Relocalizer(landmark_map, BY_CLASS).relocalize([frame])
        assert found.accepted and found.evidence.unexplained == 0
    named = replace(ROOM, class_ids=('z', *ROOM.class_ids[1:]))
    assert Relocalizer(named, BY_CLASS).relocalize([frame]).evidence.unexplained > 0
