# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several frames joined by odometry, through the one door to the method."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, boxes_of
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.fit.verification import MAX_FRAMES
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import OptionsError
from cliploc_ros.offline.evaluation.trials import make_queries, with_neighbours, with_vertical

ODOM_FROM_MAP = make_transform(Rotation.from_euler('z', 70, degrees=True).as_matrix(),
                               np.array([30.0, -4.0, 1.0]))
OPTIONS = RelocalizerOptions(matching='class')
LIMITS_M = (0.25, 0.5, 1.0)


def see(room, map_from_camera, rows=None):
    """An observation of some landmarks, whose odometry has no error."""
    rows = np.arange(len(room)) if rows is None else np.asarray(rows, dtype=np.int64)
    seen = Detections(boxes_of(room, map_from_camera)[rows],
                      tuple(room.class_ids[row] for row in rows), np.full(len(rows), 0.9))
    return Observation(CAMERA, seen, odom_from_camera=ODOM_FROM_MAP @ map_from_camera)


def moved(map_from_camera, metres, degrees):
    """A camera that went on and turned about its vertical axis."""
    turn = Rotation.from_euler('y', degrees, degrees=True).as_matrix()
    return map_from_camera @ make_transform(turn, np.array([metres, 0.0, 0.5 * metres]))


@pytest.fixture
def walk():
    return [moved(MAP_FROM_CAMERA, 0.05 * step, 2.0 * step) for step in range(4)]


def test_objects_seen_one_after_the_other_are_as_good_as_at_once(room, walk):
    """No frame alone shows three objects that can be told apart."""
    shares = [[0, 4, 8], [3, 7], [2, 11, 9], [1, 5]]
    frames = [see(room, pose, rows) for pose, rows in zip(walk, shares, strict=True)]
    relocalizer = Relocalizer(room, OPTIONS)
    assert not any(relocalizer.relocalize([one]).accepted for one in frames)
    found = relocalizer.relocalize(frames)
    assert found.accepted, found.reason
    assert pose_error(found.map_from_camera, walk[-1]) < (0.01, 0.2)
    # of the last frame alone
    assert [match.detection for match in found.matches] == [0, 1]
    assert [match.landmark for match in found.matches] == shares[-1]


@pytest.mark.filterwarnings('error')
def test_last_frames_without_objects_take_no_confidence(room):
    """The test for mirror images goes back to frames that show something."""
    walk = [moved(MAP_FROM_CAMERA, 0.05 * step, 2.0 * step) for step in range(6)]
    relocalizer = Relocalizer(room, OPTIONS)
    confidences = [
        relocalizer.relocalize([see(room, pose, None if step < shown else [])
                                for step, pose in enumerate(walk)]).confidence
        for shown in (6, 4, 2)]
    assert confidences[0] > 0.99
    assert confidences == pytest.approx([confidences[0]] * 3, abs=1e-3)


def test_the_last_frame_is_the_one_asked_about(room, walk):
    relocalizer = Relocalizer(room, OPTIONS)
    frames = [replace(see(room, pose), stamp_ns=number) for number, pose in enumerate(walk)]
    for last in range(4):
        order = [frames[(last + 1 + step) % 4] for step in range(4)]
        found = relocalizer.relocalize(order)
        assert found.accepted
        assert found.stamp_ns == last
        assert pose_error(found.map_from_camera, walk[last]) < (0.01, 0.2)


@pytest.mark.parametrize('refine', [True, False])
def test_the_same_view_again_is_no_more_evidence(refine, room):
    relocalizer = Relocalizer(room, replace(OPTIONS, refine=refine))
    frame = see(room, MAP_FROM_CAMERA, [0, 1, 2, 4])
    once, often = relocalizer.relocalize([frame]), relocalizer.relocalize([frame] * 5)
    assert often.score == pytest.approx(5 * once.score, rel=0.02)
    assert often.confidence == pytest.approx(once.confidence, rel=0.05)
    assert (np.diag(often.covariance) > 0.9 * np.diag(once.covariance)).all()


