# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One verdict from objects and keyframes; two looks at a room and at a picture of it."""

from dataclasses import replace

import numpy as np
import pytest
from scene import BY_CLASS, CAMERA, MAP_FROM_CAMERA, ROOM, SEEN, doubled_room, rigid, with_boxes
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.acceptance import confidence
from cliploc_ros.core.acceptance.genuine import compare_motion
from cliploc_ros.core.acceptance.looks import Look, Looks
from cliploc_ros.core.acceptance.verdict import RefusalKind
from cliploc_ros.core.fit.covariance import fuse, odometry_deviations
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.keyframes.layer import FROM_DEPTH
from cliploc_ros.core.keyframes.localization import NOTHING_KNOWN
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import find_pose
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import NEVER, Deadline
from cliploc_ros.core.relocalizer import Relocalizer

FINE = np.diag([1e-4] * 3 + [1e-5] * 3)


class Says:
    """A keyframe search with a known answer, in a layer that covers a share of every view."""

    def __init__(self, *places, covers=1.0, is_complete=True):
        self._seen = Recognition(places, is_complete)
        self._covers = covers

    def deviation_per_metre(self, place):
        return 0.01

    def recognize(self, guesses, prior=NOTHING_KNOWN):
        return self._seen

    def begin_thorough(self):
        return False

    def coverage(self, map_from_camera):
        return self._covers if np.isscalar(self._covers) else self._covers(map_from_camera)


def moved(x, pose=MAP_FROM_CAMERA):
    return make_transform(pose[:3, :3], pose[:3, 3] + np.array([x, 0.0, 0.0]))


def place(x=0.0, inliers=200, confirmed=0.9, reach=1.0, **fields):
    """Return points over the middle of the image, within a share of its width and height."""
    rng, size = np.random.default_rng(0), np.array([CAMERA.width, CAMERA.height])
    pixels = size * (0.5 + reach * rng.uniform(-0.55, 0.55, (inliers, 2)))
    return RecognizedPlace(moved(x), FINE, 0.5 * FINE, inliers, confirmed, pixels=pixels,
                           **fields)


def ask(recognizer=None, objects=12, options=BY_CLASS, room=ROOM, **known):
    seen = Observation(CAMERA, SEEN.select(np.arange(objects)), **known)
    return Relocalizer(room, options).relocalize([seen], recognizer)


def error_m(found, x=0.0):
    return pose_error(found.map_from_camera, moved(x))[0]


def test_a_thorough_search_that_time_cuts_off_leaves_the_result_of_the_fast_one():
    class Cut(Says):
        deadline = np.inf

        def begin_thorough(self):
            self._seen = Recognition(is_complete=False, is_thorough=True)
            return True
    cut, fast = (ask(kind(place(inliers=9)), objects=0) for kind in (Cut, Says))
    assert not cut.accepted and cut.reason == fast.reason and cut.hypotheses


def test_keyframes_that_recognize_nothing_leave_the_objects_pose():
    alone, found = ask(), ask(Says(covers=0.0))
    assert found.accepted and found.source == 'objects'
    np.testing.assert_array_equal(found.map_from_camera, alone.map_from_camera)
    assert found.confidence == alone.confidence


def test_many_points_accept_what_objects_could_not():
    assert ask(objects=0).refusal_kind == RefusalKind.TOO_FEW_OBJECTS
    found = ask(Says(place(3.0)), objects=0)
    assert found.accepted and found.source == 'keyframes'
    assert error_m(found, 3.0) < 1e-12
    np.testing.assert_array_equal(found.covariance, FINE)


def test_points_of_a_thorough_search_count_less():
    """The thorough pass finds several times as many points, and so do places that look alike."""
    fast, thorough = (ask(Says(place(3.0, inliers=38, confirmed=0.5, is_thorough=is_thorough)),
                          objects=0) for is_thorough in (False, True))
    assert fast.accepted and not thorough.accepted
    assert ask(Says(place(3.0, is_thorough=True)), objects=0).accepted, 'more points suffice'


@pytest.mark.parametrize(('apart', 'accepted'), [
    (0.2, False), (1.0, True), (2.0, True), (4.0, False)])
