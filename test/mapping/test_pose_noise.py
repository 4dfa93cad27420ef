# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of a simulated walk with errors of poses and mount, and with odometry between frames."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import walk
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.offline.mapping import joint
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.odometry import link_frames
from cliploc_ros.offline.mapping.options import MappingOptions, OdometryErrors, PoseErrors
from cliploc_ros.offline.mapping.views import Views, make_views

ESTIMATING = MappingOptions(estimate_pose_errors=True)
#: The camera is 3 cm and 2 degrees away from the given poses.
MOUNT = make_transform(Rotation.from_rotvec(np.radians([1.2, -1.2, 1.0])).as_matrix(),
                       np.array([0.02, -0.01, 0.02]))


@pytest.fixture(scope='module')
def seen():
    return walk.see(walk.make_table(), walk.walk_around(frames=120), noise_px=2.0)


def draft_of(detections):
    built = build_map(detections)
    return (make_views(detections),
            landmarks_of_map(built.landmark_map, detections.class_names), built.shown)


def test_true_poses_are_found_to_be_true(seen):
    assert joint.significant_pose_errors(*draft_of(seen)) is None
    few = walk.see(walk.make_table(), walk.walk_around(frames=12))
    assert joint.estimate_pose_errors(*draft_of(few), make_views(few)) is None, 'too few boxes'
    plain, built = build_map(seen), build_map(seen, ESTIMATING)
    assert built.report == plain.report
    assert (built.landmark_map.centers == plain.landmark_map.centers).all()


@pytest.mark.parametrize('given', [PoseErrors(0.02, 0.5), PoseErrors(0.04, 0.8, 3.0)])
def test_errors_are_estimated(seen, given):
    disturbed = walk.disturb(seen, walk.draw_errors(seen.stamps_s, given, seed=2))
    views, landmarks, shown = draft_of(disturbed)
    found = joint.estimate_pose_errors(views, landmarks, shown, views)
    # a walk of 24 s has eight independent errors of 3 s
    assert given.sigma_m / 2 < found.sigma_m < 2 * given.sigma_m
    assert given.sigma_deg / 2.5 < found.sigma_deg < 2 * given.sigma_deg
    assert (found.correlation_s < 0.3) == (given.correlation_s == 0.0)


def test_a_wrong_mount_is_corrected():
    # near and far, and not always straight at the table, which would hide a shift
    poses = np.array([walk.look_at(
        np.array([r * np.cos(a), r * np.sin(a), 1.5 + 0.3 * np.sin(2 * a)]),
        (0.4 * np.sin(5 * a), 0.4 * np.cos(4 * a), 0.8))
        for a in np.linspace(0.0, 5.0, 120) for r in [2.0 + 0.6 * np.sin(3.0 * a)]])
    seen = walk.see(walk.make_table(), poses, noise_px=2.0)
    wrong = seen.with_poses(seen.map_from_camera @ np.linalg.inv(MOUNT))
    table = walk.make_table()
    plain, built = build_map(wrong), build_map(wrong, MappingOptions(refine_mount=True))
    found = built.mount.given_from_corrected
    assert found[:3, 3] == pytest.approx(MOUNT[:3, 3], abs=0.005)
    turn = Rotation.from_matrix(found[:3, :3].T @ MOUNT[:3, :3])
    assert np.degrees(turn.magnitude()) < 0.2
    assert np.abs(built.map_from_camera - seen.map_from_camera).max() < 0.01
    assert np.median(walk.nearest_errors(built.landmark_map, table)) < 0.006
    assert np.median(walk.nearest_errors(plain.landmark_map, table)) > 0.02