def test_a_frame_that_shows_nothing_changes_nothing(room, walk):
    relocalizer = Relocalizer(room, OPTIONS)
    for empty in ([], [0], [0, 0]):
        found = relocalizer.relocalize([see(room, walk[0]), see(room, walk[1], empty)])
        assert found.accepted
        assert pose_error(found.map_from_camera, walk[1]) < (0.01, 0.2)
    found = relocalizer.relocalize([see(room, walk[0], []), see(room, walk[1], [3])])
    assert not found.solved and found.refusal_kind == 'too_few_objects'


UP = np.array([0.0, 0.0, 1.0])


def knowing_up(frame, map_from_camera):
    return replace(frame, up_in_camera=map_from_camera[:3, :3].T @ UP)


def tilt_deg(found):
    """Standard deviation of the tilt that a covariance states."""
    return np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[3:5, 3:5]).max()))


@pytest.mark.parametrize('deviation_deg', [0.1, 0.5])
def test_the_verticals_of_several_frames_count_as_one(deviation_deg, room):
    """They come from one sensor on one mount, so its error does not average out."""
    relocalizer = Relocalizer(room, replace(OPTIONS, vertical_deviation_deg=deviation_deg))
    at_once, one_by_one = [[0, 1, 3, 8, 7]], [[0, 1], [3], [8], [7]]
    one, four = (tilt_deg(relocalizer.relocalize([
        knowing_up(see(room, MAP_FROM_CAMERA, rows), MAP_FROM_CAMERA) for rows in shares]))
        for shares in (at_once, one_by_one))
    print(f'\ntilt: the same objects in one frame {one:.3f} deg, in four {four:.3f} deg')
    # refinement trusts four verticals more than one, and the boxes less
    assert four == pytest.approx(one, rel=0.06)
    assert four >= 0.95 * one


def test_odometry_adds_more_error_to_frames_that_are_further_apart(room):
    relocalizer, spreads = Relocalizer(room, OPTIONS), []
    for step_m in (0.02, 0.1, 0.2):
        poses = [moved(MAP_FROM_CAMERA, step_m * number, 0.0) for number in range(4)]
        fused = relocalizer.relocalize([see(room, pose) for pose in poses])
        alone = relocalizer.relocalize([see(room, poses[-1])])
        spreads.append(np.sqrt(np.diag(fused.covariance)[:3]).max()
                       - np.sqrt(np.diag(alone.covariance)[:3]).max())
    assert spreads[0] < spreads[1] < spreads[2]


def test_the_deviations_of_odometry():
    assert not odometry_deviations(np.eye(4)).any(), 'did not move'
    deviations = odometry_deviations(make_transform(
        Rotation.from_euler('z', 10, degrees=True).as_matrix(), np.array([0.5, 0.0, 0.0])))
    assert deviations[:3] == pytest.approx(0.005 + 0.03 * 0.5)
    assert deviations[3:] == pytest.approx(np.radians(0.25 + 0.03 * 10.0 + 0.15 * 0.5))


def test_two_rooms_alike_are_refused_in_any_number_of_frames(room, walk):
    """Until a frame shows what only one of them has."""
    shift = np.array([40.0, 0.0, 0.0])
    unique = [[0.5, 0.4, 4.0]]
    both = LandmarkMap(
        'map', tuple(f'{i}' for i in range(25)), tuple(f'thing {i}' for i in range(25)),
        (*room.class_ids, *room.class_ids, 'piano'),
        np.concatenate([room.centers, room.centers + shift, unique]),
        np.concatenate([room.semi_axes, room.semi_axes, [[0.2, 0.3, 0.25]]]),
        np.concatenate([room.quats_xyzw, room.quats_xyzw, [[0, 0, 0, 1.0]]]))
    relocalizer = Relocalizer(both, OPTIONS)
    alike = [see(both, pose, range(12)) for pose in walk]
    for count in (1, 2, 4):
        found = relocalizer.relocalize(alike[:count])
        assert not found.accepted
        assert found.refusal_kind == 'look_alike'
    told_apart = relocalizer.relocalize([see(both, walk[0], [*range(12), 24]), *alike[1:]])
    assert pose_error(told_apart.map_from_camera, walk[-1]) < (0.01, 0.2)
    assert told_apart.score > told_apart.hypotheses[1].score + 0.5