def test_the_fewer_cells_match_the_farther_away_a_keyframe_must_be(apart, accepted):
    """Next to a keyframe, all of the image matches; from the opposite side, no feature does."""
    found = ask(Says(place(3.0, inliers=40, confirmed=0.4, apart=apart)), objects=0)
    assert found.accepted == accepted


@pytest.mark.parametrize(('apart', 'kind'), [
    (0.0, RefusalKind.CHANGED), (0.9, None), (1.5, None)])
def test_a_part_of_an_image_next_to_a_keyframe_may_be_a_picture(apart, kind):
    found = ask(Says(place(3.0, confirmed=0.5, reach=0.5, apart=apart)), objects=0)
    assert found.refusal_kind == kind and found.evidence.signs.apart == min(apart, 1.0)


def test_the_pose_of_many_points_stays_as_it_is_and_a_few_are_fused():
    strong, weak = ask(Says(place(0.05))), ask(Says(place(0.05, inliers=9)))
    assert strong.accepted and weak.accepted and strong.source == weak.source == 'both'
    assert error_m(strong, 0.05) < 1e-12
    assert error_m(weak) < 0.02, 'a few points hardly change the pose from objects'
    assert [len(seen.cameras) for seen in (strong, weak)] == [0, 1], \
        'only a pose from boxes checks the camera'
    points = ask(Says(place(0.05, inliers=9)), objects=0)
    assert weak.evidence.by_points <= points.evidence.by_points, 'objects add no more evidence'


@pytest.mark.parametrize('mapped', [0, 1, 5])
@pytest.mark.parametrize('fields', [
    {'inliers': 30, 'confirmed': 0.9}, {'inliers': 175, 'confirmed': 0.6, 'reach': 0.5},
    {'inliers': 12}], ids=['few points', 'a part of the image', 'too few points'])
def test_objects_never_take_from_keyframes(fields, mapped):
    """Most objects of a room are never mapped; in this test their boxes fit nowhere."""
    corners = np.array([[x, y] for x in (10.0, 560.0) for y in (10.0, 220.0, 420.0)])
    joined = with_boxes(SEEN.select(np.arange(mapped)),
                        np.hstack([corners, corners + np.array([25.0, 45.0])]), 'abcabc')
    recognizer, relocalizer = Says(place(0.003, **fields)), Relocalizer(ROOM, BY_CLASS)
    alone = ask(recognizer, objects=0)
    found = relocalizer.relocalize([Observation(CAMERA, joined)], recognizer)
    # the map's other objects are in sight and missed, while the strangers are not explained
    assert (found.evidence.signs.contradicted > 0.0) == (mapped > 0 and fields['inliers'] < 100)
    assert found.confidence > alone.confidence - 0.02 > 0.05, 'rivals from the boxes'
    assert found.evidence.likely > alone.evidence.likely - 0.02
    assert found.evidence.by_points > alone.evidence.by_points - 0.02
    if mapped < 3 or fields['inliers'] > 12:  # else points do not determine the pose
        assert error_m(found, 0.003) < 1e-12
        np.testing.assert_array_equal(found.covariance, alone.covariance)
        assert not found.cameras


def test_a_small_group_takes_nothing_from_points(monkeypatch):
    likely = []
    for against in (0.0, 6.0):
        monkeypatch.setattr(confidence, '_of_group', lambda *_, against=against: against)
        likely.append([ask(some, objects=4).evidence.likely
                       for some in (Says(place(inliers=8)), None)])
    assert likely[0][0] == likely[1][0] and likely[0][1] > likely[1][1]


def test_points_that_agree_by_chance_change_nothing():
    likely = {ask(Says(place(inliers=inliers, confirmed=0.0)), objects=3).evidence.likely
              for inliers in (6, 7, 8)}
    assert len(likely) == 1 and likely.pop() < 0.9


