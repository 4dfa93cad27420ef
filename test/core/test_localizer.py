# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Successive frames of one camera: which frames are fused, and which looks must agree."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scene import BY_CLASS, CAMERA, MAP_FROM_CAMERA, ROOM, SEEN, observe, rigid, with_others

from cliploc_ros.core.acceptance.confidence import Setting, none_right
from cliploc_ros.core.acceptance.contenders import join_frames
from cliploc_ros.core.acceptance.depth_check import DepthCheck
from cliploc_ros.core.acceptance.links import weakest_link
from cliploc_ros.core.acceptance.looks import Look, Looks
from cliploc_ros.core.acceptance.verdict import Evidence
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.features import SIFT
from cliploc_ros.core.keyframes.localization import LEAST_S
from cliploc_ros.core.keyframes.places import Recognition, RecognizedPlace
from cliploc_ros.core.localizer import KeptInstant, Localizer, instants_to_fuse
from cliploc_ros.core.map.culling import FEW
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.trials import make_queries, with_neighbours
from studies.acceptance.troubles import flickering

ONE = SEEN.select(np.array([0]))
NOTHING = SEEN.select(np.array([], dtype=np.int64))
RELOCALIZER = Relocalizer(ROOM, BY_CLASS)
ODOM_FROM_MAP = rigid((30.0, -4.0, 1.0), degrees=70.0)


def pose(degrees=0.0, metres=0.0):
    return rigid((metres, 0.0, 0.0), degrees=degrees)


def frame(seconds, degrees=0.0, metres=0.0, detections=SEEN):
    return Observation(CAMERA, detections, stamp_ns=round(seconds * 1e9),
                       odom_from_camera=pose(degrees, metres))


class Window:
    """The fused frames, and their stamps [s]."""

    def __init__(self):
        self.frames = []

    def join(self, seconds, degrees=0.0, metres=0.0, detections=ONE, limit=5, length_s=5.0):
        new = frame(seconds, degrees, metres, detections)
        earlier, anchor = instants_to_fuse(self.frames, new, limit, length_s)
        self.frames = [*earlier, KeptInstant((RELOCALIZER.search(new),), anchor)]
        return [frame.stamp_ns / 1e9 for frame in self.frames]


@pytest.mark.parametrize(('steps', 'expected'), [
    ([(number / 10, 0.1 * number) for number in range(20)], [1.9]),  # a camera that stands
    ([(number, 4.0 * number) for number in range(3)], [0.0, 1.0, 2.0]),
    ([(number, 0.0, 0.06 * number) for number in range(3)], [0.0, 1.0, 2.0]),
    # a camera that creeps: each is at the least distance of a new frame from the one before
    ([(number / 10, 0.4 * number) for number in range(31)], [0.7, 1.5, 2.3, 3.0]),
    ([*((number, 10.0 * number) for number in range(4)), (7.5, 90.0)], [3.0, 7.5]),
    ([(0.0, 0.0), (1.0, 10.0, 0.0, NOTHING), (2.0, 20.0)], [0.0, 2.0])])
def test_frames_of_new_views_are_fused_while_they_are_new_and_show_something(steps, expected):
    window = Window()
    for step in steps:
        fused = window.join(*step)
    assert fused == expected


def test_of_too_many_frames_those_furthest_apart_remain():
    window = Window()
    for number in range(31):
        fused = window.join(number / 10, degrees=6.0 * number)
        assert len(fused) <= 5
    assert fused[0] == 0.0 and fused[-1] == 3.0
    assert np.diff(fused).max() <= 1.6, 'the fused frames cover the whole path'


@pytest.fixture
def session():
    RELOCALIZER.warm_up()
    return Localizer(RELOCALIZER)


def turning(seconds, degrees):
    """Return what a camera sees that turns as odometry says."""
    return replace(see(ROOM, moved(MAP_FROM_CAMERA, 0.0, degrees)), stamp_ns=round(seconds * 1e9))


def ask(session, observation, run=0):
    """Answer with up to five fused frames."""
    return session.answer(Query((observation,), run=run, limit=5, length_s=5.0))


