# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames joined by odometry, in a simulated room."""

import numpy as np
import pytest
from reference import verify
from scene import CAMERA, MAP_FROM_CAMERA, boxes_of
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.refinement import (
    linearize_rig,
    move,
    one_to_one,
    refine_rig,
    residuals_of_rig,
    robust_cost,
)
from cliploc_ros.core.fit.verification import make_rig, scores_of, verify_rig
from cliploc_ros.core.geometry.transforms import SAME_PLACE, invert_transform, make_transform
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import match_frame
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, make_scene

FRAMES = 4


@pytest.fixture
def walk(rng):
    """Poses of a camera that walks and turns; the last is the reference."""
    poses = [MAP_FROM_CAMERA]
    for _ in range(FRAMES - 1):
        step = make_transform(Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix(),
                              rng.normal(0, 0.2, 3))
        poses.append(poses[-1] @ step)
    return np.array(poses)


def see(room, map_from_camera, noise_px=0.0, rng=None, rows=slice(None)):
    """The scene of one frame: boxes of some landmarks, which may be any of their class."""
    boxes = boxes_of(room, map_from_camera)[rows]
    if noise_px:
        boxes = boxes + rng.normal(0, noise_px, boxes.shape)
    classes = np.array(room.class_ids)
    potential = classes[rows][:, None] == classes[None]
    return make_scene(CAMERA.normalize_bboxes(boxes), room.centers, room.shapes, potential,
                      np.argwhere(potential), 0.2)


def rig_of(room, poses, verticals=None, **noise):
    camera_from_reference = np.array([*(invert_transform(pose) @ poses[-1]
                                        for pose in poses[:-1]), np.eye(4)])
    if verticals is None:
        verticals = np.tile(VERTICAL_UNKNOWN, (len(poses), 1))
    return make_rig([see(room, pose, **noise) for pose in poses], camera_from_reference,
                    verticals, np.zeros(len(room)))


def split(map_from_camera):
    inverse = invert_transform(map_from_camera)
    return inverse[:3, :3].copy(), inverse[:3, 3].copy()


def shaken(pose, rng, metres, degrees):
    turn = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3))
    return make_transform(turn.as_matrix() @ pose[:3, :3], pose[:3, 3] + metres * rng.normal(
        size=3))


def test_the_score_is_the_sum_of_the_frames_scores(room, walk, rng):
    rig = rig_of(room, walk)
    shift = invert_transform(walk[-1]) @ shaken(walk[-1], rng, 0.03, 0.5)
    alone = []
    for pose in walk:  # the rig moves as one
        moved = walk[-1] @ shift @ invert_transform(walk[-1]) @ pose
        alone.append(verify(see(room, pose), *split(moved)))
    assert min(one.score for one in alone) > 1.0
    found = verify_rig(rig, *split(walk[-1] @ shift))
    assert found.score == pytest.approx(sum(one.score for one in alone), abs=1e-9)
    np.testing.assert_array_equal(found.landmarks,
                                  np.concatenate([one.landmarks for one in alone]))
    np.testing.assert_allclose(found.ious, np.concatenate([one.ious for one in alone]), atol=1e-9)


