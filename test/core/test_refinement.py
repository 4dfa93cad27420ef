# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refinement: nearer to the truth, never worse, and sure of what the boxes fix."""

import numpy as np
import pytest
from reference import verify
from scene import CAMERA, MAP_FROM_CAMERA, see_room
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.refinement import (
    LEAST_SHARE,
    jacobian_of,
    move,
    refine_rig,
    residuals_of,
)
from cliploc_ros.core.fit.verification import make_rig
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, make_scene


def see(room, noise_px=0.0, rng=None):
    boxes = see_room(room).bboxes_xyxy
    if noise_px:
        boxes = boxes + rng.normal(0, noise_px, boxes.shape)
    potential = np.array(room.class_ids)[:, None] == np.array(room.class_ids)[None]
    return make_scene(CAMERA.normalize_bboxes(boxes), room.centers, room.shapes, potential,
                      np.argwhere(potential), 0.2)


def refine(scene, rotation, translation, vertical):
    """One frame alone is a rig of one."""
    rig = make_rig([scene], np.eye(4)[None], vertical[None], np.zeros(len(scene.centers)))
    return refine_rig(rig, rotation, translation)


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
    scene = see(room)
    perfect = verify(scene, *shaken(rng, 0.0, 0.0)).score
    for _ in range(50):
        found = refine(scene, *shaken(rng, 0.08, 1.5), VERTICAL_UNKNOWN)
        assert error_of(found.rotation, found.translation)[0] < 1e-4
        assert found.score == pytest.approx(perfect, abs=1e-2)
        assert (np.linalg.eigvalsh(found.information) > 0).all()
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


def test_it_is_nearer_the_truth_than_before_and_hardly_ever_scores_less(room, rng):
    before, after = [], []
    for _ in range(200):
        scene, start = see(room, 3.0, rng), shaken(rng, 0.15, 3.0)
        before.append(error_of(*start)[0])
        found = refine(scene, *start, VERTICAL_UNKNOWN)
        assert found.score >= LEAST_SHARE * verify(scene, *start).score
        assert found.score == verify(scene, found.rotation, found.translation).score
        after.append(error_of(found.rotation, found.translation)[0])
    print(f'\nshaken by {np.median(before):.2f} m, boxes by 3 px: '
          f'{np.median(after):.3f} m off afterwards (median)')
    # three pixels leave so much, wherever one starts
    assert np.median(after) < 0.45 * np.median(before)


def test_nothing_to_go_by_changes_nothing(room):
    away = np.diag([-1.0, 1.0, -1.0])
    found = refine(see(room), away, np.zeros(3), VERTICAL_UNKNOWN)
    assert found.score == 0.0
    assert not found.information.any()
    np.testing.assert_array_equal(found.rotation, away)
    np.testing.assert_array_equal(found.translation, np.zeros(3))


def test_derivatives_are_those_of_differences(room, rng):
    scene = see(room)
    pairs = np.concatenate([scene.box_ellipses, room.centers, room.shapes,
                            np.tile([0.02, 4.0, 0.1], (len(room), 1))], axis=1)
    pairs[::3, 15] = 0.0  # without depth
    for _ in range(20):
        rotation, translation = shaken(rng, 0.3, 5.0)
        vertical = np.r_[rotation @ [0.1, 0.2, 0.97], 0.0, 0.0, 1.0, 0.05]
        jacobian = jacobian_of(pairs, vertical, rotation, translation)
        there, back = np.empty(len(jacobian)), np.empty(len(jacobian))
        for axis, step in enumerate(np.eye(6) * 1e-6):
            for sign, values in ((1, there), (-1, back)):
                moved = move(rotation, translation, sign * step)
                assert residuals_of(pairs, vertical, *moved, values)
            np.testing.assert_allclose(jacobian[:, axis], (there - back) / 2e-6, rtol=1e-4,
                                       atol=1e-4)
