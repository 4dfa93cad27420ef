# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which correspondences can hold at once, and the search that tries no others."""

from math import comb

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, see_room

from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.search.scene import make_scene
from cliploc_ros.core.search.strategies import (
    FARTHEST,
    NEAREST,
    Leaders,
    _depths,
    _distance_range,
    compatible_pairs,
    enumerate_compatible_triples,
    search_exhaustively,
    search_progressively,
)


def scene_of(room, rows=slice(None)):
    seen = see_room(room)
    potential = (np.array(seen.class_ids)[:, None] == np.array(room.class_ids)[None])[rows]
    return make_scene(CAMERA.normalize_bboxes(seen.bboxes_xyxy[rows]), room.centers, room.shapes,
                      potential, np.argwhere(potential), 0.2)


def test_the_range_holds_every_distance(rng):
    for _ in range(200):
        a, b = rng.uniform(1, 10, 2)
        cosine = rng.uniform(0.3, 1.0)
        low, high = _distance_range(a, b, cosine)
        u, v = np.meshgrid(np.linspace(NEAREST, FARTHEST, 60) * a,
                           np.linspace(NEAREST, FARTHEST, 60) * b)
        distances = np.sqrt(np.maximum(0, u**2 + v**2 - 2 * u * v * cosine))
        assert low <= distances.min() + 1e-9
        assert high == pytest.approx(distances.max())
        assert low == pytest.approx(distances.min(), abs=0.05 * max(a, b))


def test_what_is_true_is_compatible_and_much_else_is_not(room):
    scene = scene_of(room)
    compatible = compatible_pairs(scene)
    true = np.nonzero(scene.pairs[:, 0] == scene.pairs[:, 1])[0]
    assert len(true) == len(room)
    assert (compatible == compatible.T).all()
    among = compatible[np.ix_(true, true)]
    assert among.sum() == len(true) * (len(true) - 1)
    for first, second in np.argwhere(compatible):
        assert (scene.pairs[first] != scene.pairs[second]).all()
    assert compatible.mean() < 0.8


def test_all_that_is_within_reach_is_found(room, rng):
    """Landmarks along a corridor: the sweep leaves out only what no distance allows."""
    seen = see_room(room)
    centers = rng.uniform(-1.0, 1.0, (60, 3)) * [40.0, 3.0, 3.0]
    pairs = np.column_stack([rng.integers(len(seen), size=200), rng.integers(60, size=200)])
    scene = make_scene(CAMERA.normalize_bboxes(seen.bboxes_xyxy), centers,
                       np.repeat(room.shapes, 5, axis=0), pairs, pairs, 0.2)
    depths, bearings = _depths(scene), scene.bearings[pairs[:, 0]]
    expected = np.zeros((200, 200), dtype=bool)
    for i, j in np.argwhere((pairs[:, None] != pairs[None]).all(axis=2)):
        low, high = _distance_range(depths[i], depths[j], bearings[i] @ bearings[j])
        expected[i, j] = low <= np.linalg.norm(centers[pairs[i, 1]] - centers[pairs[j, 1]]) <= high
    assert 100 < expected.sum() < 0.5 * expected.size
    np.testing.assert_array_equal(compatible_pairs(scene), expected)


@pytest.mark.parametrize('size', [1, 7, 1024])
def test_every_compatible_triple_comes_once_and_in_order(rng, size):
    compatible = np.triu(rng.random((25, 25)) < 0.4, 1)
    compatible |= compatible.T
    cursor, found = np.array([2, 0, 1]), []
    while cursor[0] < len(compatible):
        block = np.full((size, 3), -1)
        count = enumerate_compatible_triples(compatible, cursor, block)
        found += map(tuple, block[:count].tolist())
    expected = [(a, b, newest) for newest in range(25) for a in range(newest)
                for b in range(a + 1, newest)
                if compatible[newest, a] and compatible[newest, b] and compatible[a, b]]
    assert found == expected
    assert len(found) > 50


def test_it_ends_where_the_exhaustive_search_ends(room):
    scene = scene_of(room)
    whole, gated = Leaders.none_yet(), Leaders.none_yet()
    *_, all_tried = search_exhaustively(scene, whole)
    *_, progress = search_progressively(scene, compatible_pairs(scene), gated)
    assert (progress.coverage, progress.reach) == (1.0, len(scene.pairs))
    assert progress.tried < 0.8 * all_tried.tried
    print(f'\n{progress.tried} of {all_tried.tried} samples tried')
    best = [leaders.ranked()[0] for leaders in (whole, gated)]
    assert gated.scores[best[1]] == pytest.approx(whole.scores[best[0]], rel=1e-6)
    pose = invert_transform(make_transform(gated.rotations[best[1]], gated.translations[best[1]]))
    assert pose_error(pose, MAP_FROM_CAMERA)[0] < 1e-2


def test_the_first_candidates_are_done_before_the_next(room):
    scene = scene_of(room, slice(0, 9))
    everything = np.ones((len(scene.pairs),) * 2, dtype=bool)
    steps = list(search_progressively(scene, everything, Leaders.none_yet()))
    reaches = [step.reach for step in steps]
    assert reaches == sorted(reaches)
    count = len(scene.pairs)
    for step in steps[:-1]:
        assert step.coverage == pytest.approx(comb(step.reach, 3) / comb(count, 3))
    assert steps[-1].coverage == 1.0
    assert steps[-1].tried == comb(count, 3)