def test_bad_odometry_is_named(room, walk):
    relocalizer = Relocalizer(room, OPTIONS)
    first, last = see(room, walk[0]), see(room, walk[1])
    scaled, broken, mirrored = (first.odom_from_camera.copy() for _ in range(3))
    scaled[:3, :3] *= 1.01
    broken[0, 3] = np.nan
    mirrored[:3, 0] *= -1.0
    for odom, named in ((None, 'missing'), (scaled, 'no rigid'), (broken, 'no rigid'),
                        (mirrored, 'no rigid'), (np.eye(3), 'no rigid')):
        bad = replace(first, odom_from_camera=odom)
        for number, frames in enumerate(([bad, last], [last, bad]), 1):
            with pytest.raises(OptionsError, match=f'frame {number} of 2 is {named}'):
                relocalizer.relocalize(frames)
    for count in (0, MAX_FRAMES + 1):
        with pytest.raises(OptionsError, match=f'not {count}'):
            relocalizer.relocalize([first] * count)


@pytest.mark.full
@pytest.mark.parametrize('case', ['nothing', 'vertical_1_deg'])
def test_five_real_frames(case, office_map, queries, thresholds):
    """The 52 queries with their neighbours, 1 cm and 0.5 degrees of noise a step and axis."""
    asked, options = thresholds['fused'][case], RelocalizerOptions()
    knows_up = case != 'nothing'
    if knows_up:
        options = replace(options, height_range_m=(0.8, 2.2))
    relocalizer = Relocalizer(office_map, options)
    errors, accepted, normalized, milliseconds = [], [], [], []
    for seed in range(2):
        frames = make_queries(queries, office_map, every_frame=True)
        if knows_up:
            frames = with_vertical(frames, 1.0, seed)
        frames = with_neighbours(frames, [frame.group for frame in queries], 0.01, 0.5, seed)
        for query in (one for one in frames if queries[one.number].is_main):
            found = relocalizer.relocalize([*query.neighbours, query.observation])
            milliseconds.append(found.search_ms)
            accepted.append(found.accepted)
            errors.append(np.inf)
            if found.solved:
                pose, truth = found.map_from_camera, query.map_from_camera
                errors[-1] = pose_error(pose, truth)[0]
                error = np.r_[truth[:3, 3] - pose[:3, 3], Rotation.from_matrix(
                    truth[:3, :3] @ pose[:3, :3].T).as_rotvec()]
                if found.accepted and errors[-1] <= 1.0:
                    normalized.append(error @ np.linalg.solve(found.covariance, error))
    errors, accepted = np.array(errors), np.array(accepted)
    success = [float((errors <= limit).mean()) for limit in LIMITS_M]
    wrong = int((accepted & (errors > 1.0)).sum())
    recall = float(accepted[errors <= 1.0].mean())
    within = float((np.array(normalized) <= chi2.ppf(0.95, 6)).mean())
    print(f'\n{case}: success {np.round(success, 3)} at {LIMITS_M} m, median '
          f'{np.median(errors):.3f} m, accepted {accepted.mean():.2f} of all, {recall:.2f} of the '
          f'right, {wrong} wrong; {within:.2f} within their 95 % ellipsoids; '
          f'{np.median(milliseconds):.0f} ms')
    assert all(got >= least for got, least in zip(success, asked['success'], strict=True))
    assert wrong == 0
    assert recall >= asked['recall']
    assert within >= 0.9
