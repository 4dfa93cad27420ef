# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places that look alike: finding them in the map, and distinguishing them."""


import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, SEEN, doubled_room, map_of, rigid

from cliploc_ros.core.acceptance.look_alikes import find_twins
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.pairs import find_repeats
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer

CLASSES = ('chair', 'cup', 'book', 'tv')
NOWHERE = np.empty((0, 4, 4))


def moved(points, move):
    return points @ move[:3, :3].T + move[:3, 3]


def shift_along(x_m):
    return np.array([x_m, 0.0, 0.0])


def one_room(seed=1, count=12):
    rng = np.random.default_rng(seed)
    return rng.uniform((-2, -2, 0), (2, 2, 2), (count, 3)), [CLASSES[row % 4]
                                                            for row in range(count)]


def two_rooms(turn_deg=0.0, missing=0, noise_m=0.0, seed=1):
    """Return a map of two equal rooms, and the pose in the second room that matches the origin."""
    room, classes = one_room(seed)
    move = rigid((9, 3, 0), degrees=turn_deg)
    twin = moved(room, move) + noise_m * np.random.default_rng(seed).normal(size=room.shape)
    return map_of(classes + classes[missing:], np.concatenate([room, twin[missing:]]), 0.1), move


@pytest.mark.parametrize('turn_deg', [0.0, 90.0, 180.0, 243.0])
@pytest.mark.parametrize('missing', [0, 4])
def test_two_equal_rooms_are_twins_that_no_search_met(turn_deg, missing):
    rooms, move = two_rooms(turn_deg, missing, noise_m=0.03)
    here, matched = np.eye(4), np.arange(missing, 12)
    for pose, seen, twin in ((here, matched, move), (move, matched + 12 - missing, here)):
        found = find_twins(rooms, pose, seen, NOWHERE)[0]
        distance_m, angle_deg = pose_error(found[0], twin)
        assert distance_m < 0.1
        assert angle_deg < 3.0


@pytest.mark.parametrize('distance_m', [9.0, 5.0, 0.0])
def test_a_room_nearby_and_the_other_half_of_a_symmetric_hall_are_places_of_their_own(distance_m):
    room, classes = one_room()
    twin = moved(room, rigid((distance_m, 0, 0), degrees=0.0 if distance_m else 180.0))
    between = rigid((min(distance_m, 5.0) / 2.0, 0.0, 1.0))
    alike = find_twins(map_of(classes * 2, np.concatenate([room, twin]), 0.1), between,
                       np.arange(12), NOWHERE)[1]
    assert alike.are_rooms()[0]
    count = len(alike.landmarks)
    assert alike.are_rooms(count + 1.0)[0] == (distance_m == 9.0), 'a half with too few landmarks'
    chance = np.where(np.arange(count) < count // 2, alike.landmarks[0], alike.landmarks)
    assert not alike._replace(others=chance[None], found=alike.found[:1]).are_rooms()[0], \
        'the move takes half of the landmarks to one'


def test_a_room_of_its_own_has_no_twin():
    rooms, move = two_rooms()
    other = map_of([*rooms.class_ids[:12], *['bottle'] * 12], rooms.centers, 0.1)
    assert len(find_twins(other, np.eye(4), np.arange(12), move[None])[0]) == 0


def test_the_bays_of_a_corridor_are_twins():
    bay, classes = one_room(count=6)
    corridor = map_of(classes * 5, np.concatenate(
        [bay + shift_along(4.5 * number) for number in range(5)]), 0.1)
    found = find_twins(corridor, rigid((9, 0, 1)), np.arange(12, 18), NOWHERE)[0]
    assert len(found) == 3
    shifts = found[:, :3, 3] - [9, 0, 1]
    assert np.allclose(shifts[:, 0] / 4.5, np.round(shifts[:, 0] / 4.5), atol=1e-6)
    assert (np.abs(shifts[:, 0]) > 1.0).all()
    assert np.allclose(shifts[:, 1:], 0.0, atol=1e-6)


@pytest.mark.parametrize(('least_m', 'is_accepted'), [(-np.inf, False), (-1.0, True)])
def test_a_twin_where_no_camera_can_be_counts_not(least_m, is_accepted):
    """The other room is 5 m further down."""
    room, seen = doubled_room(np.array([9.0, 0.0, -5.0])), SEEN
    options = RelocalizerOptions(matching='class', height_range_m=(least_m, 1.0))
    found = Relocalizer(room, options).relocalize([Observation(CAMERA, seen)])
    assert found.accepted == is_accepted


PILE = np.array([[0.0, 0.0, 0.2 * row] for row in range(6)])
RING = 3.5 * np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.arange(6) * np.pi / 3])


