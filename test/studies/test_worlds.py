# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated worlds: what makes each kind, its images and its map, and what is found in them."""

import numpy as np
import pytest

from cliploc_ros.core.geometry.transforms import is_rigid
from studies.acceptance import fit
from studies.acceptance.places import MODES, Simulated
from studies.worlds import compare
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
