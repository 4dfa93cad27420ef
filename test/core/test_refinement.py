# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Refinement of one and several frames, its covariance, and which poses represent a place."""

from dataclasses import replace

import numpy as np
import pytest
from reference import scene_of, verify
from scene import BY_CLASS, CAMERA, MAP_FROM_CAMERA, ROOM, boxes_of, observe, rigid
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.fit import refinement
from cliploc_ros.core.fit.camera_fit import ERRORS
from cliploc_ros.core.fit.covariance import normalized_square, refined_covariance
from cliploc_ros.core.fit.verification import make_rig
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    make_transform,
    pose_difference,
    pose_error,
)
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, make_scene


def refine(scene, rotation, translation, vertical):
    """A single frame is a rig of one camera."""
    rig = make_rig([scene], np.eye(4)[None], vertical[None], np.zeros(len(scene.centers)))
    return refinement.refine_rig(rig, rotation, translation)


def split(map_from_camera):
    inverse = invert_transform(map_from_camera)
    return inverse[:3, :3].copy(), inverse[:3, 3].copy()


def shaken(rng, metres, degrees):
    """Return the true camera_from_map, randomly moved and turned."""
    pose = MAP_FROM_CAMERA.copy()
    turn = rng.normal(size=3)
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    shift = rng.normal(size=3)
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shift * metres / np.linalg.norm(shift)
    return split(pose)


def error_m(found):
    return pose_error(invert_transform(make_transform(found.rotation, found.translation)),
                      MAP_FROM_CAMERA)[0]


def test_a_perfect_view_leads_to_the_truth_and_a_noisy_one_near_it(room, rng):
    scene, errors_m = scene_of(room), []
    perfect = verify(scene, *shaken(rng, 0.0, 0.0)).score
    for _ in range(50):
        noisy, start = scene_of(room, noise_px=3.0, rng=rng), shaken(rng, 0.15, 3.0)
        found = refine(noisy, *start, VERTICAL_UNKNOWN)
        assert found.score >= refinement.LEAST_SHARE * verify(noisy, *start).score
        assert found.score == verify(noisy, found.rotation, found.translation).score
        errors_m.append(error_m(found))
        found = refine(scene, *shaken(rng, 0.08, 1.5), VERTICAL_UNKNOWN)
        assert error_m(found) < 1e-4
        assert found.score == pytest.approx(perfect, abs=1e-2)
        assert (np.linalg.eigvalsh(found.information) > 0).all()
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    # errors of three pixels leave this error, whatever the start
    assert np.median(errors_m) < 0.45 * 0.15


def test_nothing_to_go_by_changes_nothing(room):
    away = np.diag([-1.0, 1.0, -1.0])
    found = refine(scene_of(room), away, np.zeros(3), VERTICAL_UNKNOWN)
    assert found.score == 0.0 and not found.information.any()
    np.testing.assert_array_equal(found.rotation, away)
    np.testing.assert_array_equal(found.translation, np.zeros(3))


def test_derivatives_are_those_of_differences(room, rng):
    scene = scene_of(room)
    pairs = np.concatenate([scene.box_ellipses, room.centers, room.shapes,
                            np.tile([0.02, 4.0, 0.1], (len(room), 1))], axis=1)
    pairs[::3, 15] = 0.0  # without depth
    for _ in range(20):
        rotation, translation = shaken(rng, 0.3, 5.0)
        vertical = np.r_[rotation @ [0.1, 0.2, 0.97], 0.0, 0.0, 1.0, 0.05]
        jacobian = refinement.jacobian_of(pairs, vertical, rotation, translation)
        there, back = np.empty(len(jacobian)), np.empty(len(jacobian))
        for axis, step in enumerate(np.eye(6) * 1e-6):
            for sign, values in ((1, there), (-1, back)):
                moved = refinement.move(rotation, translation, sign * step)
                assert refinement.residuals_of(pairs, vertical, *moved, values)
            np.testing.assert_allclose(jacobian[:, axis], (there - back) / 2e-6, rtol=1e-4,
                                       atol=1e-4)


UNSHARED, EXACT = np.zeros((len(ROOM), 2)), np.zeros(ERRORS)


def fitted(poses, centers, sigma, rng=None, noise_px=0.0, stamps=None, shared=UNSHARED,
           wrong_share=0.0, camera=CAMERA, deviations=EXACT):
    """Return the pose of the last camera in a map with these centres, and its covariance."""
    noise = 0.0 if rng is None else rng.normal(0, noise_px, (len(poses), len(ROOM), 4))
    boxes = np.array([boxes_of(ROOM, pose) for pose in poses]) + noise
    scenes = [make_scene(camera.normalize_bboxes(shown), centers, ROOM.shapes,
                         np.eye(len(ROOM), dtype=bool), np.empty((0, 2), int), 0.05)
              for shown in boxes]
    rig = make_rig(scenes, np.array([invert_transform(pose) @ poses[-1] for pose in poses]),
                   np.tile(VERTICAL_UNKNOWN, (len(poses), 1)), np.full(len(ROOM), sigma))
    found = refinement.refine_rig(rig, *split(poses[-1]))
    stamps = np.arange(len(poses)) if stamps is None else np.array(stamps)
    return (invert_transform(make_transform(found.rotation, found.translation)),
            refined_covariance(rig, found.rotation, found.translation, stamps, shared,
                               wrong_share, (0.0, 0.0), deviations))