@pytest.mark.parametrize(('seconds', 'run'), [(103.0, 2), (3.0, 1)])
def test_another_run_of_odometry_or_time_that_goes_back_forgets_all_frames(session, seconds, run):
    assert [ask(session, turning(100 + number, 4.0 * number), 1).frames
            for number in range(3)] == [1, 2, 3]
    assert ask(session, turning(seconds, 12.0), run).frames == 1
    assert ask(session, turning(seconds + 0.5, 16.0), run).frames == 2


def test_a_frame_without_odometry_is_localized_alone(session):
    for number in range(3):
        ask(session, turning(number, 4.0 * number))
    assert ask(session, replace(turning(3.0, 0.0), odom_from_camera=None)).frames == 1
    assert ask(session, turning(4.0, 12.0)).frames == 4, 'the session is unchanged'


def drive(session, seconds, metres, run=0, objects=12):
    """Localize with a constant view, although odometry reports motion."""
    seen = SEEN.select(np.arange(objects))
    return session.answer(Query((frame(seconds, metres=metres, detections=seen),), run=run,
                                length_s=5.0))


def test_an_accepted_pose_ends_the_looks(session):
    """Odometry drifts between requests, so an older accepted pose contradicts nothing."""
    for number in range(35):
        found = drive(session, 60.0 * number, 1.0 * number)
        assert found.accepted, f'request {number}: {found.reason}'
        assert pose_error(found.map_from_camera, MAP_FROM_CAMERA)[0] < 0.01


def test_looks_that_led_to_no_accepted_pose_persist_while_odometry_links_them(session):
    """Frames are dropped after five seconds, but looks are kept."""
    for number in range(4):
        drive(session, number, 3.0 * number, objects=3)
    assert not drive(session, 1000.0, 12.0).accepted
    assert drive(session, 2000.0, 12.0, run=1).accepted, 'another run'
    for number in range(4):
        drive(session, 2001.0 + number, 3.0 * number, run=1, objects=3)
    assert not drive(session, 2010.0, 15.0, run=1).accepted
    assert drive(session, 1999.0, 9.0, run=1).accepted, 'time went back'


class Camera:
    """A camera whose looks need no search."""

    def __init__(self):
        self.looks = Looks()

    def look(self, seconds, x_m, yaw_deg=0.0, degrees=0.0, metres=0.0, confidence=1.0, way_m=0.0):
        """Return the mean confidence of all looks in a pose at x_m, yaw_deg."""
        observation = replace(frame(seconds, degrees, metres), odom_way_m=way_m)
        earlier = self.looks.earlier(observation, pose(yaw_deg, x_m))
        self.looks = self.looks.with_look(Look(observation, pose(yaw_deg, x_m), confidence))
        return Evidence(3, confidence, earlier=earlier).mean_confidence


@pytest.fixture
def camera():
    return Camera()


@pytest.mark.parametrize(('turned_deg', 'driven_m'), [(0.0, 0.0), (10.0, 0.0), (10.0, 0.8)])
def test_odometry_carries_the_looks(camera, turned_deg, driven_m):
    for number in range(10):
        degrees, metres = number % 2 * turned_deg, number * driven_m
        assert camera.look(number / 10, metres, degrees, degrees, metres) == 1.0
    stuck = [camera.look(1.0 + number / 10, 0.0, 0.0, 4.0 * number, 8.0 + number)
             for number in range(1, 10)]
    assert max(stuck) < 0.5, 'constant poses of a moving robot'


@pytest.mark.parametrize(('way_m', 'agrees'), [(0.0, False), (10.0, False), (33.0, True)])
@pytest.mark.parametrize('off', [(1.0, 0.0), (0.0, 100.0)])
def test_the_further_a_robot_drove_the_less_exactly_looks_have_to_agree(camera, off, way_m,
                                                                        agrees):
    """After 33 m, odometry with 3 % drift is off by 1 m; the robot is back at its start."""
    camera.look(0.0, 0.0)
    assert (camera.look(60.0, *off, way_m=way_m) == 1.0) == agrees