@pytest.mark.parametrize('cause', ['too few objects', 'a search cut short', 'earlier looks'])
def test_a_dozen_points_do_not_override_what_objects_lack(cause):
    objects, options, looks = 12, BY_CLASS, Looks()
    if cause == 'too few objects':
        objects = 2
    elif cause == 'a search cut short':
        options = replace(BY_CLASS, iterations=100, algorithm='bf', time_budget_s=0.0)
    seen = Observation(CAMERA, SEEN.select(np.arange(objects)), stamp_ns=10,
                       odom_from_camera=np.eye(4))
    if cause == 'earlier looks':
        for stamp_ns in range(6):
            looks = looks.with_look(Look(replace(seen, stamp_ns=stamp_ns), moved(9.0), 0.3))
    relocalizer = Relocalizer(ROOM, options)
    relocalizer.warm_up()
    frame = relocalizer.search(
        seen, Deadline(-1.0) if cause == 'a search cut short' else NEVER)
    found = relocalizer.locate([frame], looks=looks, recognizer=Says(place(0.0, inliers=12)))
    assert not found.accepted, found


def test_a_place_that_moves_otherwise_than_odometry_says_is_no_room():
    first = Observation(CAMERA, SEEN.select(np.arange(0)), odom_from_camera=np.eye(4))
    second = replace(first, stamp_ns=10, odom_from_camera=moved(0.3, np.eye(4)))
    looks = Looks().with_look(Look(first, MAP_FROM_CAMERA, 0.99, place()), accepted=True)
    relocalizer = Relocalizer(ROOM, BY_CLASS)
    found = [relocalizer.locate([relocalizer.search(observation)], looks=looks,
                                recognizer=Says(place()))
             for observation in (second, replace(second, odom_from_camera=np.eye(4)))]
    assert [result.accepted for result in found] == [False, True]


@pytest.mark.parametrize('inliers', [60, 400])
def test_two_sources_that_contradict_each_other_are_refused(inliers):
    found = ask(Says(place(5.0, inliers=inliers)), objects=6)
    assert not found.accepted
    assert found.refusal_kind in {RefusalKind.CONTRADICTION, RefusalKind.UNEXPLAINED}
    assert found.source == 'objects' and found.evidence.rival.is_other_source


def test_a_place_that_the_layer_covers_but_does_not_recognize_loses_confidence():
    covered, elsewhere = ask(Says(covers=1.0), objects=5), ask(Says(covers=0.0), objects=5)
    assert covered.confidence < elsewhere.confidence
    cut = ask(Says(covers=1.0, is_complete=False), objects=5)
    assert cut.confidence == elsewhere.confidence, 'an interrupted search gives no evidence'


@pytest.mark.parametrize(('fields', 'kind'), [
    ({'inliers': 9, 'confirmed': 0.3}, RefusalKind.TOO_FEW_OBJECTS),
    ({'confirmed': 0.3, 'reach': 0.5}, RefusalKind.CHANGED),
    ({'focal_ratio': 0.5, 'focal_deviation': 0.02}, RefusalKind.CHANGED),
    ({'tilt_error': 9.0}, None)], ids=['few points', 'a picture', 'focal length', 'vertical'])
def test_weak_features_accept_nothing(fields, kind):
    known = {'up_in_camera': -MAP_FROM_CAMERA[1, :3] if 'tilt_error' in fields else None}
    found = ask(Says(place(**fields)), objects=0, **known)
    assert not found.accepted
    assert kind is None or found.refusal_kind == kind


def test_a_picture_refuses_the_objects_in_it_too():
    assert ask(objects=8).accepted
    found = ask(Says(place(focal_ratio=0.6, focal_deviation=0.02)), objects=8)
    assert not found.accepted
    assert 'picture' in found.reason


def two_rooms(lacking=0):
    """Return the room and a copy of it 20 m away, without some of its objects."""
    return doubled_room(np.array([20.0, 0.0, 0.0])).select(range(2 * len(ROOM) - lacking))


@pytest.mark.parametrize('lacking', [0, 3])
def test_the_twin_of_a_place_without_keyframes_stays_a_rival(lacking):
    def covers(pose):
        return float(pose[0, 3] < 10.0)

    found = ask(Says(place(), covers=covers), room=two_rooms(lacking))
    assert not found.accepted and found.refusal_kind == RefusalKind.LOOK_ALIKE


@pytest.mark.parametrize(('covered', 'objects', 'is_sure'), [
    (0.0, 0, True), (0.0, 12, False), (0.3, 12, False), (0.6, 12, True)])