def turning(count):
    return [MAP_FROM_CAMERA @ rigid(axis='y', degrees=2.0 * step) for step in range(count)]


def test_odometry_errs_as_much_to_later_frames_as_to_earlier_ones():
    """The reference has the last instant, or the first: the way to each frame is the same."""
    covariances = [fitted(turning(4), ROOM.centers, 0.02, stamps=stamps)[1]
                   for stamps in ([0, 1, 2, 3], [3, 2, 1, 0])]
    np.testing.assert_allclose(*covariances, rtol=1e-6)


def move_map(rng, pose):
    """The error is about the camera: 5 cm and 2 degrees, common to all landmarks."""
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(2.0), 3)).as_matrix()
    return {'centers': (ROOM.centers - pose[:3, 3]) @ turn.T + pose[:3, 3]
            + rng.normal(0, 0.05, 3)}


INTRINSICS = np.array([0.04, 0.02, 0.02, 0.02, 0.0, 0.0, 0.0])


def change_camera(rng, pose):
    focal, aspect, x, y = INTRINSICS[:4] * rng.normal(size=4)
    return {'camera': replace(
        CAMERA, fx=CAMERA.fx * np.exp(focal + aspect / 2), cx=CAMERA.cx + 500 * x,
        fy=CAMERA.fy * np.exp(focal - aspect / 2), cy=CAMERA.cy + 500 * y)}


# For each error: the disturbance, arguments with and without its stated deviation, and the
# greatest share in the ellipsoids without it.
STATED = {
    'landmarks': (lambda rng, pose: {'centers': rng.normal(ROOM.centers, 0.1)}, {'sigma': 0.1},
                  {'sigma': DEFAULT_SIGMA_M}, 0.6),
    'the map': (move_map, {'shared': np.tile([0.05, np.radians(2.0)], (len(ROOM), 1))}, {}, 0.5),
    'intrinsics': (change_camera, {'deviations': INTRINSICS}, {}, 0.7)}


@pytest.mark.parametrize('frames', [1, 4])
@pytest.mark.parametrize('what', STATED)
def test_errors_are_covered_where_they_are_stated(what, frames):
    rng, squares, poses = np.random.default_rng(5), [], turning(frames)
    disturb, stated, unknown, most = STATED[what]
    for _ in range(100):
        wrong, seed = disturb(rng, poses[-1]), int(rng.integers(1000))
        squares.append([normalized_square(*fitted(
            poses, **{'centers': ROOM.centers, 'sigma': 0.01} | wrong | known, noise_px=2.0,
            rng=np.random.default_rng(seed)), poses[-1]) for known in (stated, unknown)])
    within = (np.array(squares) < chi2.ppf(0.95, 6)).mean(axis=0)
    print(f'\n{what}, {frames} frames: {within} in the 95 % ellipsoids, stated and not')
    assert within[0] >= 0.87 and within[1] <= most


def test_the_covariance_holds_the_chance_that_an_object_is_wrong():
    def added_in(centers):
        return (fitted([MAP_FROM_CAMERA], centers, 0.02, wrong_share=0.07)[1]
                - fitted([MAP_FROM_CAMERA], centers, 0.02)[1])

    added = added_in(ROOM.centers)
    assert np.linalg.eigvalsh(added).min() > -1e-9
    assert np.trace(added[:3, :3]) > 0.01 * np.trace(
        fitted([MAP_FROM_CAMERA], ROOM.centers, 0.02)[1][:3, :3])
    displaced = ROOM.centers.copy()
    displaced[4] += [0.06, 0.04, 0.0]
    # without this object the pose would step back
    step = pose_difference(MAP_FROM_CAMERA, fitted([MAP_FROM_CAMERA], displaced, 0.02)[0])[:3]
    more = (added_in(displaced) - added)[:3, :3]
    assert step @ more @ step > 0.07 * (step @ step) ** 2 > 0.0


def test_a_map_states_what_its_landmarks_share():
    assert not ROOM.shared_sigmas.any()
    stated = replace(ROOM, details=(LandmarkDetails(shared_sigma=0.1, shared_sigma_deg=3.0),
                                    *[LandmarkDetails()] * (len(ROOM) - 1)))
    assert stated.shared_sigmas[0] == pytest.approx([0.1, np.radians(3.0)])
    assert not stated.shared_sigmas[1:].any()
    plain, shared = (Relocalizer(each, BY_CLASS).relocalize([observe(ROOM)]).covariance
                     for each in (ROOM, replace(ROOM, details=(stated.details[0],) * len(ROOM))))
    # the covariance does not shrink with the number of landmarks
    np.testing.assert_allclose(np.diag(shared - plain), [0.01] * 3 + [np.radians(3.0) ** 2] * 3,
                               rtol=0.1)