def test_frames_of_a_large_map_are_joined_with_their_groups(room, walk):
    count = 20
    shifts = np.repeat(np.c_[30.0 * np.arange(count), np.zeros((count, 2))], len(room), axis=0)
    many = LandmarkMap(
        'map', tuple(f'{i}' for i in range(count * len(room))), room.labels * count,
        room.class_ids * count, np.tile(room.centers, (count, 1)) + shifts,
        np.tile(room.semi_axes, (count, 1)), np.tile(room.quats_xyzw, (count, 1)))
    scenes = []
    for rows in ([0, 1, 2, 3, 5], [], [4, 7], [6]):  # no two frames show the same classes
        boxes = boxes_of(room, walk[len(scenes)])[rows]
        seen = Detections(boxes, tuple(room.class_ids[row] for row in rows), np.ones(len(rows)))
        scenes.append(match_frame(many, Observation(CAMERA, seen),
                                  RelocalizerOptions(matching='class'))[0])
    assert [len(scene.groups.starts) - 1 for scene in scenes] == [3, 0, 1, 1]
    cameras = np.array([invert_transform(pose) @ walk[-1] for pose in walk])
    rig = make_rig(scenes, cameras, np.tile(VERTICAL_UNKNOWN, (FRAMES, 1)),
                   many.position_sigmas)
    place = 3
    reference = walk[-1].copy()
    reference[0, 3] += 30.0 * place
    found = verify_rig(rig, *split(reference))
    np.testing.assert_array_equal(
        found.landmarks, place * len(room) + np.array([0, 1, 2, 3, 5, 4, 7, 6]))
    assert found.ious.min() > 0.6


def test_frames_that_saw_nothing_take_no_part(room, walk):
    relative = np.array([invert_transform(pose) @ walk[-1] for pose in walk])
    scenes = [see(room, walk[0]), see(room, walk[1], rows=slice(0, 0)),
              see(room, walk[2], rows=slice(2, 3)), see(room, walk[3], rows=slice(0, 0))]
    rig = make_rig(scenes, relative, np.tile(VERTICAL_UNKNOWN, (FRAMES, 1)),
                   np.zeros(len(room)))
    perfect = verify_rig(rig, *split(walk[-1]))
    np.testing.assert_array_equal(perfect.landmarks, [*range(len(room)), 2])
    refined = refine_rig(rig, *split(walk[-1]))
    assert refined.score == pytest.approx(perfect.score, abs=1e-2)
    assert (np.linalg.eigvalsh(refined.information) > 0).all()


def test_the_gradient_is_that_of_differences(room, walk, rng):
    """Which holds for the information too: both go through the same change of steps."""
    up = np.array([0.1, -0.2, 0.9]) / np.linalg.norm([0.1, -0.2, 0.9])
    verticals = np.array([[*(invert_transform(pose)[:3, :3] @ up), *up, 0.02] for pose in walk])
    rig = rig_of(room, walk, verticals, noise_px=3.0, rng=rng)
    rotation, translation = split(shaken(walk[-1], rng, 0.1, 2.0))
    inliers = one_to_one(rig, verify_rig(rig, rotation, translation), rotation, translation)
    assert inliers.starts[-1] == len(inliers.pairs) > 2 * len(room)

    def residuals_at(pose):
        in_front, residuals = residuals_of_rig(inliers, *pose)
        assert in_front
        return residuals

    def cost(step):
        return robust_cost(residuals_at(move(rotation, translation, step)))

    differences = [(cost(step) - cost(-step)) / 2e-6 for step in np.eye(6) * 1e-6]
    information, gradient = linearize_rig(inliers, rotation, translation,
                                          residuals_at((rotation, translation)))
    np.testing.assert_allclose(-2.0 * gradient, differences, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(information, information.T, rtol=1e-9, atol=1e-6)


def test_the_best_at_each_place_are_chosen(room, walk, rng):
    rig = rig_of(room, walk)
    near = [shaken(walk[-1], rng, 0.02, 0.3) for _ in range(6)]
    far = walk[-1].copy()
    far[2, 3] -= 1.0
    poses = [*near[:3], far, *near[3:]]
    rotations, translations = (np.array(part) for part in zip(*map(split, poses), strict=True))
    scores = scores_of(rig, rotations, translations)
    order = np.argsort(-scores, kind='stable')
    rows = order[SAME_PLACE.distinct(np.array(poses)[order], 5)]
    assert len(rows) == 2
    assert rows[1] == 3
    assert scores[rows[0]] == scores.max() > scores[3]
    rows = order[SAME_PLACE.distinct(np.array(poses)[order], 1)]
    np.testing.assert_array_equal(rows, [int(np.argmax(scores))])