def test_objects_have_no_say_where_keyframes_tell_a_twin_apart(covered, objects, is_sure):
    """Neither without a matched object, nor where keyframes cover enough of the twin."""
    found = ask(Says(place(), covers=lambda pose: 1.0 if pose[0, 3] < 10.0 else covered),
                objects=objects, room=two_rooms())
    assert (found.evidence.distinct > 0.999) == is_sure
    assert found.accepted or not is_sure


@pytest.mark.parametrize('covers', [1.0, 0.1])
def test_keyframes_tell_a_twin_that_they_cover_as_well_apart(covers):
    found = ask(Says(place(), covers=covers), room=two_rooms())
    assert found.accepted and found.evidence.distinct > 0.99
    both = ask(Says(place(), place(20.0, inliers=190), covers=covers), room=two_rooms())
    assert not both.accepted and both.evidence.distinct < 0.6, 'both rooms are recognized'
    weak = ask(Says(place(inliers=8, confirmed=0.0), covers=covers), room=two_rooms())
    assert weak.source == 'both' and weak.evidence.distinct < 0.6, 'chance points give no evidence'


@pytest.mark.parametrize(('objects', 'accepted'), [(3, True), (12, False)])
def test_keyframes_tell_a_place_apart_that_a_turn_repeats_by_chance(objects, accepted):
    """A place of few objects has such a twin by chance, a symmetric hall by design."""
    eye, turn = MAP_FROM_CAMERA[:3, 3], Rotation.from_euler('z', np.pi)
    half = ROOM.select(range(objects))
    half = replace(half, centers=eye + 0.7 * (half.centers - eye), semi_axes=0.7 * half.semi_axes)
    axis = half.centers.mean(axis=0) * [1.0, 1.0, 0.0]
    other = replace(half, centers=turn.apply(half.centers - axis) + axis,
                    quats_xyzw=(turn * Rotation.from_quat(half.quats_xyzw)).as_quat(),
                    landmark_ids=tuple(f'{name}_2' for name in half.landmark_ids)
                    ).select(range(objects - 1))
    found = ask(Says(place(), covers=lambda pose: float(pose_error(pose, MAP_FROM_CAMERA)[0] < 1)),
                objects=objects, room=half.with_more(other))
    assert found.evidence.twin is not None
    assert found.accepted == accepted and (found.evidence.distinct > 0.99) == accepted


def test_fusing_takes_the_better_pose_of_each_direction():
    level, upright = np.diag([0.01, 0.01, 1.0, 1.0, 1.0, 1.0]), np.diag([1.0] * 2 + [0.01] * 4)
    pose, covariance = fuse(moved(0.0), level, moved(0.1), upright)
    assert 0.0 < pose[0, 3] - MAP_FROM_CAMERA[0, 3] < 0.02
    assert covariance[0, 0] < 0.03 and covariance[2, 2] < 0.03
    np.testing.assert_allclose(fuse(moved(0.0), FINE, moved(0.1), FINE)[1], FINE)


# ---- two looks with odometry between them: a room moves as odometry predicts, a picture does not
SHARED = np.diag([0.012**2] * 3 + [np.radians(0.45)**2] * 3)
SURE = chi2.isf(1e-3, 6)


def turned(degrees, behind_m=0.0):
    """Return the motion of a camera that turns to the right about an axis behind it."""
    turn = rigid(axis='y', degrees=degrees)[:3, :3]
    return make_transform(turn, (turn - np.eye(3)) @ np.array([0.0, 0.0, behind_m]))


MOTIONS = {'side': rigid((0.2, 0, 0)), 'oblique': rigid((0.15, 0, 0.15)),
           'turn': turned(10.0, 0.5), 'back and turn': rigid((-0.2, 0, -0.1)) @ turned(10.0)}


@pytest.fixture
def seen_points():
    """Return points 1.5 to 5 m in front of a camera, and their bearings."""
    rng = np.random.default_rng(1)
    bearings = rng.uniform((-0.6, -0.45), (0.6, 0.45), (300, 2))
    pose = make_transform(Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix(),
                          np.array([3.0, 1.0, 2.0]))
    depths = rng.uniform(1.5, 5.0, (300, 1))
    return pose, depths * np.column_stack([bearings, np.ones(300)]) @ pose[:3, :3].T + pose[:3, 3]


