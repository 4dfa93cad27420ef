# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry between frames, in maps of a simulated walk whose poses have errors."""

import re
from dataclasses import replace

import numpy as np
import pytest
from disturbed_poses import (
    aligned_offsets_m,
    disturb,
    draw_errors,
    with_odometry,
)
from walk import look_at, make_table, see, walk_around

from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.joint import PosePrior, State, pose_bands
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.odometry import link_frames
from cliploc_ros.offline.mapping.options import MappingOptions, OdometryErrors, PoseErrors
from cliploc_ros.offline.mapping.views import make_views

POSE_ERRORS = PoseErrors(0.05, 1.0, 3.0)
NOISE = OdometryErrors(0.005, 0.2)
OPTIONS = MappingOptions(pose_errors=POSE_ERRORS, odometry_errors=NOISE)


@pytest.fixture(scope='module')
def truth():
    """Few objects and poor boxes: odometry tells more than they do."""
    return see(make_table(4), walk_around(frames=120), noise_px=6.0, missed=0.3)


@pytest.fixture(scope='module')
def disturbed(truth):
    return disturb(truth, draw_errors('correlated', truth.stamps_s, POSE_ERRORS,
                                      np.random.default_rng(1)))


@pytest.fixture(scope='module')
def without(disturbed):
    return build_map(disturbed, OPTIONS)


@pytest.fixture(scope='module')
def linked(truth, disturbed):
    return with_odometry(disturbed, truth, np.random.default_rng(2), NOISE)


def moved_odometry(detections, change):
    """Return the detections with their odometry changed by a function of the poses."""
    return replace(detections, odom_from_camera=change(detections.odom_from_camera.copy()))


def slip(poses, way_m=(0.3, 0.2, 0.0)):
    poses[60:, :3, 3] += way_m
    return poses


def lose(poses, frames=slice(None, None, 3)):
    poses[frames] = np.nan
    return poses


def scaled(factor):
    def change(poses):
        poses[:, :3, 3] *= factor
        return poses

    return change


def joined(built):
    """Return how many pairs of frames odometry joins, or None where it is left out."""
    note, = [one for one in built.report.notes if one.startswith('odometry')]
    found = re.search(r' (\d+) of 119 pairs', note)
    return int(found[1]) if found else None


def pose_error_m(built, truth):
    """Return how far the motions over 10 frames are off: root mean square [m]."""
    one, other = (np.linalg.inv(poses[:-10]) @ poses[10:]
                  for poses in (built.map_from_camera, truth.map_from_camera))
    return float(np.sqrt(np.square(one - other)[:, :3, 3].sum(axis=1).mean()))


def test_the_gradient_is_that_of_the_cost(linked):
    few = moved_odometry(linked, slip).select_frames(range(56, 64))
    views = make_views(few)
    steps, _ = link_frames(views, few.odom_from_camera, PoseErrors(0.5, 2.0), OdometryErrors())
    assert steps.frames.tolist() == list(range(7))
    landmarks = landmarks_of_map(make_table(4), few.class_names)
    state = State(views, landmarks, np.zeros((8, 6)))

    def cost(pose_steps):
        return steps.linearize(state.moved(np.zeros((4, 9)), pose_steps.reshape(8, 6)).views)[0]

    expected = [(cost(step) - cost(-step)) / 2e-5 for step in 1e-5 * np.eye(48)]
    np.testing.assert_allclose(steps.linearize(views)[3].ravel(), expected, atol=1e-4)


def test_bands_are_those_of_the_matrix():
    rng, frames = np.random.default_rng(0), 5
    blocks, below = rng.normal(size=(2, frames, 6, 6))
    blocks += blocks.transpose(0, 2, 1)
    below[-1] = 0.0
    prior = PosePrior.of(np.arange(5.0), POSE_ERRORS)
    matrix = np.zeros((30, 30))
    for frame in range(frames):
        rows = slice(6 * frame, 6 * frame + 6)
        matrix[rows, rows] = blocks[frame] + np.diag(prior.diagonal[frame])
        if frame + 1 < frames:
            matrix[6 * frame + 6:6 * frame + 12, rows] = below[frame] + np.diag(
                prior.beside[frame])
    bands = pose_bands(blocks, prior, below)
    assert bands.shape == (12, 30)
    for number, band in enumerate(bands):
        assert band[:30 - number] == pytest.approx(np.diag(matrix, -number))
        assert (band[30 - number:] == 0.0).all()


def test_odometry_betters_poses_and_map(truth, linked, without):
    built = build_map(linked, OPTIONS)
    assert joined(built) == 119
    assert pose_error_m(built, truth) < 0.6 * pose_error_m(without, truth)
    assert (np.median(aligned_offsets_m(built.landmark_map, make_table(4)))
            < 0.8 * np.median(aligned_offsets_m(without.landmark_map, make_table(4))))


@pytest.mark.parametrize(('way_m', 'pairs', 'share'), [
    ((0.3, 0.2, 0.0), 118, 0.6), ((0.05, 0.05, 0.0), 119, 1.0)])
def test_a_slip_is_left_out_and_one_that_the_poses_hide_does_little_harm(
        truth, linked, without, way_m, pairs, share):
    built = build_map(moved_odometry(linked, lambda poses: slip(poses, way_m)), OPTIONS)
    assert joined(built) == pairs
    assert any('jumps 1 times' in one for one in built.report.notes) == (pairs == 118)
    assert pose_error_m(built, truth) < share * pose_error_m(without, truth)


@pytest.mark.parametrize('change', [
    scaled(1.25), scaled(1e300), lambda poses: np.concatenate([poses[:10], poses[:-10]]),
    lambda poses: poses @ look_at(np.array([1.0, 0.0, 0.8])),
    lambda poses: lose(poses, slice(None)),
], ids=['a fourth too far', 'huge', 'two seconds late', 'another camera', 'none'])
def test_odometry_that_contradicts_the_poses_is_left_out(linked, without, change):
    built = build_map(moved_odometry(linked, change), OPTIONS)
    assert any('is left out: ' in one for one in built.report.notes)
    assert (built.landmark_map.centers == without.landmark_map.centers).all()


def test_frames_without_odometry_are_not_joined(linked):
    assert joined(build_map(moved_odometry(linked, lose), OPTIONS)) == 40


def test_poses_that_are_taken_as_they_are_need_no_odometry(linked):
    assert joined(build_map(linked)) is None


def test_selected_frames_keep_what_belongs_to_them(linked):
    depths = np.arange(len(linked.classes), dtype=np.float32)
    chosen = replace(linked, depths=depths).select_frames([5, 3])
    assert (chosen.odom_from_camera == linked.odom_from_camera[[5, 3]]).all()
    rows = np.r_[np.arange(*linked.frame_offsets[5:7]), np.arange(*linked.frame_offsets[3:5])]
    assert (chosen.depths == depths[rows]).all()
