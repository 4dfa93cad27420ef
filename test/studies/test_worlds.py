# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated worlds: what makes each kind, its images and its map, and what is found in them."""

import numpy as np
import pytest

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.core.options import RelocalizerOptions
from studies.acceptance import fit
from studies.acceptance.places import FIVE, MODES, ONE, Simulated
from studies.acceptance.searches import Task, search
from studies.worlds import compare
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.places import KINDS, denser
from studies.worlds.surveyor import MapErrors, survey
from studies.worlds.things import make_objects
from studies.worlds.world import make_world

pytestmark = pytest.mark.full


@pytest.mark.parametrize('kind', KINDS)
def test_worlds_are_reproducible_and_sound(kind):
    world, again, other = make_world(kind, 3), make_world(kind, 3), make_world(kind, 4)
    assert len(world.queries) == 4 * GROUP_SIZE
    assert set(world.groups) == {0, 1, 2, 3}
    for one, its_twin in zip(world.queries, again.queries, strict=True):
        assert is_rigid(one.map_from_camera)
        detections = one.observation.detections
        assert np.array_equal(detections.bboxes_xyxy, its_twin.observation.detections.bboxes_xyxy)
        assert np.array_equal(one.observation.similarities, its_twin.observation.similarities)
        assert one.observation.similarities.shape == (len(detections), len(world.landmark_map))
        assert (detections.bboxes_xyxy >= 0).all()
    assert not np.array_equal(world.queries[0].map_from_camera, other.queries[0].map_from_camera)


def test_a_denser_place_has_all_its_things_and_more_of_other_classes():
    place = KINDS['room'](np.random.default_rng(3))
    more = denser(place, 3, np.random.default_rng(4))
    count = len(place.things)
    assert list(more.things[:count]) == list(place.things)
    assert {one.name.partition('#')[2] for one in more.things[count:]} == {'2', '3'}
    assert all(0.0 <= one.x <= place.width and 0.0 <= one.y <= place.depth
               for one in more.things[count:])
    assert len(make_world('room', 3, density=3).landmark_map) > len(
        make_world('room', 3).landmark_map)


def test_a_map_without_errors_has_each_object_in_its_place():
    rng = np.random.default_rng(1)
    objects = make_objects(KINDS['office'](rng).things, rng)
    found = survey(objects, MapErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False), rng)
    assert np.array_equal(found.objects, np.arange(len(objects.class_ids)))
    assert np.array_equal(found.landmark_map.centers, objects.centers)
    assert found.landmark_map.class_ids == objects.class_ids


def test_two_rooms_look_alike():
    things = KINDS['two rooms'](np.random.default_rng(5)).things
    looks = [(one.name, one.model) for one in things]
    assert sum(looks.count(one) == 2 for one in looks) > 0.7 * len(looks)


def test_simulation_is_like_the_recordings(record_property):
    """Each figure lies between those of the recordings, see doc/trust.md."""
    worlds = [make_world(kind, seed) for kind in ('room', 'office') for seed in range(10)]
    looks = [compare.look(one.landmark_map, query) for one in worlds for query in one.queries]
    record_property('figures', f'rooms and offices: {compare.describe(looks)}')
    ious = np.concatenate([one.ious for one in looks])
    errors = np.abs(np.concatenate([one.edge_errors for one in looks]))
    ranks = np.concatenate([one.ranks for one in looks])
    explained = len(ious) / sum(one.boxes for one in looks)
    assert 0.64 < np.median(ious) < 0.85  # .64 to .85
    assert 0.034 < np.nanmedian(errors) < 0.095  # .034 to .094
    assert 0.52 < (ranks < 1).mean() < 0.91  # .52 to .91
    assert 0.71 < explained < 0.96  # .71 to .96


def test_several_images_find_more_right_poses():
    options = RelocalizerOptions(min_confidence=0.99, crops='all')
    fused, alone = ([one for seed in range(3)
                     for one in search(Task(Simulated('room', seed), mode, options, seed=seed))]
                    for mode in (FIVE, ONE))
    assert len(fused) == len(alone) == 3 * 4
    assert sum(one.right for one in fused) > sum(one.right for one in alone)
    assert not [one for one in (*fused, *alone) if one.accepted and not one.right]


def test_a_fit_judges_each_kind_by_the_others(record_property):
    searched = [one for kind in ('room', 'shop') for one in fit.search_world(Simulated(kind, 5))]
    here = [one for one in searched if not one.case.is_elsewhere]
    assert {one.mode for one in here} == set(MODES)
    for one in searched:
        assert (one.case.setting.vertical > 0.0) == ('vertical' in one.mode)
        assert not (one.case.is_elsewhere and one.case.right.any())
    calibrations = fit.cross_fitted(searched)
    assert calibrations['room'] != calibrations['shop']
    rooms = [one.case for one in here if one.kind == 'room']
    likely, right = fit.judged([one for one in here if one.kind == 'room'], calibrations)
    assert np.array_equal(likely, fit.outcomes(rooms, calibrations['room'])[0])
    elsewhere = fit.judged([one for one in searched if one.case.is_elsewhere], calibrations)[0]
    assert likely[right].mean() > elsewhere.mean()


def test_depth_is_fitted_alone_and_changes_nothing_else():
    plain, measured = (Simulated('room', 5, has_depth).load() for has_depth in (False, True))
    for one, other in zip(plain.frames, measured.frames, strict=True):
        assert one.observation.depths is None
        np.testing.assert_array_equal(one.observation.detections.bboxes_xyxy,
                                      other.observation.detections.bboxes_xyxy)
    assert np.isfinite(np.concatenate([one.observation.depths for one in measured.frames])).any()
    fitted = fit.fit([one.case for one in fit.search_world(Simulated('room', 5, True))], 'depth')
    assert fitted.objects.depth != CALIBRATION.objects.depth
    assert fitted.objects._replace(depth=CALIBRATION.objects.depth) == CALIBRATION.objects