def seen_from(points, pose):
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    return inside[:, :2] / inside[:, 2:]


def on_picture(bearings, first_from_second, away_m):
    """Return bearings after a motion by the homography of a plane that faced the first camera."""
    back = invert_transform(first_from_second)
    plane = back[:3, :3] + np.outer(back[:3, 3], [0.0, 0.0, 1.0]) / away_m
    moved = np.column_stack([bearings, np.ones(len(bearings))]) @ plane.T
    return moved[:, :2] / moved[:, 2:]


def look(points, bearings, rng, keyframe=0, wrong=None):
    """Return the place where such an image is recognized, in keyframes with a wrong pose."""
    noise = rng.normal(0.0, 0.5 / 525.0, bearings.shape)
    found = find_pose(points, bearings + noise)
    pose = found.map_from_camera if wrong is None else wrong @ found.map_from_camera
    return RecognizedPlace(
        pose, 20.0 * found.covariance + SHARED, SHARED, len(found.inliers), 0.8,
        keyframes=(keyframe,), shares=(1.0,), points=points[found.inliers])


@pytest.mark.parametrize('name', MOTIONS)
def test_a_room_moves_as_odometry_says_and_a_picture_does_not(seen_points, name):
    pose, points = seen_points
    motion, rng = MOTIONS[name], np.random.default_rng(2)
    bearings, squares = seen_from(points, pose), []
    for _ in range(8):
        deviations = odometry_deviations(motion) * rng.normal(size=6)
        odometry = motion @ make_transform(Rotation.from_rotvec(deviations[3:]).as_matrix(),
                                           deviations[:3])
        first = look(points, bearings, rng)
        second = look(points, seen_from(points, pose @ motion), rng)
        found = compare_motion(FROM_DEPTH, first, second, odometry)
        squares.append(found.square)
        assert found.picture > SURE
        for away_m in (1.0, 2.0, 3.0):
            second = look(points, on_picture(bearings, motion, away_m), rng)
            assert compare_motion(FROM_DEPTH, first, second, odometry).square > SURE
    assert max(squares) < SURE
    assert np.mean(squares) < 8.0


@pytest.mark.parametrize('motion', [np.eye(4), turned(10.0), rigid((0.01, 0, 0))],
                         ids=['none', 'about the camera itself', '1 cm'])
def test_where_a_picture_moves_like_the_room_nothing_is_claimed(seen_points, motion):
    pose, points = seen_points
    rng = np.random.default_rng(3)
    bearings = seen_from(points, pose)
    first = look(points, bearings, rng)
    for second in (seen_from(points, pose @ motion), on_picture(bearings, motion, 2.0)):
        found = compare_motion(FROM_DEPTH, first, look(points, second, rng), motion)
        assert found.picture < chi2.isf(0.05, 6) and found.square < SURE


def test_a_picture_that_the_camera_passes_is_not_seen_again(seen_points):
    pose, points = seen_points
    rng, motion = np.random.default_rng(5), rigid((0, 0, 5.0))
    first = look(points, seen_from(points, pose), rng)
    found = compare_motion(FROM_DEPTH, first, first._replace(map_from_camera=pose @ motion),
                           motion)
    assert found.picture == np.inf and found.square < SURE


def test_what_looks_at_the_same_keyframes_share_does_not_count(seen_points):
    """A wrong keyframe pose moves both poses alike; errors of two keyframes differ."""
    pose, points = seen_points
    rng, motion = np.random.default_rng(4), rigid((0.2, 0, 0))
    wrong = rigid((0.04, 0.0, 0.0), degrees=1.2)
    bearings, moved = seen_from(points, pose), seen_from(points, pose @ motion)
    first = look(points, bearings, rng)
    same, other = (compare_motion(FROM_DEPTH, first,
                                  look(points, moved, rng, keyframe, wrong), motion)
                   for keyframe in (0, 1))
    assert other.square < SURE < same.square and other.picture < 0.7 * same.picture
    first = look(points, bearings, rng, wrong=wrong)
    both = compare_motion(FROM_DEPTH, first, look(points, moved, rng, wrong=wrong), motion)
    assert both.square < SURE
