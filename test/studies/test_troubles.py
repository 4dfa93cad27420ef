# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps, detections and sensors go wrong as said, and the study counts every request."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.observation import Detections
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.evaluation import sensors
from cliploc_ros.evaluation.trials import make_queries
from studies import wrong_sensors
from studies.acceptance import priors, troubles
from studies.acceptance.__main__ import run
from studies.acceptance.places import Simulated
from studies.acceptance.searches import Task, search

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def questions(room, recording):
    return make_queries(recording, room)


@pytest.fixture
def changed(room, questions, rng):
    """Apply a change by so much."""
    return lambda change, level: change(room, questions, level, rng)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_landmarks_exchange_places(changed, room):
    other = changed(troubles.exchange_landmarks, 1.0)[0]
    assert other.labels == room.labels
    assert np.array_equal(np.sort(other.centers, axis=0), np.sort(room.centers, axis=0))
    assert (other.centers != room.centers).any(axis=1).all()
    some = changed(troubles.exchange_landmarks, 0.5)[0]
    assert (some.centers != room.centers).any(axis=1).sum() == round(len(room) / 2)


def test_landmarks_are_doubled_with_their_similarities(changed, room, questions):
    double, asked = changed(troubles.double_landmarks, 0.1)
    count = len(room)
    assert len(double) == len(set(double.landmark_ids)) == 2 * count
    np.testing.assert_allclose(
        np.linalg.norm(double.centers[count:] - double.centers[:count], axis=1), 0.1)
    similarities = asked[-1].observation.similarities
    np.testing.assert_array_equal(similarities[:, :count], similarities[:, count:])
    np.testing.assert_array_equal(similarities[:, :count], questions[-1].observation.similarities)


@pytest.fixture(scope='module')
def place():
    return Simulated('room', 1000).load()


@pytest.fixture(scope='module')
def queries(place):
    """Queries with true verticals and odometry."""
    return sensors.with_neighbours(sensors.with_vertical(place.frames), place.groups)


def angle_deg(one, other):
    return np.degrees(np.arccos(np.clip(one @ other, -1.0, 1.0)))


def steps(query):
    frames = sorted((*query.neighbours, query.observation), key=lambda one: one.stamp_ns)
    poses = [one.odom_from_camera for one in frames]
    return [invert_transform(a) @ b for a, b in pairwise(poses)]


def test_verticals_are_tilted_by_an_angle(queries):
    for before, after in zip(queries, wrong_sensors.tilted_vertical(queries, 10.0), strict=True):
        up = before.map_from_camera[2, :3]
        assert angle_deg(after.observation.up_in_camera, up) == pytest.approx(10.0)


def test_a_wrong_mount_turns_verticals_and_steps_alike(queries):
    before, after = queries[4], wrong_sensors.wrong_mount(queries, 5.0)[4]
    up, wrong_up = before.observation.up_in_camera, after.observation.up_in_camera
    assert 0.0 < angle_deg(up, wrong_up) <= 5.0 + 1e-6
    mount = invert_transform(before.observation.odom_from_camera) @ \
        after.observation.odom_from_camera
    assert pose_error(mount, np.eye(4))[1] == pytest.approx(5.0)
    np.testing.assert_allclose(mount[:3, :3].T @ up, wrong_up)
    for own, wrong in zip(steps(before), steps(after), strict=True):
        np.testing.assert_allclose(mount @ wrong, own @ mount, atol=1e-12)


def test_odometry_is_scaled(queries):
    before, after = queries[4], wrong_sensors.scaled_odometry(queries, 1.2)[4]
    assert len(steps(before)) == 4
    for own, long in zip(steps(before), steps(after), strict=True):
        own_m, own_deg = pose_error(np.eye(4), own)
        assert pose_error(np.eye(4), long) == pytest.approx((1.2 * own_m, 1.2 * own_deg))


@pytest.mark.parametrize(('change', 'level', 'expected'), [
    (wrong_sensors.middle_crop, 300.0, (12.5, 125.0, 137.5, 150.0)),
    (wrong_sensors.scaled_boxes, 0.5, (50.0, 100.0, 150.0, 120.0)),
    (wrong_sensors.shifted_boxes, 0.05, (132.0, 200.0, 332.0, 240.0)),
    (wrong_sensors.turned_boxes, 90.0, (240.0, 100.0, 280.0, 300.0)),
    (wrong_sensors.turned_boxes, 180.0, (340.0, 240.0, 540.0, 280.0)),
    (wrong_sensors.mirrored_boxes, 0.0, (340.0, 200.0, 540.0, 240.0)),
    (wrong_sensors.mirrored_boxes, 1.0, (100.0, 240.0, 300.0, 280.0)),
    (wrong_sensors.of_convention, 0.0, (200.0, 220.0, 200.0, 40.0)),
    (wrong_sensors.of_convention, 1.0, (100.0, 200.0, 200.0, 40.0)),
    (wrong_sensors.of_convention, 2.0, (0.15625, 5 / 12, 0.46875, 0.5)),
    (wrong_sensors.of_convention, 3.0, (200.0, 100.0, 240.0, 300.0)),
    (wrong_sensors.of_convention, 4.0, (-50.0, 80.0, 250.0, 320.0)),
    (wrong_sensors.of_convention, 5.0, (100.0, 200.0, 400.0, 440.0))])
def test_boxes_are_of_another_image_or_convention(queries, change, level, expected):
    box = Detections(np.array([[100.0, 200.0, 300.0, 240.0]]), ('cup',), np.ones(1))
    asked = replace(queries[0], neighbours=(), observation=replace(
        queries[0].observation, detections=box))
    found, = change([asked], level)[0].observation.detections.bboxes_xyxy
    assert tuple(found) == pytest.approx(expected)