def test_a_blocked_view_is_forgotten_after_twenty_looks(camera):
    for number in range(100):
        camera.look(number / 10, 9.0)
    means = [camera.look(10.0 + number / 10, 1.0) for number in range(15)]
    assert means[0] == pytest.approx(1 / 20)
    assert [mean >= 0.5 for mean in means] == [False] * 9 + [True] * 6


def test_a_filter_learns_little_from_a_standing_camera_until_a_new_run():
    session = Localizer(RELOCALIZER)
    deviations = []
    for seconds, run in ((0, 0), (1, 0), (2, 1), (1.5, 1)):
        found = ask(session, frame(seconds), run)
        assert found.accepted
        given = session.follow(found)
        deviations.append(np.sqrt(np.diag(given) / np.diag(found.covariance)).min())
    assert deviations[0] == deviations[2] == deviations[3] == 1.0, 'a new run, time went back'
    assert deviations[1] > 1.4
    alone = session.answer(Query((replace(frame(3), odom_from_camera=None),)))
    np.testing.assert_array_equal(session.follow(alone), alone.covariance)


class Says:
    """Keyframes with a known answer to each image."""

    def __init__(self, place):
        self._place = place
        self.layer = SimpleNamespace(map_from_camera=np.empty((0, 4, 4)), kind=SIFT,
                                     deviations=lambda rows: np.full(len(rows), 0.01))

    def localize_features(self, *_):
        return Recognition((self._place,))

    def coverage(self, map_from_camera, camera):
        return 1.0


def test_a_filter_gets_the_covariance_of_the_pose_that_keyframes_gave():
    fine = np.diag([1e-4] * 3 + [1e-5] * 3)
    session = Localizer(RELOCALIZER, Says(RecognizedPlace(
        MAP_FROM_CAMERA, fine, 0.5 * fine, 200, 0.9,
        pixels=np.array([[0.0, 0.0], [640.0, 480.0]]))))
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)

    def localize(seconds, run=0, detections=SEEN, by_keyframes=True, deadline=np.inf):
        found = session.answer(Query((frame(seconds, detections=detections),), (image,), run, 5,
                                     5.0, by_keyframes), deadline=deadline)
        assert found.accepted
        return found

    first = localize(0)
    assert first.source == 'both'
    np.testing.assert_array_equal(session.follow(first), fine)
    rough = localize(2, by_keyframes=False).covariance
    assert (np.diag(fine) < np.diag(rough)).all(), 'objects tell less'
    alone = localize(3, 1, NOTHING)
    assert alone.source == 'keyframes'
    np.testing.assert_array_equal(session.follow(alone), fine)
    assert localize(4, by_keyframes=False).source == 'objects'
    soon = time.monotonic() + LEAST_S
    assert localize(5, deadline=soon).source == 'objects', 'no time remains for keyframes'
    assert not session.query.by_keyframes


def see(room, map_from_camera, rows=None):
    """Return an observation of some landmarks, with error-free odometry."""
    return observe(room, map_from_camera, rows, odom_from_camera=ODOM_FROM_MAP @ map_from_camera)


def moved(map_from_camera, metres, degrees):
    """Return the pose of a camera that moved on and turned about its vertical axis."""
    return map_from_camera @ rigid((metres, 0.0, 0.5 * metres), 'y', degrees)


@pytest.fixture
def walk():
    return [moved(MAP_FROM_CAMERA, 0.05 * step, 2.0 * step) for step in range(4)]


@pytest.mark.parametrize('landmarks', [len(ROOM), FEW + 20])
def test_objects_seen_one_after_the_other_are_as_good_as_at_once(landmarks, walk):
    """No single frame shows three distinguishable objects. A large map is culled."""
    room, shares = with_others(ROOM, landmarks), [[0, 4, 8], [3, 7], [2, 11, 9], [1, 5]]
    frames = [see(room, pose, rows) for pose, rows in zip(walk, shares, strict=True)]
    relocalizer = Relocalizer(room, BY_CLASS)
    assert not any(relocalizer.relocalize([frame]).accepted for frame in frames)
    found = relocalizer.relocalize(frames)
    assert found.accepted, found.reason
    error_m, error_deg = pose_error(found.map_from_camera, walk[-1])
    assert error_m < 0.01 and error_deg < 0.2
    # from the last frame only
    assert [match.detection for match in found.matches] == [0, 1]
    assert [match.landmark for match in found.matches] == shares[-1]
    # with a known vertical, two objects suffice to check their camera
    upright = relocalizer.relocalize([replace(frame, up_in_camera=pose[2, :3])
                                      for frame, pose in zip(frames, walk, strict=True)])
    assert (len(found.cameras), len(upright.cameras)) == (2, 4)


