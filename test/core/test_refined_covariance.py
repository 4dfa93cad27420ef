# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of landmarks in refinement, covariance and confidence, in a simulated room."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, boxes_of, make_room
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.fit.covariance import EXACT, normalized_square, refined_covariance
from cliploc_ros.core.fit.refinement import (
    LEAST_DEVIATION,
    RELATIVE_DEVIATION,
    edge_deviation,
    refine_rig,
)
from cliploc_ros.core.fit.verification import make_rig
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import DEFAULT_SIGMA_M
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN, make_scene

ROOM = make_room()
BY_CLASS = RelocalizerOptions(matching='class')


def boxes_at(map_from_camera, noise_px=0.0, rng=None):
    boxes = boxes_of(ROOM, map_from_camera)
    return boxes if rng is None else boxes + rng.normal(0, noise_px, boxes.shape)


def fitted(poses, centers, sigma, rng=None, noise_px=0.0, stamps=None, shared=None,
           wrong_share=0.0, camera=CAMERA, deviations=EXACT):
    """The pose of the last camera in a map with these centres, and its covariance."""
    scenes = [make_scene(camera.normalize_bboxes(boxes_at(pose, noise_px, rng)), centers,
                         ROOM.shapes, np.eye(len(ROOM), dtype=bool), np.empty((0, 2), int), 0.05)
              for pose in poses]
    rig = make_rig(scenes, np.array([invert_transform(pose) @ poses[-1] for pose in poses]),
                   np.tile(VERTICAL_UNKNOWN, (len(poses), 1)), np.full(len(ROOM), sigma))
    start = invert_transform(poses[-1])
    found = refine_rig(rig, start[:3, :3].copy(), start[:3, 3].copy())
    stamps = np.arange(len(poses)) if stamps is None else np.array(stamps)
    return (invert_transform(make_transform(found.rotation, found.translation)),
            refined_covariance(rig, found.rotation, found.translation, stamps, shared,
                               wrong_share, camera_deviations=deviations))


def turning(count):
    return [MAP_FROM_CAMERA @ make_transform(Rotation.from_euler(
        'y', 2.0 * step, degrees=True).as_matrix(), np.zeros(3)) for step in range(count)]


def move_landmarks(rng, pose):
    return {'centers': ROOM.centers + rng.normal(0, 0.1, ROOM.centers.shape)}


def move_map(rng, pose):
    """About the camera: all landmarks share an error of 5 cm and 2 degrees."""
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(2.0), 3)).as_matrix()
    return {'centers': (ROOM.centers - pose[:3, 3]) @ turn.T + pose[:3, 3]
            + rng.normal(0, 0.05, 3)}


INTRINSICS = np.array([0.04, 0.02, 0.02, 0.02, 0.0, 0.0, 0.0])


def change_camera(rng, pose):
    focal, aspect, x, y = INTRINSICS[:4] * rng.normal(size=4)
    return {'camera': replace(
        CAMERA, fx=CAMERA.fx * np.exp(focal + aspect / 2), cx=CAMERA.cx + 500 * x,
        fy=CAMERA.fy * np.exp(focal - aspect / 2), cy=CAMERA.cy + 500 * y)}


# What is wrong, what the map or the camera states of it, and the greatest share without that.
STATED = {
    'landmarks': (move_landmarks, {'sigma': 0.1}, {'sigma': DEFAULT_SIGMA_M}, 0.6),
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
    assert within[0] >= 0.87
    assert within[1] <= most


def test_errors_of_landmarks_do_not_average_out_over_frames():
    one, four = (fitted([MAP_FROM_CAMERA] * count, ROOM.centers, 0.2)[1]
                 for count in (1, 4))
    np.testing.assert_allclose(four, one, rtol=0.1, atol=1e-6)


def test_the_covariance_holds_the_chance_that_an_object_is_wrong():
    def added_in(centers):
        return (fitted([MAP_FROM_CAMERA], centers, 0.02, wrong_share=0.07)[1]
                - fitted([MAP_FROM_CAMERA], centers, 0.02)[1])

    added = added_in(ROOM.centers)
    assert np.linalg.eigvalsh(added).min() > -1e-9
    assert np.trace(added[:3, :3]) > 0.01 * np.trace(
        fitted([MAP_FROM_CAMERA], ROOM.centers, 0.02)[1][:3, :3])
    displaced = ROOM.centers.copy()
    displaced[4] += [0.15, 0.1, 0.0]
    assert np.trace(added_in(displaced)[:3, :3]) > np.trace(added[:3, :3])


def test_odometry_is_a_walk_through_the_frames_in_order_of_time():
    """The reference first, last or between: steps add up outwards from it."""
    way = [MAP_FROM_CAMERA @ make_transform(np.eye(3), np.array([0.3 * step, 0.0, 0.0]))
           for step in (0, 1, 2, 1)]
    middle = fitted([*way[:3], way[1]], ROOM.centers, 0.0, stamps=[0, 1, 3, 2])[1]
    end = fitted([*way[:3], way[1]], ROOM.centers, 0.0, stamps=[0, 1, 2, 9])[1]
    assert np.trace(middle[:3, :3]) < np.trace(end[:3, :3])


def test_an_edge_is_as_uncertain_as_box_and_landmark():
    box, center = np.array([0.1, 0.0, 0.2, 0.1]), np.array([0.0, 0.0, 4.0])
    own = RELATIVE_DEVIATION * 0.3 + LEAST_DEVIATION
    assert edge_deviation(box, center, 0.0, np.eye(3), np.zeros(3)) == pytest.approx(own)
    seen = edge_deviation(box, center, 0.2, np.eye(3), np.zeros(3))
    assert seen == pytest.approx(np.hypot(own, 0.05))


def with_sigma(sigma):
    return replace(ROOM, details=(LandmarkDetails(position_sigma=sigma),) * len(ROOM))


def test_edges_off_by_the_error_of_the_map_fit_well():
    rng = np.random.default_rng(0)
    shaken = ROOM.centers + rng.normal(0, 0.08, ROOM.centers.shape)
    frame = Observation(CAMERA, Detections(boxes_at(MAP_FROM_CAMERA), ROOM.class_ids,
                                           np.ones(len(ROOM))))
    misfits = [Relocalizer(replace(one, centers=shaken), BY_CLASS).relocalize([frame])
               .hypotheses[0].support.misfit
               for one in (ROOM, with_sigma(DEFAULT_SIGMA_M), with_sigma(0.08))]
    assert misfits[0] == misfits[1]
    assert misfits[2] < 0.8 * misfits[1]


def test_a_map_states_what_its_landmarks_share():
    assert not ROOM.shared_sigmas.any()
    stated = replace(ROOM, details=(LandmarkDetails(shared_sigma=0.1, shared_sigma_deg=3.0),
                                    *[LandmarkDetails()] * (len(ROOM) - 1)))
    assert stated.shared_sigmas[0] == pytest.approx([0.1, np.radians(3.0)])
    assert not stated.shared_sigmas[1:].any()
    frame = Observation(CAMERA, Detections(boxes_at(MAP_FROM_CAMERA), ROOM.class_ids,
                                           np.ones(len(ROOM))))
    plain, shared = (Relocalizer(one, BY_CLASS).relocalize([frame]).covariance for one in (
        ROOM, replace(ROOM, details=(stated.details[0],) * len(ROOM))))
    # it does not shrink with the number of landmarks
    np.testing.assert_allclose(np.diag(shared - plain), [0.01] * 3 + [np.radians(3.0) ** 2] * 3,
                               rtol=0.1)
