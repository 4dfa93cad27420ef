# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated worlds: what makes each kind, its images and its map, and what is found in them."""

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import is_rigid
from studies.acceptance import fit
from studies.acceptance.places import MODES, Simulated
from studies.reports import judged_of
from studies.worlds.cameras import GROUP_SIZE
from studies.worlds.places import KINDS
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
    likely, right = judged_of(fit.answers([one for one in here if one.kind == 'room'],
                                          calibrations))
    assert np.array_equal(likely, fit.outcomes(rooms, calibrations['room'])[0])
    elsewhere = judged_of(fit.answers([one for one in searched if one.case.is_elsewhere],
                                      calibrations))[0]
    assert likely[right].mean() > elsewhere.mean()