def test_the_odometry_of_a_camera_that_looks_into_a_mirror_is_mirrored(room):
    """From behind, objects on a wall look mirrored, however the camera moves."""
    wall = replace(room, centers=room.centers * [1.0, 1.0, 0.0] + [0.0, 0.0, 4.0],
                   semi_axes=np.full((len(room), 3), 0.2))
    walk = [moved(MAP_FROM_CAMERA, 0.2 * step, 4.0 * step) for step in range(4)]
    one, four = (Relocalizer(wall, BY_CLASS).relocalize([see(wall, pose) for pose in poses])
                 for poses in (walk[:1], walk))
    assert one.evidence.not_mirrored < 0.97
    assert four.evidence.not_mirrored == pytest.approx(one.evidence.not_mirrored, abs=1e-3)


@pytest.mark.filterwarnings('error')
def test_last_frames_without_objects_take_no_confidence(room):
    """The test for mirror images uses earlier frames that show objects."""
    walk = [moved(MAP_FROM_CAMERA, 0.05 * step, 2.0 * step) for step in range(6)]
    every, *others = [
        RELOCALIZER.relocalize([see(room, pose, None if step < shown else [])
                                for step, pose in enumerate(walk)]).evidence
        for shown in (6, 4, 2)]
    assert every.confidence > 0.99
    for evidence in others:  # only the link to the newest frame is in doubt
        assert replace(evidence, linked=every.linked).confidence == pytest.approx(
            every.confidence, abs=1e-3)


@pytest.mark.parametrize('refine', [True, False])
def test_the_same_view_again_is_no_more_evidence(refine, room):
    relocalizer = Relocalizer(room, replace(BY_CLASS, refine=refine))
    frame = see(room, MAP_FROM_CAMERA, [0, 1, 2, 4])
    once, often = relocalizer.relocalize([frame]), relocalizer.relocalize([frame] * 5)
    assert often.score == pytest.approx(5 * once.score, rel=0.02)
    assert often.confidence == pytest.approx(once.confidence, rel=0.05)
    assert (np.diag(often.covariance) > 0.9 * np.diag(once.covariance)).all()
    if refine:  # all frames of a camera have its errors
        np.testing.assert_allclose(often.cameras[-1].moves, once.cameras[0].moves, atol=0.1)


@pytest.mark.parametrize('deviation_deg', [0.1, 0.5])
def test_the_verticals_of_several_frames_count_as_one(deviation_deg, room, verified_camera):
    """The verticals come from one sensor on one mount, so their error does not average out."""
    relocalizer = Relocalizer(room, replace(BY_CLASS, vertical_deviation_deg=deviation_deg))
    at_once, one_by_one = [[0, 1, 3, 8, 7]], [[0, 1], [3], [8], [7]]
    tilts = (relocalizer.relocalize([
        replace(see(room, MAP_FROM_CAMERA, rows), up_in_camera=MAP_FROM_CAMERA[2, :3])
        for rows in shares]).covariance[3:5, 3:5] for shares in (at_once, one_by_one))
    one, four = (np.degrees(np.sqrt(np.linalg.eigvalsh(tilt).max())) for tilt in tilts)
    print(f'\ntilt: the same objects in one frame {one:.3f} deg, in four {four:.3f} deg')
    assert 0.95 * deviation_deg < one < 1.05 * deviation_deg, 'the boxes alone give 1.3 degrees'
    # refinement gives four verticals more weight than one, and the boxes less
    assert four == pytest.approx(one, rel=0.06) and four >= 0.95 * one


