# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One answer from objects and keyframes: agreement, contradiction, and what each alone may do."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.acceptance.recognition import ObjectsThere, objects_there
from cliploc_ros.core.acceptance.refusal_kind import RefusalKind
from cliploc_ros.core.acceptance.support import Support
from cliploc_ros.core.combination import combine, fuse
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.keyframes.localization import Recognition, RecognizedPlace
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Hypothesis, Relocalization

OPTIONS = RelocalizerOptions(matching='class')
ROUGH, FINE = np.diag([0.01] * 3 + [1e-3] * 3), np.diag([1e-4] * 3 + [1e-5] * 3)
NOWHERE = Relocalization(False, '2 objects matched < 3')
SOME = ObjectsThere(3, 1)


def at(x):
    return make_transform(np.eye(3), np.array([x, 0.0, 0.0]))


def by_objects(x, confidence, accepted):
    return Relocalization(accepted, '' if accepted else 'confidence too low',
                          (Hypothesis(at(x), 2.0, confidence, Support(inliers=4)),),
                          covariance=ROUGH)


def by_keyframes(x, inliers=200, rival=0, confirmed=0.8, rival_x=20.0):
    places = (RecognizedPlace(at(x), FINE, FINE, inliers, confirmed, 0.85),
              RecognizedPlace(at(rival_x), FINE, FINE, rival, confirmed, 0.85))
    return Recognition(places[:2 if rival else 1])


def test_without_a_layer_nothing_changes():
    found = by_objects(0.0, 0.995, True)
    assert combine(found, Recognition(), None, OPTIONS) is found


def test_many_points_accept_what_objects_could_not():
    found = combine(NOWHERE, by_keyframes(1.0), SOME, OPTIONS)
    assert found.accepted
    assert found.source == 'keyframes'
    assert pose_error(found.map_from_camera, at(1.0))[0] == 0.0
    assert found.covariance is FINE


def test_a_weak_pose_of_keyframes_improves_that_of_objects():
    weak = by_keyframes(0.0, inliers=60, confirmed=0.2)  # of few cells
    found = combine(by_objects(0.1, 0.995, True), weak, SOME, OPTIONS)
    assert found.accepted
    assert found.source == 'both'
    assert pose_error(found.map_from_camera, at(0.0))[0] < 0.01
    assert not combine(by_objects(0.1, 0.5, False), weak, SOME, OPTIONS).accepted


def test_a_dozen_points_hardly_move_the_pose_of_objects():
    few = by_keyframes(0.0, inliers=12, confirmed=0.2)
    found = combine(by_objects(0.1, 0.995, True), few, SOME, OPTIONS)
    assert found.accepted
    assert pose_error(found.map_from_camera, at(0.1))[0] < 0.01


def test_of_two_poses_that_contradict_each_other_the_likelier_leads():
    found = combine(by_objects(5.0, 0.93, True), by_keyframes(0.0), SOME, OPTIONS)
    assert not found.accepted
    assert found.refusal_kind == RefusalKind.CONTRADICTION
    assert pose_error(found.map_from_camera, at(0.0))[0] == 0.0


def test_of_agreeing_poses_the_strong_one_of_keyframes_stays():
    found = combine(by_objects(0.1, 0.9, False), by_keyframes(0.0), SOME, OPTIONS)
    assert found.accepted
    assert found.source == 'both'
    assert found.confidence > 0.99
    assert pose_error(found.map_from_camera, at(0.0))[0] == 0.0
    assert np.allclose(found.covariance, FINE)


@pytest.mark.parametrize(('confidence', 'accepted'), [(0.995, True), (0.7, False)])
def test_objects_elsewhere_refuse_a_poster(confidence, accepted):
    found = combine(by_objects(5.0, confidence, accepted), by_keyframes(0.0), SOME, OPTIONS)
    assert not found.accepted
    assert '5.00 m apart' in found.reason


