# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several maps searched as one: floors that differ, floors that look alike, and many floors."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.joined_map import MAX_MAPS, join_maps, parts_of, place_of
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer, in_its_map
from cliploc_ros.errors import MapError

OPTIONS = RelocalizerOptions(matching='class')


def floor(name, seed=0):
    """Return twelve objects near the camera as a map of this name; seeds place them."""
    rng = np.random.default_rng(seed)
    return replace(make_room(), frame_id=name, centers=np.c_[
        rng.uniform(-1.2, 1.2, (12, 2)), rng.uniform(1.5, 4, 12)])


def join(*maps):
    return join_maps(maps, [f'{one.frame_id}.yaml' for one in maps])


def localize(landmark_map, seen, options=OPTIONS, similarities=None):
    found = Relocalizer(landmark_map, options).relocalize(
        [Observation(CAMERA, see_room(seen), similarities)])
    return in_its_map(found, landmark_map)


@pytest.mark.parametrize('place', [0, 1, 7])
def test_the_right_one_of_different_floors_is_accepted(place):
    """The pose is that of a search in this map alone, in the coordinate frame of this map."""
    maps = [floor(f'floor_{number}', seed=number) for number in range(8)]
    found, part = localize(join(*maps), maps[place])
    alone, _ = localize(maps[place], maps[place])
    assert found.accepted and part.landmark_map is maps[place]
    assert max(pose_error(found.map_from_camera, MAP_FROM_CAMERA)) < 1.0
    assert np.allclose(found.map_from_camera, alone.map_from_camera, atol=1e-6)
    assert np.diag(found.covariance) == pytest.approx(np.diag(alone.covariance), rel=0.02)
    assert {one.landmark for one in found.matches} == set(range(12))


@pytest.mark.parametrize('turned', [False, True])
def test_equal_floors_are_refused_and_both_are_named(turned):
    maps = [floor('floor_1'), floor('floor_2')]
    found, part = localize(join(*(maps[::-1] if turned else maps)), maps[0])
    assert not found.accepted
    assert found.reason.startswith(f'in {part.landmark_map.frame_id}: confidence 0.')
    assert 'floor_1' in found.reason and 'floor_2' in found.reason


def test_the_twin_of_a_place_is_given_in_its_own_map():
    """One map lacks an object: the pose in the other one is likelier, but its place has a twin."""
    whole = floor('floor_1')
    lacking = replace(whole.select(range(11)), frame_id='floor_2',
                      centers=whole.centers[:11] + np.array([500.0, -3.0, 0.0]))
    found, _ = localize(join(lacking, whole), whole)
    assert not found.accepted
    assert 'in floor_1: ' in found.reason and 'floor_2' in found.reason
    assert '(500.' in found.reason


def test_many_floors_get_equal_shares_of_the_candidates():
    """Twenty equal floors, one hypothesis for each of them at least: none is left out."""
    maps = [floor(f'floor_{number}') for number in range(20)]
    rows = np.full((12, 12), 0.2) + 0.2 * np.eye(12)
    found, _ = localize(join(*maps), maps[0], RelocalizerOptions(), np.tile(rows, 20))
    assert not found.accepted and found.reason.count('in floor_') == 2, found.reason
    assert found.confidence < 0.3


def test_a_search_too_short_for_all_maps_is_refused():
    """The least number of samples is that of each map: one map alone has enough of them."""
    maps = [floor(f'floor_{number}', seed=number) for number in range(10)]
    rows = np.full((12, 12), 0.2) + 0.2 * np.eye(12)
    short = RelocalizerOptions(iterations=600)
    found, _ = localize(maps[0], maps[0], short, rows)
    assert found.accepted
    found, _ = localize(join(*maps), maps[0], short, np.tile(rows, 10))
    assert not found.accepted and 'in floor_0: search' in found.reason


def test_a_joined_map_keeps_what_its_maps_hold():
    plain, detailed = floor('hall'), floor('attic', seed=3)
    detailed = replace(detailed, details=tuple(
        LandmarkDetails(class_weights=(('z', 1.0), (name, 1.0))) for name in detailed.class_ids))
    both = join(plain, detailed)
    assert len(both) == 24 and both.frame_id == 'hall'
    assert both.landmark_ids[:1] == ('hall/thing_0',) and len(set(both.landmark_ids)) == 24
    assert np.array_equal(both.centers[:12], plain.centers)
    assert both.classes.sizes_of(both.classes.classes_of(['z'])).tolist() == [12]
    assert [part.first for part in parts_of(both)] == [0, 12]
    apart = both.centers[12:, 0].min() - both.centers[:12, 0].max()
    assert apart >= 100_000 * both.semi_axes.max()
    for part in parts_of(both):
        pose = MAP_FROM_CAMERA.copy()
        pose[:3, 3] += part.shift
        place = place_of(both, pose)
        assert place.part is part and place.name == part.landmark_map.frame_id
        assert np.allclose(place.map_from_camera, MAP_FROM_CAMERA, atol=1e-6)


def test_maps_that_cannot_be_told_apart_are_refused():
    with pytest.raises(MapError, match="frame_id 'map'"):
        join(floor('map'), floor('hall'), floor('map', seed=1))
    with pytest.raises(MapError, match=f'at most {MAX_MAPS}'):
        join(*[floor(f'floor_{number}') for number in range(MAX_MAPS + 1)])