def test_a_fisheye_bends_boxes_towards_the_middle(queries):
    camera = queries[0].observation.camera
    edges = camera.cx - camera.fx, camera.cy - 10.0, camera.cx, camera.cy + 10.0
    asked = replace(queries[0], neighbours=(), observation=replace(
        queries[0].observation, detections=Detections(np.array([edges]), ('cup',), np.ones(1))))
    found, = wrong_sensors.fisheye_boxes([asked], 0.0)[0].observation.detections.bboxes_xyxy
    assert found[0] == pytest.approx(camera.cx - np.pi / 4 * camera.fx)
    assert found[2] == pytest.approx(camera.cx)


def test_landmarks_and_boxes_come_again_under_other_classes(changed, room, questions):
    doubled, asked = changed(troubles.confuse_landmarks, 1)
    count = len(room)
    assert doubled.class_ids[:count] == room.class_ids
    assert all(one != other for one, other in zip(room.class_ids, doubled.class_ids[count:],
                                                  strict=True))
    assert np.linalg.norm(doubled.centers[count:] - room.centers, axis=1).max() < 0.2
    before, after = (sum(len(one.observation.detections) for one in its)
                     for its in (questions, asked))
    assert 1.5 * before < after < 1.9 * before
    assert all(one.observation.similarities.shape == (len(one.observation.detections), 2 * count)
               for one in asked)


@pytest.mark.parametrize(('share', 'is_own'), [(0.5, True), (-0.5, False)])
def test_one_of_two_equal_rooms_is_out_of_date(changed, room, questions, share, is_own):
    aged, asked = changed(troubles.add_aged_twin, share)
    count = len(room)
    kept = [[one for one in aged.landmark_ids if one.endswith('_copy') == copied]
            for copied in (False, True)]
    assert len(kept[is_own]) == count, 'the other room is as it was'
    assert len(kept[not is_own]) == count - round(0.5 * count) // 2
    assert 0 < len(asked) <= len(questions)
    assert asked[0].observation.similarities.shape[1] == len(aged)


def test_half_of_the_map_moves_together(changed, room):
    moved = changed(troubles.FAMILIES['C half of the map moved by [m]'].change, 0.5)[0]
    steps = np.linalg.norm(moved.centers - room.centers, axis=1)
    assert np.unique(steps.round(9)).tolist() == [0.0, 0.5]
    assert (steps > 0.25).sum() == len(room) // 2


def test_every_pose_at_an_unmapped_desk_is_wrong():
    outcomes = search(Task(Simulated('one desk', 1000), 'one image',
                           RelocalizerOptions(matching='class'), 'A unmapped desk'))
    assert len(outcomes) == 4
    assert not any(one.right for one in outcomes)


def test_a_family_counts_false_accepts_alone_and_in_order(capsys):
    assert run(['families', '--requests', '8', '--only', 'K scaled']) == 0
    *_, last = capsys.readouterr().out.strip().split('\n\n')
    rows = [row.strip('| ').split(' | ')[1:6] for row in last.splitlines()[2:]]
    assert [row[0] for row in rows] == ['alone', 'first five', 'later']
    # two levels; a mode alone, two modes in order: 12 worlds' queries, and 7 images of one world
    assert [int(row[1]) for row in rows] == [24, 20, 8]
    for row in rows:
        requests, right, accepted, false = map(int, row[1:])
        assert false <= accepted <= requests and right <= requests


def test_the_table_counts_each_request_once(capsys):
    assert run(['stress', '--worlds', '1', '--kinds', 'room', '--only', 'two identical']) == 0
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == 3, 'one for each mode'
    for row in rows:
        *_, right, success, accepted = row.strip('| ').split(' | ')
        shares = [float(one) for one in success.split()]
        right, requests = map(int, right.split(' of '))
        found, false = map(int, accepted.split(' (')[0].split(', '))
        assert requests == 4
        assert 0 <= false <= found <= 4
        assert 0 <= right <= 4
        assert shares == sorted(shares) and shares[-1] == right / 4


@pytest.mark.parametrize(('change', 'level', 'share'), [
    (wrong_sensors.scaled_depth, 1.15, 1.0), (wrong_sensors.random_depth, 1.0, 1.0),
    (wrong_sensors.depth_elsewhere, 1.0, 0.9), (wrong_sensors.missing_depth, 0.5, 0.5)])
def test_depths_are_wrong(questions, change, level, share):
    depths = [np.linspace(1.0, 3.0, len(one.observation.detections)) for one in questions]
    asked = [replace(one, observation=replace(one.observation, depths=its))
             for one, its in zip(questions, depths, strict=True)]
    wrong = np.concatenate([one.observation.depths for one in change(asked, level)])
    assert np.mean(wrong != np.concatenate(depths)) == pytest.approx(share, abs=0.15)
    assert [one.observation.depths for one in change(questions, level)] == [None] * len(questions)


@pytest.mark.parametrize('wrong', [False, True])
def test_regions_are_near_the_truth_or_elsewhere(wrong):
    place = Simulated('hall', 3).load()
    _, told = priors.tell(place.landmark_map, place.frames, float(wrong),
                          np.random.default_rng(0), (0.1, 0.1, 0.1))
    away = [np.linalg.norm(one.observation.region.mean[:2] - one.map_from_camera[:2, 3])
            for one in told]
    assert min(away) > 2.0 if wrong else max(away) < 0.5
