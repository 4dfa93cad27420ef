# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Large maps: culled landmarks would not have counted, and a hypothesis costs little more."""


import numpy as np
import pytest
from reference import sample_pose, verify
from scene import unit_rows

from cliploc_ros.core.geometry.ellipsoid import (
    Poses,
    ellipse_bboxes,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import SAME_PLACE, invert_transform, make_transform
from cliploc_ros.core.map.culling import make_groups, sort_landmarks, visible_members
from cliploc_ros.core.search.scene import Scene, make_scene
from cliploc_ros.core.search.strategies import Leaders, draw_ransac, search_samples

HERE = Poses(np.eye(3)[None], np.zeros((1, 3)))


def own_classes(class_ids):
    """Return landmarks of one class each, in the format of ClassIndex.members."""
    return np.column_stack([np.arange(len(class_ids)), class_ids])


def make_storey(count, seed=0, classes=40, by_class=True) -> Scene:
    """Return a map with a landmark per four square metres, and up to twelve boxes in a frame."""
    rng, side = np.random.default_rng(seed), np.sqrt(4.0 * count)
    centers = np.c_[rng.uniform(0, side, (count, 2)), rng.uniform(0, 2, count)]
    quats = unit_rows(rng.normal(size=(count, 4)))
    shapes = shape_matrices(rng.uniform(0.05, 0.4, (count, 3)), quats)
    class_ids = rng.integers(0, classes, count)
    camera = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
                            np.array([0.4 * side, 0.5 * side, 1.2]))
    boxes = ellipse_bboxes(project_ellipsoids(invert_transform(camera), centers, shapes))
    near = np.linalg.norm(centers - camera[:3, 3], axis=1) < 12
    seen = np.nonzero((np.abs(boxes) < 0.6).all(axis=1) & near)[0][:12]
    potential = class_ids[seen][:, None] == class_ids[None]
    pairs = np.array([(row, landmark) for row, truth in enumerate(seen)
                      for landmark in (truth, *rng.choice(np.nonzero(potential[row])[0], 2))])
    noisy = boxes[seen] + rng.normal(0, 0.004, (len(seen), 4))
    if not by_class:
        return make_scene(noisy, centers, shapes, potential, pairs, 0.2)
    single = pairs[~potential[tuple(pairs.T)]]  # none
    return make_scene(noisy, centers, shapes, single, pairs, 0.2,
                      sort_landmarks(centers, shapes, own_classes(class_ids)), class_ids[seen])


@pytest.mark.parametrize('seed', range(3))
def test_nothing_that_counts_is_left_out(seed):
    scene, plain = make_storey(5_000, seed), make_storey(5_000, seed, by_class=False)
    samples = draw_ransac(scene.pairs, 300, np.random.default_rng(seed))
    samples[::7] = -1  # a sampler that found none
    scores = []
    for sample in samples:
        pose = sample_pose(plain, sample)[0] if sample[0] >= 0 else None
        if pose is None:
            scores.append(-1.0)
            continue
        expected, found = verify(plain, *pose), verify(scene, *pose)
        scores.append(expected.score)
        assert found.score == expected.score
        assert (found.landmarks == expected.landmarks).all()
    leaders = Leaders.none_yet(len(samples))
    *_, progress = search_samples(scene, samples, leaders)
    assert progress.tried == np.count_nonzero(samples[:, 0] >= 0)
    ranked = leaders.ranked()
    assert len(ranked) > 50
    poses = [invert_transform(make_transform(leaders.rotations[row], leaders.translations[row]))
             for row in ranked]
    assert SAME_PLACE.distinct(np.array(poses)) == [*range(len(ranked))]
    for row in ranked:
        assert leaders.scores[row] == pytest.approx(scores[leaders.iterations[row] - 1],
                                                    abs=1e-9)


@pytest.mark.parametrize('classes', [1, 7, 1_000])
def test_a_frame_sees_what_its_boxes_can_show_and_little_more(rng, classes):
    centers = rng.uniform(-50, 50, (1_000, 3))
    shapes = np.zeros((1_000, 6))
    shapes[:, [0, 3, 5]] = 4.0
    class_ids = rng.permutation(np.arange(1_000) % classes)
    landmarks = sort_landmarks(centers, shapes, own_classes(class_ids))
    assert (np.sort(landmarks.numbers) == np.arange(1_000)).all()
    assert (landmarks.landmarks[:, :3] == centers[landmarks.numbers]).all()
    assert landmarks.radii == pytest.approx(2.0)
    steps = np.linalg.norm(np.diff(landmarks.landmarks[:, :3], axis=0), axis=1)
    assert np.median(steps) < 20  # neighbours have near rows
    groups = make_groups(landmarks, np.array([-1, 0]),
                         np.array([[5.0, 5, 1, 1], [0, 0, 0.3, 0.2]]), 0.02)
    assert groups.detections.tolist() == [1]
    members = landmarks.numbers[groups.members[:, 0]]
    assert set(members) == set(np.nonzero(class_ids == 0)[0])
    seen = np.empty((2, len(members)), dtype=np.int64)
    count = visible_members(groups, HERE, 0, seen)
    visible = {int(members[member]) for member in seen[0, :count]}
    outlines = project_ellipsoids(np.eye(4), centers, shapes)
    overlap = ((np.abs(outlines[:, 0]) < 0.3) & (np.abs(outlines[:, 1]) < 0.2)
               & (class_ids == 0) & (centers[:, 2] < groups.spheres[0, 4]))
    assert overlap.any() or classes > 7
    assert set(np.nonzero(overlap)[0]) <= visible
    assert len(visible) <= 3 * overlap.sum() + 3