def test_the_deviations_of_odometry_grow_with_the_way_and_the_turn():
    assert not odometry_deviations(np.eye(4)).any(), 'did not move'
    for degrees, metres in ((10.0, 0.0), (10.0, 0.5)):
        deviations = odometry_deviations(pose(degrees, metres))
        assert deviations[:3] == pytest.approx(0.005 + 0.03 * metres)
        assert deviations[3:] == pytest.approx(np.radians(0.25 + 0.03 * degrees + 0.15 * metres))


def test_bad_odometry_is_named(room, walk):
    first, last = see(room, walk[0]), see(room, walk[1])
    scaled, mirrored = first.odom_from_camera.copy(), first.odom_from_camera.copy()
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1.0
    for odom, named in ((None, 'missing'), (scaled, 'not a rigid'), (mirrored, 'not a rigid')):
        bad = replace(first, odom_from_camera=odom)
        for number, frames in enumerate(([bad, last], [last, bad]), 1):
            with pytest.raises(OptionsError, match=f'frame {number} of 2 is {named}'):
                RELOCALIZER.relocalize(frames)
    for count in (0, MAX_FRAMES + 1):
        with pytest.raises(OptionsError, match=f'^{count} observations'):
            RELOCALIZER.relocalize([first] * count)


@pytest.fixture(scope='module')
def office_frames(office_map, queries):
    """Return pairs of places of the office: frames of the first, and one image of the second."""
    frames = make_queries(queries, office_map, every_frame=True)
    linked = [query for query in with_neighbours(frames, [frame.group for frame in frames])
              if query.is_main]
    return [(linked[row], linked[(row + 11) % len(linked)]) for row in range(0, len(linked), 4)]


@pytest.mark.parametrize('gap_s', [0.5, 4.0])
def test_a_robot_that_is_carried_is_where_its_newest_image_is(gap_s, office_map, office_frames):
    """Odometry does not see it. Before, the earlier frames outvoted the newest one."""
    relocalizer, stayed, carried = Relocalizer(office_map, RelocalizerOptions()), [], []
    for before, after in office_frames:
        session = Localizer(relocalizer)
        for row, observation in enumerate([*before.neighbours[:2], before.observation]):
            found = ask(session, replace(observation, stamp_ns=row * 5 * 10**8))
        stayed.append(found.accepted and found.frames)
        found = ask(session, replace(
            after.observation, stamp_ns=round(1e9 * (1.0 + gap_s)),
            odom_from_camera=moved(before.observation.odom_from_camera, 0.3, 0.0)))
        error_m, _ = pose_error(found.map_from_camera, after.map_from_camera)
        carried.append((found.accepted, error_m < 1.0))
    print(f'\n{len(carried)} carried: {sum(map(all, carried))} accepted, all right')
    assert (True, False) not in carried
    assert sum(map(all, carried)) >= 6
    assert sum(count > 1 for count in stayed) >= 8, 'frames of a robot that drives are fused'


def strangers(frame):
    """Return the frame with three boxes of mapped classes that show no landmark."""
    return replace(frame, detections=replace(frame.detections.select(np.arange(3)), bboxes_xyxy=(
        np.tile([600.0, 0.0, 640.0, 20.0], (3, 1)))))


@pytest.mark.parametrize('shown', ['nothing', 'unmapped'])
def test_earlier_frames_alone_do_not_decide(room, walk, shown):
    """The newest image shows no object, or objects of the map's classes that do not match."""
    frames = [see(room, pose) for pose in walk]
    last = see(room, walk[-1], []) if shown == 'nothing' else strangers(frames[-1])
    assert RELOCALIZER.relocalize(frames).evidence.linked > 0.99
    found = RELOCALIZER.relocalize([*frames[:-1], last])
    assert (found.accepted, found.frames, found.refusal_kind) == (False, 4, 'frames_disagree')


NO_POSE = none_right(Setting(len(ROOM)))