@pytest.mark.parametrize(('place', 'turn_deg'), [(PILE, 0.0), (RING, 90.0)])
def test_poses_that_a_search_met_are_compared_too(place, turn_deg):
    """Landmarks above each other have no pairs with a direction; distant ones have no pairs."""
    there = rigid((20, 0, 0), degrees=turn_deg)
    places = map_of('abcdef' * 2, np.concatenate([place, moved(place, there)]), 0.1)
    assert len(find_repeats(places.pairs, np.arange(6)).votes) == 0
    met = rigid((20.2, 0.1, 0.1), degrees=turn_deg)
    found = find_twins(places, np.eye(4), np.arange(6), met[None])[0]
    assert np.allclose(found[0], there, atol=1e-6)
    lying = rigid(met[:3, 3], 'x', 90.0)
    assert len(find_twins(places, np.eye(4), np.arange(6), lying[None])[0]) == 0


def test_what_was_matched_must_look_alike_too():
    """Part of a room has a twin; the camera saw the other part, where objects may have moved."""
    for missing, is_twin in ((7, False), (6, True)):
        rooms, move = two_rooms(missing=missing)
        seen = find_twins(rooms, np.eye(4), np.arange(missing, 12), NOWHERE)[0]
        assert pose_error(seen[0], move)[0] < 0.1
        unseen = find_twins(rooms, np.eye(4), np.arange(missing), move[None])[0]
        assert len(unseen) == is_twin


def seen(differing=0):
    """Return the observation in the first of two rooms with some different labels."""
    similarities = np.full((12, 24), 0.2, dtype=np.float32)
    similarities[np.arange(12), np.arange(12)] = 0.3
    similarities[np.arange(differing, 12), np.arange(12 + differing, 24)] = 0.3
    return Observation(CAMERA, SEEN, similarities)


def test_two_identical_rooms_are_refused_until_labels_differ():
    relocalizer = Relocalizer(doubled_room(shift_along(10.0)),
                              RelocalizerOptions(min_confidence=0.99))
    found = [relocalizer.relocalize([seen(differing)]) for differing in (0, 1, 2, 6)]
    assert [result.accepted for result in found] == [False, False, False, True]
    first = found[0]
    assert first.evidence.distinct == pytest.approx(0.5, abs=0.01)
    places = sorted([first.evidence.place[0], first.evidence.twin[0]])
    assert places == pytest.approx([0.3, 10.3], abs=0.05)
    for x_m in places:
        assert f'({x_m:.1f}, ' in first.reason
    distinct = [result.evidence.distinct for result in found]
    assert distinct == sorted(distinct)
    for result in found[1:]:
        assert pose_error(result.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05


@pytest.mark.parametrize('offset_m', [0.0, 0.01])
def test_a_room_with_every_landmark_doubled_is_still_accepted(offset_m):
    """Duplicates count as one object, and a pose is not a rival of itself."""
    doubled = doubled_room(shift_along(offset_m))
    assert doubled.objects.max() == 11
    found = Relocalizer(doubled, RelocalizerOptions()).relocalize([seen()])
    assert found.accepted, found.reason
    assert found.evidence.inliers == 12 and found.evidence.twin is None
    assert pose_error(found.map_from_camera, MAP_FROM_CAMERA)[0] < 0.05


def test_duplicates_are_of_one_class_and_overlap():
    boxes = map_of(['book', 'book', 'book', 'book', 'cup'],
                   [[0, 0, 0], [0.05, 0, 0], [0.12, 0, 0], [1, 0, 0], [0, 0, 0]], 0.1)
    assert boxes.objects.tolist() == [0, 0, 0, 1, 2], 'duplicates of duplicates'
    beside = map_of(['book', 'book'], [[0, 0, 0], [0.2, 0, 0]], 0.1)
    assert beside.objects.tolist() == [0, 1]