def test_a_height_that_level_motion_does_not_show_stays_and_is_named():
    """A level camera turns about the vertical, which is its y axis."""
    angles = np.linspace(0.0, 5.0, 80)
    level = np.array([walk.look_at(
        np.array([2.2 * np.cos(a), 2.2 * np.sin(a), 0.8]),
        (0.2 * np.sin(3 * a), 0.2 * np.cos(2 * a), 0.8)) for a in angles])
    seen = walk.see(walk.make_table(), level, noise_px=1.0)
    raised = make_transform(np.eye(3), np.array([0.03, 0.06, 0.0]))
    wrong = seen.with_poses(level @ np.linalg.inv(raised))
    built = build_map(wrong, MappingOptions(refine_mount=True))
    found = built.mount.given_from_corrected[:3, 3]
    assert found[0] == pytest.approx(0.03, abs=0.01)
    assert abs(found[1]) < 0.01
    (note,) = [note for note in built.report.notes if 'not observable' in note]
    assert ': y (down);' in note


def views_of(stamps_s, frames):
    """Return views of some boxes; shared errors depend only on their frames."""
    count, boxes = len(stamps_s), len(frames)
    nothing = np.zeros((boxes, 4))
    return Views(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), stamps_s,
                 np.zeros(count, int), np.zeros((count, 3)), np.arange(count), np.ones(count),
                 np.searchsorted(frames, np.arange(count + 1)), frames, np.zeros(boxes, int),
                 nothing, nothing, nothing > 0, np.zeros((count, 4)), np.zeros(boxes),
                 np.zeros(boxes), np.tile([np.inf, 1.0], (boxes, 1)))


@pytest.mark.parametrize('correlation_s', [0.0, 3.0, 200.0])
def test_the_mean_error_of_the_poses_stays(correlation_s):
    errors, stamps = PoseErrors(0.05, 1.0, correlation_s), np.arange(0.0, 60.0, 0.7)
    means = [walk.draw_errors(stamps, errors, seed).mean(axis=0) for seed in range(300)]
    frames = np.arange(len(stamps))
    shared = joint.shared_by_neighbours(views_of(stamps, frames), 0 * frames, 1, errors)
    measured = np.std(means, axis=0).reshape(2, 3).mean(axis=1) * [1.0, np.degrees(1.0)]
    np.testing.assert_allclose(shared[0], joint._BENDING * measured, rtol=0.1)


def test_neighbours_are_what_some_frame_shows_together():
    """Landmarks 0 and 1, and 1 and 2 are seen together in three rooms; 3 briefly and alone."""
    frames = np.repeat(np.arange(100), 2)
    shown = np.concatenate([np.tile([0, 1], 40), np.tile([1, 2], 50), np.tile([3, -1], 10)])
    errors = PoseErrors(0.1, 2.0, 0.0)
    found = joint.shared_by_neighbours(views_of(np.arange(100.0), frames), shown, 5, errors)
    np.testing.assert_allclose(found[:4, 0] / (joint._BENDING * 0.1),
                               np.array([90, 90, 90, 10]) ** -0.5)
    np.testing.assert_allclose(found[:, 1], 20.0 * found[:, 0])
    # never seen: with the error of a single pose
    assert found[4, 0] == pytest.approx(joint._BENDING * 0.1)


POSE_ERRORS = PoseErrors(0.05, 1.0, 3.0)
NOISE = OdometryErrors(0.005, 0.2)
OPTIONS = MappingOptions(pose_errors=POSE_ERRORS, odometry_errors=NOISE)


@pytest.fixture(scope='module')
def truth():
    """With few objects and poor boxes, odometry has more information than the boxes."""
    return walk.see(walk.make_table(4), walk.walk_around(frames=120), noise_px=6.0, missed=0.3)


@pytest.fixture(scope='module')
def disturbed(truth):
    return walk.disturb(truth, walk.draw_errors(truth.stamps_s, POSE_ERRORS))


@pytest.fixture(scope='module')
def without(disturbed):
    return build_map(disturbed, OPTIONS)


@pytest.fixture(scope='module')
def linked(truth, disturbed):
    """With odometry: true motions with a random error of each step."""
    poses, rng = [np.eye(4)], np.random.default_rng(2)
    for before, after in pairwise(truth.map_from_camera):
        step = np.linalg.inv(before) @ after
        sigma_m, sigma_rad = NOISE.sigmas(
            np.linalg.norm(step[None, :3, 3], axis=1),
            Rotation.from_matrix(step[None, :3, :3]).magnitude())[0]
        turn = Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3)).as_matrix()
        step[:3, :3] = turn @ step[:3, :3]
        step[:3, 3] += rng.normal(0.0, sigma_m, 3)
        poses.append(poses[-1] @ step)
    return replace(disturbed, odom_from_camera=np.array(poses))