def link_of(room, walk, shown, stamps_s=(0, 1, 2, 3), met=(), seen=None):
    frames = []
    for pose, what, stamp_s in zip(walk, shown, stamps_s, strict=True):
        one = see(room, pose, [] if what == 'n' else None)
        one = strangers(one) if what == 'b' else one
        frames.append(RELOCALIZER.search(replace(one, stamp_ns=round(1e9 * stamp_s))))
    others = [SimpleNamespace(pose=moved(walk[-1], 3.0, 90.0) if met[1] == 'elsewhere'
                              else walk[-1], odds=NO_POSE + met[0])] if met else []
    return weakest_link(join_frames(room, BY_CLASS, frames), walk[-1], seen, lambda _: others)


def test_any_link_may_be_broken_and_keyframes_and_inexact_odometry_hold_it(room, walk):
    last, first = (link_of(room, walk, shown) for shown in ('gggn', 'bggn'))
    assert last.holds < 0.8 and first.kept == 3 and first.holds < first.chance == last.chance
    assert last.kept == 1 and last.holds < last.chance
    old, new = (link_of(room, walk, 'gggg', stamps) for stamps in ((0, 25, 25, 25), (0, 0, 0, 10)))
    assert (old.kept, new.kept) == (3, 1), 'a link that held before breaks less often'
    assert old.holds == pytest.approx(new.holds)
    assert link_of(room, walk, 'gggn', (0, 1, 2, 30)).holds < last.holds, 'time for a carry'
    assert link_of(room, walk, 'bbgg').holds < link_of(room, walk, 'bggg').holds
    none, lost = (np.log(chance / (1.0 - chance)) for chance in (
        link_of(room, walk, shown, (0, 1, 21, 22)).holds for shown in ('nngg', 'bbgg')))
    assert lost - none == pytest.approx(3 * CALIBRATION.objects.unexplained)
    elsewhere, here = (link_of(room, walk, 'gggn', met=(5.0, where)).holds
                       for where in ('elsewhere', 'here'))
    assert elsewhere < last.holds < here
    place = RecognizedPlace(walk[-1], np.eye(6) * 1e-4, np.eye(6) * 1e-4, 200, 0.9)
    assert link_of(room, walk, 'gggn', seen=Recognition((place,))).holds > 0.99
    first, last = see(room, walk[0]), see(room, walk[1])
    last = replace(last, odom_from_camera=last.odom_from_camera @ moved(np.eye(4), 0.2, 0.0))
    joined = join_frames(room, BY_CLASS, [RELOCALIZER.search(frame) for frame in (first, last)])
    assert weakest_link(joined, walk[1], None, lambda _: ()).holds > 0.99


def test_frames_before_a_carry_are_dropped(room, walk):
    """Two frames of the old place, two of the new one."""
    there = moved(MAP_FROM_CAMERA, 1.5, 25.0)
    frames = [replace(see(room, pose), stamp_ns=row * 10**9) for row, pose in enumerate(walk)]
    for row in (2, 3):
        seen = see(room, there @ np.linalg.inv(walk[2]) @ walk[row])
        frames[row] = replace(seen, stamp_ns=row * 10**9,
                              odom_from_camera=frames[row].odom_from_camera)
    found = Relocalizer(room, BY_CLASS).relocalize(frames)
    assert found.accepted and found.frames == len(found.frame_matches) <= 2
    assert pose_error(found.map_from_camera, there @ np.linalg.inv(walk[2]) @ walk[3])[0] < 0.05
    session = Localizer(RELOCALIZER)
    for frame in frames[:3]:
        found = ask(session, frame)
        given = session.follow(found)
    assert found.frames == 1
    np.testing.assert_array_equal(given, found.covariance, 'a filter starts again')


@pytest.mark.parametrize(('degrees', 'metres', 'same'), [
    (0.0, 0.0, 1.0), (10.0, 0.0, np.exp(-1)), (0.0, 0.25, np.exp(-1)), (180.0, 0.0, 0.0)])
def test_a_look_repeats_a_view_as_far_as_odometry_has_not_moved(degrees, metres, same):
    looks = Looks().with_look(Look(frame(0.0), pose(), 0.8, None, 0.6))
    found, = looks.earlier(frame(1.0, degrees, metres), pose(degrees, metres))
    assert found == pytest.approx((0.8, 0.6, same), abs=1e-6)
    found, = looks.earlier(frame(1.0, degrees, metres), pose(degrees, metres + 9.0))
    assert found == pytest.approx((0.0, 0.0, same), abs=1e-6), 'another pose'
    assert looks.earlier(frame(0.0), pose()) == (), 'the same frame'


