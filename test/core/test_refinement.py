# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refinement: nearer to the truth, never worse, and sure of what the boxes fix."""

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room
from scipy.spatial.transform import Rotation

from cliploc_ros.core.association.scene import Workspace, make_scene, verify
from cliploc_ros.core.fit.refinement import VERTICAL_UNKNOWN, linearize, move, residuals_of
from cliploc_ros.core.fit.several_frames import _LEAST_SHARE, make_rig, refine_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error


@pytest.fixture(scope='module')
def room():
    return make_room()


def see(room, noise_px=0.0, rng=None):
    boxes = see_room(room).bboxes_xyxy
    if noise_px:
        boxes = boxes + rng.normal(0, noise_px, boxes.shape)
    potential = np.array(room.class_ids)[:, None] == np.array(room.class_ids)[None]
    return make_scene(CAMERA.normalize_bboxes(boxes), room.centers, room.shapes, potential,
                      np.argwhere(potential), 0.2)


def refine(scene, rotation, translation, vertical, workspace):
    """One frame alone is a rig of one."""
    return refine_rig(make_rig([scene], np.eye(4)[None], vertical[None]), rotation, translation,
                      workspace)


def shaken(rng, metres, degrees):
    """The true camera_from_map, its camera moved and turned at random."""
    pose = MAP_FROM_CAMERA.copy()
    turn = rng.normal(size=3)
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    shift = rng.normal(size=3)
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shift * metres / np.linalg.norm(shift)
    camera_from_map = invert_transform(pose)
    return (np.ascontiguousarray(camera_from_map[:3, :3]),
            np.ascontiguousarray(camera_from_map[:3, 3]))


def error_of(rotation, translation):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose_error(invert_transform(pose), MAP_FROM_CAMERA)


def test_a_perfect_view_leads_to_the_truth(room, rng):
    scene, workspace = see(room), Workspace.allocate(len(room))
    perfect = verify(scene, *shaken(rng, 0.0, 0.0), workspace)
    for _ in range(50):
        rotation, translation = shaken(rng, 0.08, 1.5)
        score, information = refine(scene, rotation, translation, VERTICAL_UNKNOWN, workspace)
        assert error_of(rotation, translation)[0] < 1e-4
        assert score == pytest.approx(perfect, abs=1e-2)
        assert (np.linalg.eigvalsh(information) > 0).all()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_it_is_nearer_the_truth_than_before_and_hardly_ever_scores_less(room, rng):
    before, after = [], []
    for _ in range(200):
        scene, workspace = see(room, 3.0, rng), Workspace.allocate(len(room))
        rotation, translation = shaken(rng, 0.15, 3.0)
        before.append(error_of(rotation, translation)[0])
        start = verify(scene, rotation, translation, workspace)
        score, _ = refine(scene, rotation, translation, VERTICAL_UNKNOWN, workspace)
        assert score >= _LEAST_SHARE * start
        assert score == verify(scene, rotation, translation, workspace)
        after.append(error_of(rotation, translation)[0])
    print(f'\nshaken by {np.median(before):.2f} m, boxes by 3 px: '
          f'{np.median(after):.3f} m off afterwards (median)')
    # three pixels leave so much, wherever one starts
    assert np.median(after) < 0.45 * np.median(before)


def test_the_information_is_the_scatter_of_the_results(room, rng):
    """Over many noisy views, errors are as large as the information says, in deviations."""
    normalized = []
    for _ in range(300):
        scene, workspace = see(room, 3.0, rng), Workspace.allocate(len(room))
        rotation, translation = shaken(rng, 0.02, 0.3)
        _, information = refine(scene, rotation, translation, VERTICAL_UNKNOWN, workspace)
        true = MAP_FROM_CAMERA
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation
        found = invert_transform(pose)
        error = np.r_[true[:3, 3] - found[:3, 3], Rotation.from_matrix(
            true[:3, :3] @ found[:3, :3].T).as_rotvec()]
        normalized.append(np.linalg.cholesky(information).T @ error)
    # the deviations assumed are not those of this noise, but the ratio must not depend on the axis
    deviations = np.std(normalized, axis=0)
    print(f'\nwhitened errors: {np.round(deviations, 3)}')
    assert deviations.max() < 1.3 * deviations.min()


def test_a_known_vertical_is_kept(room, rng):
    up = np.array([0.1, -0.9, 0.2]) / np.linalg.norm([0.1, -0.9, 0.2])
    true_rotation = invert_transform(MAP_FROM_CAMERA)[:3, :3]
    vertical = np.r_[true_rotation @ up, up, np.radians(0.1)]
    tilts = {}
    for name, known in (('known', vertical), ('unknown', VERTICAL_UNKNOWN)):
        tilts[name] = []
        for seed in range(50):
            own = np.random.default_rng(seed)
            scene, workspace = see(room, 4.0, own), Workspace.allocate(len(room))
            rotation, translation = shaken(own, 0.1, 1.0)
            refine(scene, rotation, translation, known, workspace)
            tilts[name].append(np.degrees(np.arccos(np.clip(
                (rotation @ up) @ (true_rotation @ up), -1, 1))))
    assert np.median(tilts['known']) < 0.5 * np.median(tilts['unknown'])


def test_nothing_to_go_by_changes_nothing(room):
    scene, workspace = see(room), Workspace.allocate(len(room))
    away = np.diag([-1.0, 1.0, -1.0])
    rotation, translation = away.copy(), np.zeros(3)
    score, information = refine(scene, rotation, translation, VERTICAL_UNKNOWN, workspace)
    assert score == 0.0
    assert not information.any()
    np.testing.assert_array_equal(rotation, away)


def test_derivatives_are_those_of_differences(room, rng):
    scene = see(room)
    pairs = np.concatenate([scene.box_ellipses, room.centers, room.shapes], axis=1)
    for _ in range(20):
        rotation, translation = shaken(rng, 0.3, 5.0)
        vertical = np.r_[rotation @ [0.1, 0.2, 0.97], 0.0, 0.0, 1.0, 0.05]
        fixed = pairs, vertical
        count = 4 * len(room) + 3
        residuals, jacobian = np.empty(count), np.empty((count, 6))
        assert residuals_of(*fixed, rotation, translation, residuals)
        linearize(*fixed, rotation, translation, residuals, jacobian, np.empty((6, 6)),
                   np.empty(6))
        there, back = np.empty(count), np.empty(count)
        for axis, step in enumerate(np.eye(6) * 1e-6):
            moved, moved_translation = np.empty((3, 3)), np.empty(3)
            for sign, values in ((1, there), (-1, back)):
                move(rotation, translation, sign * step, moved, moved_translation)
                assert residuals_of(*fixed, moved, moved_translation, values)
            np.testing.assert_allclose(jacobian[:, axis], (there - back) / 2e-6, rtol=1e-4,
                                       atol=1e-4)
