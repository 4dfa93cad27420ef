# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that look alike, found in the map, and what tells them apart."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import Support
from cliploc_ros.core.acceptance.look_alikes import chance_distinct, look_alike
from cliploc_ros.core.acceptance.verdict import Evidence, refusal
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions

CLASSES = ('chair', 'cup', 'book', 'tv')


def make_map(centers, classes):
    ids = tuple(f'object_{row}' for row in range(len(centers)))
    return LandmarkMap('map', ids, ids, tuple(classes), np.asarray(centers, dtype=float),
                       np.full((len(centers), 3), 0.1), np.tile([0.0, 0.0, 0.0, 1.0],
                                                                (len(centers), 1)))


def two_rooms(turn_deg=0.0, missing=0, noise_m=0.0, seed=1):
    """Return a map of two equal rooms, and the pose in the second one that matches the origin."""
    rng = np.random.default_rng(seed)
    room = rng.uniform((-2, -2, 0), (2, 2, 2), (12, 3))
    move = make_transform(Rotation.from_euler('z', turn_deg, degrees=True).as_matrix(),
                          np.array([9.0, 3.0, 0.0]))
    twin = room @ move[:3, :3].T + move[:3, 3] + noise_m * rng.normal(size=room.shape)
    classes = [CLASSES[row % 4] for row in range(12)]
    return (make_map(np.concatenate([room, twin[missing:]]), classes + classes[missing:]), move)


@pytest.mark.parametrize('turn_deg', [0.0, 90.0, 180.0])
@pytest.mark.parametrize('missing', [0, 4])
def test_two_equal_rooms_look_alike_from_both(turn_deg, missing):
    rooms, move = two_rooms(turn_deg, missing, noise_m=0.03)
    here = np.eye(4)
    matched = np.arange(missing, 12)
    assert look_alike(rooms, here, matched, move[None]).tolist() == [True]
    assert look_alike(rooms, move, matched + 12 - missing, here[None]).tolist() == [True]


def test_other_poses_do_not_look_alike():
    rooms, move = two_rooms()
    flat = make_transform(Rotation.from_euler('x', 90, degrees=True).as_matrix(), move[:3, 3])
    beside = move.copy()
    beside[0, 3] += 1.0
    others = np.stack([move, beside, flat, make_transform(np.eye(3), np.array([50.0, 0, 0]))])
    found = look_alike(rooms, np.eye(4), np.arange(12), others)
    assert found.tolist() == [True, False, False, False]


def test_what_was_matched_must_look_alike_too():
    """Half a room has a twin; the camera saw the other half."""
    rooms, move = two_rooms(missing=6)
    assert look_alike(rooms, np.eye(4), np.arange(6, 12), move[None]).tolist() == [True]
    assert look_alike(rooms, np.eye(4), np.arange(6), move[None]).tolist() == [False]
    nothing = np.empty(0, dtype=np.int64)
    assert look_alike(rooms, np.eye(4), nothing, move[None]).tolist() == [False]


def test_the_same_objects_of_other_classes_do_not_look_alike():
    rooms, move = two_rooms()
    other = make_map(rooms.centers, [*rooms.class_ids[:12], *['bottle'] * 12])
    assert look_alike(other, np.eye(4), np.arange(12), move[None]).tolist() == [False]


def test_a_map_of_fewer_landmarks_than_are_compared():
    few = make_map([[1.0, 0, 0]], ['chair'])
    seen = np.array([0])
    assert look_alike(few, np.eye(4), seen, np.eye(4)[None]).tolist() == [False]
    assert look_alike(few, np.eye(4), seen, np.empty((0, 4, 4))).tolist() == []


def test_only_labels_tell_places_apart():
    own = Support(inliers=6, score=5.0, likeness=12.0)
    assert chance_distinct(own, []) == 1.0
    assert chance_distinct(own, [Support(inliers=3, score=2.0, likeness=12.0)]) == 0.5
    assert chance_distinct(own, [Support(inliers=3, score=2.0, likeness=0.0)]) > 0.99
    assert chance_distinct(own, [Support(likeness=1e9)]) < 1e-6


def test_a_refusal_names_the_other_place():
    evidence = Evidence(6, 0.9999, distinct=0.6, twin=(9.0, 3.0, 1.234))
    reason = refusal(evidence, RelocalizerOptions(min_confidence=0.99))
    assert reason.startswith('confidence 0.59 < 0.99; the place around x 9.00 y 3.00 z 1.23 m')
    assert 'turn the camera' in reason


def test_a_large_map_costs_little(record_property):
    rng = np.random.default_rng(0)
    centers = rng.uniform((0, 0, 0), (200, 200, 3), (100_000, 3))
    large = make_map(centers, rng.choice(CLASSES, len(centers)))
    start = time.process_time()
    large.prepare()
    prepared = time.process_time() - start
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, 3] = rng.uniform(20, 180, (12, 3))
    look_alike(large, poses[0], np.arange(12), poses[1:])
    start = time.process_time()
    for _ in range(10):
        look_alike(large, poses[0], np.arange(12), poses[1:])
    took = (time.process_time() - start) / 10
    record_property('figures', f'100,000 landmarks: prepared in {prepared:.2f} s, 11 other '
                               f'places compared in {1e3 * took:.1f} ms')
    assert prepared < 2.0
    assert took < 0.03