def test_looks_by_keyframes_remain_and_the_farthest_is_compared():
    place = RecognizedPlace(pose(), np.eye(6), np.eye(6), 99, 0.9)
    looks = Looks()
    for seconds, metres in ((0.0, 0.0), (1.0, -3.0), (2.0, 1.0)):
        looks = looks.with_look(Look(frame(seconds, 0.0, metres), pose(), 0.8, place), True)
    passed, then_from_now = looks.passed(frame(3.0, 0.0, 2.0))
    assert passed.observation.stamp_ns == 10**9 and then_from_now[0, 3] == 5.0
    alone = looks.with_look(Look(replace(frame(4.0), odom_from_camera=None), pose(), 0.8))
    assert len(alone.past) == 1 and alone.recognized == ()


def test_doubts_about_the_camera_count_for_the_view_alone(office_map, office_frames):
    """Some boxes are missing. The pose would be accepted if the camera were known to be right."""
    session = Localizer(Relocalizer(office_map, RelocalizerOptions()))
    found = session.answer(Query((replace(flickering(
        office_frames[0][0].observation, np.random.default_rng(0)), odom_from_camera=np.eye(4)),)))
    look, = session._looks.past
    assert look.doubted == found.evidence.confidence < 0.9 < look.confidence
    assert look.confidence == replace(found.evidence, camera=1.0).confidence


def test_a_changed_option_keeps_the_evidence(session):
    for number in range(4):
        drive(session, number, 3.0 * number, objects=3)
    session.depth_scale.add(DepthCheck(1, 0.0, 0.0, 2.0))
    session.use(Relocalizer(ROOM, RelocalizerOptions(matching='class', k=3)))
    assert session.depth_scale._ratios
    found = drive(session, 5.0, 12.0)
    assert 'last 5 frames' in found.reason
    found = drive(session, 4.0, 12.0)
    assert found.accepted, 'time went back'
    session.follow(found)
    session.use(RELOCALIZER)
    found = drive(session, 5.0, 12.0)
    assert (np.diag(session.follow(found)) > np.diag(found.covariance)).all()


def test_a_search_of_keyframes_that_time_cuts_off_is_named_and_repeated():
    class Late(Says):
        def localize_features(self, *_):
            return Recognition(is_complete=False)
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    answers = []
    for detections in (NOTHING, SEEN.select(np.arange(3))):
        asked = Query((frame(0.0, detections=detections),), (image,), None)
        session = Localizer(RELOCALIZER, Late(None))
        late = session.answer(asked)
        assert not session.query.by_keyframes
        answers.append(late.refusal_kind)
        again = Localizer(RELOCALIZER, Says(RecognizedPlace(
            MAP_FROM_CAMERA, np.eye(6) * 1e-4, np.eye(6) * 1e-4, 200, 0.9))).answer(
                session.query)
        assert again.reason == late.reason
        assert 'keyframes: time was up; raise timeout_s' in late.reason
        assert not again.accepted
    assert answers[0] == 'time_up'
    assert Localizer(RELOCALIZER, Late(None)).answer(Query(
        (frame(0.0),), (image,), None)).reason == '', 'accepted without keyframes'


def test_a_thorough_search_of_keyframes_that_time_forbids_is_named():
    class Slow(Says):
        def localize_features(self, features, camera, guesses, deadline, constraint, fast):
            if deadline < np.inf:  # the fast search takes all time
                threading.Event().wait(deadline - time.monotonic())
            return Recognition(is_thorough=fast is not None)
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    asked = Query((frame(0.0, detections=NOTHING),), (image,), None)
    late, in_time = (Localizer(RELOCALIZER, Slow(None)).answer(asked, deadline=deadline).reason
                     for deadline in (time.monotonic() + 1.0, np.inf))
    assert late == f'{in_time}; thorough search of keyframes: time was up; raise timeout_s'