@pytest.mark.parametrize('seen', [
    by_keyframes(0.0, inliers=12), by_keyframes(0.0, confirmed=0.1),
    by_keyframes(0.0, confirmed=0.5), by_keyframes(0.0, rival=150), by_keyframes(0.0, rival=25)],
    ids=['few points', 'little of the image', 'a poster', 'two equal rooms', 'another place'])
def test_weak_features_accept_nothing(seen):
    refused = combine(NOWHERE, seen, SOME, OPTIONS)
    assert not refused.accepted
    assert 'keyframes: ' in refused.reason


def test_objects_stand_against_few_points_and_decide_between_two_equal_rooms():
    found = by_objects(5.0, 0.995, True)
    assert combine(found, by_keyframes(0.0, inliers=12), SOME, OPTIONS) is found
    twin = by_keyframes(0.0, rival=190, rival_x=5.1)
    assert combine(found, twin, SOME, OPTIONS) is found
    other = by_keyframes(0.0, rival=190, rival_x=9.0)
    assert not combine(found, other, SOME, OPTIONS).accepted


def test_accepted_objects_elsewhere_do_not_overrule_strong_features():
    found = combine(by_objects(5.0, 0.999, True), by_keyframes(0.0), ObjectsThere(0, 8), OPTIONS)
    assert not found.accepted
    assert 'contradict' in found.reason
    assert found.refusal_kind == 'contradiction'


def test_objects_that_the_pose_does_not_explain_speak_against_it():
    seen = by_keyframes(0.0, inliers=80, confirmed=0.6)
    assert combine(NOWHERE, seen, ObjectsThere(4, 0), OPTIONS).accepted
    assert not combine(NOWHERE, seen, ObjectsThere(0, 8), OPTIONS).accepted


def test_fusing_takes_the_better_pose_of_each_direction():
    level, upright = np.diag([0.01, 0.01, 1.0, 1.0, 1.0, 1.0]), np.diag([1.0] * 2 + [0.01] * 4)
    pose, covariance = fuse(at(0.0), level, at(0.1), upright)
    assert 0.0 < pose[0, 3] < 0.02
    assert covariance[0, 0] < 0.03
    assert covariance[2, 2] < 0.03


def test_fusing_twice_the_same_gains_nothing():
    pose, covariance = fuse(at(0.2), ROUGH, at(0.2), ROUGH)
    assert np.allclose(pose, at(0.2))
    assert np.allclose(covariance, ROUGH)
    pose, covariance = fuse(at(0.2), ROUGH, at(0.0), FINE)
    assert np.allclose(pose, at(0.0))
    assert np.allclose(covariance, FINE)


@pytest.mark.parametrize('lens', [
    ('plumb_bob', (-0.3, 0.0, 0.0, 0.0)), ('equidistant', (-0.02, 0.01, -0.005, 0.001))])
def test_a_wide_lens_explains_its_objects_too(lens):
    """In the corners of its image the lens shows nothing."""
    room = make_room()
    wide = Camera(640, 480, 230.0, 230.0, 320.0, 240.0, *lens)
    assert np.isnan(wide.normalize_points(np.zeros((1, 2)))).any()
    seen = see_room(room)
    corners = CAMERA.normalize_points(seen.bboxes_xyxy.reshape(-1, 2))
    boxes = wide.project_normalized(corners).reshape(-1, 4)
    observation = Observation(wide, replace(seen, bboxes_xyxy=boxes))
    assert objects_there(room, observation, MAP_FROM_CAMERA) == ObjectsThere(len(room), 0)


def test_a_perfect_view_explains_its_objects_only_where_it_is():
    room = make_room()
    observation = Observation(CAMERA, see_room(room))
    assert objects_there(room, observation, MAP_FROM_CAMERA) == ObjectsThere(len(room), 0)
    away = MAP_FROM_CAMERA.copy()
    away[0, 3] += 3.0
    assert objects_there(room, observation, away).explained < len(room) // 2
    unknown = replace(observation.detections, class_ids=('z',) * len(room))
    assert objects_there(room, replace(observation, detections=unknown), away) == (0, 0)
