# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch: faults of images, and poses in a room of forty objects."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scene import BY_CLASS, boxes_of, level, map_of, rigid, with_boxes
from scipy.spatial.transform import Rotation
from test_scan import ROOM as GRID
from test_scan import scan_of

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.map.presence import Missing
from cliploc_ros.core.map.visibility import Expected, expect
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.camera import ImageFaults
from cliploc_ros.core.watch.look import LookEvidence, align, by_vertical, look_at, measure
from cliploc_ros.core.watch.watch import Belief, Watch, WatchState
from cliploc_ros.errors import OptionsError
from cliploc_ros.units import NS_PER_S


def poses(count, step_m=0.2):
    return [rigid((step_m * number, 0.0, 0.0)) for number in range(count)]


@pytest.fixture
def images():
    """Return six different images of boxes and lines."""
    rng, found = np.random.default_rng(0), []
    for _ in range(6):
        image = np.full((240, 320, 3), 120, dtype=np.uint8)
        for corner, size, color in zip(rng.integers(0, 300, (60, 2)), rng.integers(5, 60, (60, 2)),
                                       rng.integers(0, 255, (60, 3)), strict=True):
            cv2.rectangle(image, corner.tolist(), (corner + size).tolist(), color.tolist(), -1)
        found.append(image)
    return found


def faults_of(images, where):
    faults = ImageFaults()
    return [faults.add(image, pose) for image, pose in zip(images, where, strict=True)]