def moved_odometry(detections, change):
    """Return the detections with their odometry changed by a function of the poses."""
    return replace(detections, odom_from_camera=change(detections.odom_from_camera.copy()))


def slip(poses, way_m=(0.3, 0.2, 0.0)):
    poses[60:, :3, 3] += way_m
    return poses


def lose(poses, frames=slice(None, None, 3)):
    poses[frames] = np.nan
    return poses


def stretch(poses):
    poses[:, :3, 3] *= 1.25
    return poses


def joined(built):
    """Return the number of pairs of frames with odometry, or None if it is left out."""
    note, = [note for note in built.report.notes if note.startswith('odometry')]
    found = re.search(r' (\d+) of 119 pairs', note)
    return int(found[1]) if found else None


def pose_error_m(built, truth):
    """Return the root mean square error of motions over 10 frames [m]."""
    one, other = (np.linalg.inv(poses[:-10]) @ poses[10:]
                  for poses in (built.map_from_camera, truth.map_from_camera))
    return float(np.sqrt(np.square(one - other)[:, :3, 3].sum(axis=1).mean()))


def test_the_gradient_is_that_of_the_cost(linked):
    few = moved_odometry(linked, slip).select_frames(range(56, 64))
    views = make_views(few)
    steps, _ = link_frames(views, few.odom_from_camera, PoseErrors(0.5, 2.0), OdometryErrors())
    assert steps.frames.tolist() == list(range(7))
    landmarks = landmarks_of_map(walk.make_table(4), few.class_names)
    state = joint.State(views, landmarks, np.zeros((8, 6)))

    def cost(pose_steps):
        return steps.linearize(state.moved(np.zeros((4, 9)), pose_steps.reshape(8, 6)).views)[0]

    expected = [(cost(step) - cost(-step)) / 2e-5 for step in 1e-5 * np.eye(48)]
    np.testing.assert_allclose(steps.linearize(views)[3].ravel(), expected, atol=1e-4)


def test_odometry_betters_poses_and_map(truth, linked, without):
    built = build_map(linked, OPTIONS)
    assert joined(built) == 119
    assert pose_error_m(built, truth) < 0.6 * pose_error_m(without, truth)
    assert walk.shape_error_m(built.landmark_map, walk.make_table(4)) < 0.8 * walk.shape_error_m(
        without.landmark_map, walk.make_table(4))


@pytest.mark.parametrize(('way_m', 'pairs', 'share'), [
    ((0.3, 0.2, 0.0), 118, 0.6), ((0.05, 0.05, 0.0), 119, 1.0)])
def test_a_slip_is_left_out_and_one_that_the_poses_hide_does_little_harm(
        truth, linked, without, way_m, pairs, share):
    built = build_map(moved_odometry(linked, lambda poses: slip(poses, way_m)), OPTIONS)
    assert joined(built) == pairs
    assert any('jumps left out: 1' in note for note in built.report.notes) == (pairs == 118)
    assert pose_error_m(built, truth) < share * pose_error_m(without, truth)


@pytest.mark.parametrize('change', [
    stretch, lambda poses: np.concatenate([poses[:10], poses[:-10]]),
    lambda poses: poses @ walk.look_at(np.array([1.0, 0.0, 0.8])),
    lambda poses: lose(poses, slice(None)),
], ids=['a fourth too far', 'two seconds late', 'another camera', 'none'])
def test_odometry_that_contradicts_the_poses_is_left_out(linked, without, change):
    built = build_map(moved_odometry(linked, change), OPTIONS)
    assert any('is left out: ' in note for note in built.report.notes)
    assert (built.landmark_map.centers == without.landmark_map.centers).all()


def test_frames_without_odometry_are_not_joined(linked):
    assert joined(build_map(moved_odometry(linked, lose), OPTIONS)) == 40
    assert joined(build_map(linked)) is None, 'poses that are taken as they are need none'