@pytest.mark.parametrize(('change', 'word', 'looks'), [
    (lambda one: one // 20, 'dark', 3),
    (lambda one: np.full_like(one, 90), 'covered', 3),
    (lambda one: cv2.GaussianBlur(one, (0, 0), 6.0), 'blurred', 5)])
def test_a_fault_that_lasts_is_named(images, change, word, looks):
    found = faults_of([images[0], *map(change, images)], poses(7))
    assert found[:looks] == [''] * looks
    assert word in found[looks]
    # one good image ends it
    assert faults_of([*map(change, images), images[0]], poses(7))[-1] == ''


def test_a_frozen_image_or_a_smooth_wall_is_a_fault_only_for_a_robot_that_moves(images):
    assert 'frozen' in faults_of([images[0]] * 6, poses(6))[-1]
    assert faults_of([images[0]] * 6, poses(6, step_m=0.0)) == [''] * 6
    for shape in ((1, 1, 3), (480, 3, 3)):  # an image of any shape
        assert len(faults_of([np.zeros(shape, dtype=np.uint8)] * 4, poses(4))) == 4
    smooth = [cv2.GaussianBlur(images[0], (0, 0), 6.0) + np.uint8(row) for row in range(6)]
    assert faults_of(smooth, poses(6, step_m=0.0)) == [''] * 6


CAMERA = Camera(640, 480, 400.0, 400.0, 320.0, 240.0)
SIDE_M, COUNT = 6.0, 40
TERMS = CALIBRATION.watch


@pytest.mark.parametrize(('changed', 'sign'), [
    ({'utility': 6.0}, 1), ({'unexplained': 2}, -1), ({'missed': 2}, -1), ({'away_m': 0.6}, -1),
    ({'away_deg': 16.0}, -1), ({'crowd': 3.0}, 1)])
def test_each_sign_of_a_look_counts_for_or_against_the_pose(changed, sign):
    look = LookEvidence(known=4, matched=2, unexplained=0, utility=1.0, expected=4, missed=0,
                        away_m=0.0, away_deg=0.0, crowd=0.0)
    assert sign * (look._replace(**changed).log_odds(True) - look.log_odds(True)) > 0.3


@pytest.fixture(scope='module')
def room():
    """Return forty objects of eight classes along the walls of a room of 6 m x 6 m."""
    rng = np.random.default_rng(4)
    along, wall = rng.uniform(0.3, SIDE_M - 0.3, COUNT), np.arange(COUNT) % 4
    x = np.choose(wall, [along, along, 0.0 * along, 0.0 * along + SIDE_M])
    y = np.choose(wall, [0.0 * along, 0.0 * along + SIDE_M, along, along])
    return map_of(['abcdefgh'[row] for row in rng.integers(8, size=COUNT)],
                  np.c_[x, y, rng.uniform(0.3, 1.8, COUNT)], rng.uniform(0.1, 0.25, (COUNT, 3)))


def drive(count):
    """Return poses on a circle about the middle that look outwards, 20 degrees apart."""
    angles = np.radians(20.0 * np.arange(count))
    return [level(3.0 + np.cos(angle), 3.0 + np.sin(angle), np.degrees(angle) + 15.0)
            for angle in angles]


def see(landmark_map, pose, number=0, odom=True, rng=None, rows=None):
    """Return the observation of some landmarks at a true pose."""
    boxes = boxes_of(landmark_map, pose, CAMERA)
    shown = np.clip(boxes, 0.0, [CAMERA.width, CAMERA.height] * 2)
    with np.errstate(invalid='ignore'):
        in_view = ((shown[:, 2:] - shown[:, :2]).prod(axis=1)
                   > 0.6 * (boxes[:, 2:] - boxes[:, :2]).prod(axis=1))
    found = np.nonzero(in_view)[0]
    found = found if rows is None else np.intersect1d(found, np.array(rows, dtype=int))
    noise = 0.0 if rng is None else rng.normal(size=(len(found), 4))
    return Observation(CAMERA, Detections(
        shown[found] + noise, tuple(landmark_map.class_ids[row] for row in found),
        np.full(len(found), 0.9)), stamp_ns=2 * number * NS_PER_S,
        odom_from_camera=pose if odom else None)


def moved(pose, x, y, yaw_deg=0.0):
    return make_transform(rigid(degrees=yaw_deg)[:3, :3] @ pose[:3, :3], pose[:3, 3] + [x, y, 0.0])


@pytest.fixture
def watch(room):
    return Watch(Relocalizer(room, BY_CLASS))


def follow(watch, room, poses, wrong=None, first=0, **seen):
    """Look from true poses, with the localizer's error wrong_from_right; return the reports."""
    wrong = np.eye(4) if wrong is None else wrong
    return [watch.look(see(room, pose, first + number, **seen), wrong @ pose)
            for number, pose in enumerate(poses)]


def test_a_localizer_that_drifts_is_right(watch, room):
    rng = np.random.default_rng(0)
    for number, pose in enumerate(drive(30)):
        x, y = rng.uniform(-0.2, 0.2, 2)
        report = watch.look(see(room, pose, number, rng=rng), moved(pose, x, y, rng.normal()))
        assert report.state != WatchState.LOST and report.matched >= report.expected
    assert report.state == WatchState.LOCALIZED and report.probability > 0.99
    assert report.matched and not report.missing
    assert report.camera_turn is None


@pytest.mark.parametrize('wrong', [moved(np.eye(4), 2.0, 0.0), moved(np.eye(4), 0.0, 0.0, 60.0),
                                   moved(np.eye(4), 5.0, 6.0, 180.0)])
def test_a_pose_that_jumps_away_is_lost_within_five_looks(watch, room, wrong):
    poses = drive(15)
    assert follow(watch, room, poses[:10])[-1].state == WatchState.LOCALIZED
    after = follow(watch, room, poses[10:], wrong, first=10)
    assert after[0].state != WatchState.LOST  # a single look does not decide
    assert after[-1].state == WatchState.LOST
    assert 'relocalize' in after[-1].reason
    assert len(after[-1].reason) < 120


def test_a_robot_that_is_carried_away_is_noticed(watch, room):
    """Neither odometry nor the localizer registers the kidnap."""
    poses = drive(20)
    follow(watch, room, poses[:10])
    for number, (there, here) in enumerate(zip(drive(30)[20:], poses[10:], strict=True), 10):
        seen = replace(see(room, moved(there, -0.7, 1.2, 80.0), number), odom_from_camera=here)
        report = watch.look(seen, here)
    assert report.state == WatchState.LOST and report.probability < 0.05


def test_where_the_scan_contradicts_the_pose_the_watch_is_uncertain(watch, room):
    mirrored = replace(GRID, cells=np.ascontiguousarray(GRID.cells[:, ::-1]))
    for number, pose in enumerate(drive(5)):
        seen = replace(see(room, pose, number), scan=scan_of(GRID, pose))
        report = watch.look(seen, pose, grid=mirrored if number == 4 else GRID)
        assert ', scan ' in report.reason
        assert number != 3 or report.state is WatchState.LOCALIZED
    assert report.state is WatchState.UNCERTAIN and 'turn' in report.reason


def test_minutes_without_objects_end_in_uncertain(watch, room):
    follow(watch, room, drive(10))
    reports = follow(watch, room, drive(18) * 20, first=10, rows=[])
    assert {report.state for report in reports} == {WatchState.LOCALIZED, WatchState.UNCERTAIN}
    assert reports[-1].state == WatchState.UNCERTAIN
    assert 0.5 <= reports[-1].probability < 0.9


def test_a_place_that_the_map_does_not_show_is_uncertain(watch, room):
    """The robot drives through a door to other objects of the same classes."""
    follow(watch, room, drive(10))
    annex = replace(room, centers=room.centers + np.array([30.0, 0.0, 0.0]))
    way = [level(30.0 + one[0, 3], one[1, 3], 20.0 * row) for row, one in enumerate(drive(40))]
    near = [moved(way[0], x, 0.0) for x in np.linspace(-27.0, 0.0, 30)]
    follow(watch, room, near, first=10, rows=[])
    states = {watch.look(see(annex, pose, 40 + number), pose).state
              for number, pose in enumerate(way)}
    assert WatchState.LOST not in states and WatchState.UNCERTAIN in states


NOTHING = Detections(np.empty((0, 4)), (), np.empty(0))


def test_a_standing_robot_learns_little_from_more_of_the_same():
    belief = Belief()
    for number in range(50):
        seen = Observation(CAMERA, NOTHING, stamp_ns=2 * number * NS_PER_S,
                           odom_from_camera=np.eye(4))
        belief.wait(seen, np.eye(4))
        belief.add(seen, -1.0, is_full=True)
    assert 0.05 < belief.probability < 0.5


def test_a_long_way_makes_a_sure_watch_unsure():
    belief, seen = Belief(), Observation(CAMERA, NOTHING, odom_from_camera=np.eye(4))
    belief.wait(seen, np.eye(4))
    belief.add(seen, 3.0, is_full=True)
    before, after = belief.probability, moved(np.eye(4), 100.0, 0.0)
    belief.wait(replace(seen, odom_from_camera=after), after)
    assert 0.5 < belief.probability < before - 0.02 and not belief.has_jumped


@pytest.mark.parametrize('change', [(2.0, 0.0, 0.0), (0.0, 0.0, 60.0)])
def test_a_jump_in_place_or_in_heading_alone_speaks_against_the_new_pose(change):
    belief, seen = Belief(), Observation(CAMERA, NOTHING, odom_from_camera=np.eye(4))
    belief.wait(seen, np.eye(4))
    belief.add(seen, 3.0, is_full=True)
    belief.wait(seen, moved(np.eye(4), *change))
    assert belief.has_jumped and belief.probability < 0.5


@pytest.mark.parametrize(('odom', 'seconds', 'odds', 'apart'), [
    (np.eye(4), 9, 3.0, 0.0), (np.eye(4), 9, -3.0, 6.0 / TERMS.most),
    (None, 5, 3.0, 5.0 / TERMS.correlated_s)])
def test_looks_share_errors_unless_they_differ(odom, seconds, odds, apart):
    """In what they say, or, without odometry, in their time: the robot may have been carried."""
    belief, seen = Belief(), Observation(CAMERA, NOTHING, odom_from_camera=odom)
    belief.add(seen, 3.0, is_full=True)
    weight = belief.add(replace(seen, stamp_ns=seconds * NS_PER_S), odds, is_full=True)
    assert weight == pytest.approx(1.0 - TERMS.correlated * np.exp(-apart))


def test_a_wrong_pose_is_noticed_without_odometry(watch, room):
    reports = follow(watch, room, drive(12), moved(np.eye(4), 2.0, 0.5), odom=False)
    assert reports[-1].probability < 0.05


def test_missing_landmarks_are_named(watch, room):
    gone = [2, 9, 17, 25]
    there = np.setdiff1d(np.arange(COUNT), gone)
    reports = follow(watch, room, drive(90), rows=there, rng=np.random.default_rng(1))
    assert WatchState.LOST not in {report.state for report in reports}
    assert not reports[3].missing  # one look names no landmark
    expected = {row for pose in drive(18)
                for row in expect(room, CAMERA, pose, np.arange(COUNT)).landmarks}
    named = {room.landmark_ids.index(landmark) for landmark in reports[-1].missing}
    assert named and named <= set(gone)
    assert named >= set(gone) & expected - {25} or len(named) >= 2


def test_where_a_third_is_gone_the_map_is_out_of_date(watch, room):
    there = np.nonzero(np.arange(COUNT) % 3)[0]
    report = follow(watch, room, drive(36), rows=there)[-1]
    assert report.state == WatchState.UNCERTAIN and report.probability > TERMS.localized
    assert f'{len(report.missing)} landmarks' in report.reason


@pytest.mark.parametrize('rotvec', [(3.0, 0.0, 0.0), (0.0, -6.0, 0.0), (0.0, 0.0, 8.0),
                                    (-2.0, 0.0, 0.0)])
def test_the_turn_of_a_camera_is_known_after_twenty_looks(watch, room, rotvec):
    turn = make_transform(Rotation.from_rotvec(rotvec, degrees=True).as_matrix(), np.zeros(3))
    rng = np.random.default_rng(2)
    for number, pose in enumerate(drive(20)):
        given = pose @ invert_transform(turn)
        report = watch.look(see(room, pose, number, rng=rng),
                            moved(given, *rng.uniform(-0.05, 0.05, 2)))
    assert report.state == WatchState.LOCALIZED
    found = report.camera_turn
    assert np.linalg.norm(found.rotvec_deg - rotvec) < 0.5
    assert found.sigma_deg < 1.5
    # the camera is level: its y axis is the vertical
    assert found.is_yaw == (rotvec[1] != 0.0) == ('yaw of the localizer' in found.in_words())


def test_invalid_inputs_are_named(watch, room):
    pose = drive(1)[0]
    for wrong in (np.full((4, 4), np.nan), np.eye(3), 2.0 * np.eye(4)):
        with pytest.raises(OptionsError, match='map_from_camera'):
            watch.look(see(room, pose), wrong)
    with pytest.raises(OptionsError, match='odom_from_camera'):
        watch.look(replace(see(room, pose), odom_from_camera=np.full((4, 4), np.nan)), pose)
    with pytest.raises(OptionsError, match='is not a unit vector'):
        watch.look(replace(see(room, pose), up_in_camera=np.full(3, np.nan)), pose)
    with pytest.raises(OptionsError, match='has no pixels'):
        watch.look(see(room, pose), pose, np.zeros((0, 0, 3), np.uint8))
    assert watch.look(see(room, pose), pose).looks == 1


def test_a_pose_against_the_vertical_is_less_likely():
    straight = level()
    tilted = straight @ rigid(axis='x', degrees=15.0)
    up = np.array([0.0, -1.0, 0.0])
    assert by_vertical(straight, None, 1.0) == by_vertical(straight, up, 1.0) == 0.0
    assert by_vertical(tilted, up, 1.0) < -3.0
    upside_down = -up * (1.0 + 1e-12)  # by rounding
    assert by_vertical(straight, upside_down, 1.0) == -CALIBRATION.attitude.wrong_mount


def things(*centers):
    return map_of('a' * len(centers), centers)


def test_what_an_image_should_show():
    """The camera is at the origin, 1 m high, and looks along x."""
    some = things((3, 0, 1),  # in view
                  (5, 0, 1),  # behind it
                  (-3, 0, 1),  # behind the camera
                  (3, 2.35, 1),  # cut by the border
                  (30, 1, 1),  # too far
                  (3, -1, 1))  # in view
    found = expect(some, CAMERA, level(0, 0, 0), np.array([5]))
    assert found.landmarks.tolist() == [0, 5] and found.was_seen.tolist() == [False, True]
    assert found.in_sight.tolist() == [True, True]
    # no visible landmark is beside it, so a wall may hide it
    assert not expect(some, CAMERA, level(0, 0, 0), np.empty(0, dtype=int)).in_sight.any()


@pytest.mark.parametrize(('yaw_deg', 'side'), [(0, 4), (44, 4), (46, 5), (181, 0), (-1, 3)])
def test_the_side_of_a_landmark_is_that_from_which_the_camera_looks(yaw_deg, side):
    ahead = [2 * np.cos(np.radians(yaw_deg)), 2 * np.sin(np.radians(yaw_deg)), 1]
    found = expect(things(ahead), CAMERA, level(0, 0, yaw_deg), np.array([0]))
    assert found.sides.tolist() == [side]


@pytest.mark.parametrize(('side', 'is_missing'), [(2, True), (3, True), (1, True), (4, False),
                                                  (6, False)])
def test_a_landmark_is_missed_only_from_where_it_was_seen(side, is_missing):
    """A television cannot be detected from behind."""
    missing, yes = Missing(things((3, 0, 1))), np.array([True])
    for _ in range(10):
        missing.add(Expected(np.array([0]), yes, yes, np.array([2])), 1.0)
    for _ in range(20):
        missing.add(Expected(np.array([0]), ~yes, yes, np.array([side])), 1.0)
    assert missing.named() == [0] * is_missing


@pytest.mark.parametrize('seen', [0, 1, 20])
def test_what_is_gone_stays_missing(seen):
    """Years of looks that miss it neither bring it back nor cause an overflow."""
    missing, yes = Missing(things((3, 0, 1))), np.array([True])
    for was_seen in [yes] * seen + [~yes] * 20_000:
        missing.add(Expected(np.array([0]), was_seen, yes, np.array([2])), 1.0)
    assert missing.named() == [0]


@pytest.mark.parametrize(('seen_every', 'misses', 'is_missing'), [(1, 3, True), (3, 6, False)])
def test_what_a_detector_finds_now_and_then_is_not_missing_at_once(seen_every, misses, is_missing):
    """The detector finds the others in each look, or in every third."""
    missing = Missing(things(*[(3, 0, 1)] * 9))

    def look(landmarks, was_seen):
        many = np.full(len(landmarks), True)
        missing.add(Expected(landmarks, was_seen == many, many, 0 * landmarks), 1.0)
    for number in range(12):
        look(np.arange(1, 9), number % seen_every == 0)
    look(np.arange(9), True)
    for _ in range(misses):
        look(np.array([0]), False)
    assert missing.named() == [0] * is_missing


def test_a_look_counts_what_it_explains_and_what_it_does_not(room):
    options, pose = BY_CLASS, drive(1)[0]
    seen = see(room, pose)
    count, others = len(seen.detections), np.array([[300.0, 5, 310, 15], [400, 5, 410, 15]])
    for known, class_ids in ((2, ('a', 'b')), (1, ('a', 'unknown')), (0, ('other', 'unknown'))):
        more = with_boxes(seen.detections, others, class_ids)
        evidence, expected = measure(align(look_at(room, replace(seen, detections=more), options),
                                           pose))
        assert (evidence.known, evidence.matched, evidence.unexplained) == (
            count + known, count, known)
        assert evidence.expected == len(expected.landmarks) >= 3
        assert evidence.missed == int((~expected.was_seen).sum())
        assert evidence.away_m < 0.01 and evidence.away_deg < 0.2


def test_a_pose_that_is_off_is_aligned_with_what_is_seen(room):
    options, pose = BY_CLASS, drive(1)[0]
    away = measure(align(look_at(room, see(room, pose), options), moved(pose, 0.2, 0.1)))[0]
    assert away.away_m == pytest.approx(np.hypot(0.2, 0.1), abs=0.06)
    pose = drive(5)[4]
    near, far = (align(look_at(room, see(room, pose), options), moved(pose, 0.0, 0.0, degrees))
                 for degrees in (19.0, 21.0))
    assert near.away_deg == pytest.approx(19.0, abs=0.2)
    assert far.away_deg < 20.0, 'no localizer is that far off'
