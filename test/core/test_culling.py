# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Large maps: what is left out would not have counted, and a hypothesis costs little more."""

import time

import numpy as np
import pytest

from cliploc_ros.core.culling import make_tree, morton_order, visible_ranges
from cliploc_ros.core.ellipsoid import ellipse_bboxes, project_ellipsoids, shape_matrices
from cliploc_ros.core.sampling import draw_ransac
from cliploc_ros.core.scoring import Scene, Workspace, make_scene, sample_pose, verify
from cliploc_ros.core.screening import set_up
from cliploc_ros.core.search import Leaders, search_samples
from cliploc_ros.core.transforms import invert_transform, make_transform


def make_storey(count, seed=0, classes=40) -> Scene:
    """A landmark a four square metres; up to twelve boxes, each with all of its class."""
    rng, side = np.random.default_rng(seed), np.sqrt(4.0 * count)
    centers = np.c_[rng.uniform(0, side, (count, 2)), rng.uniform(0, 2, count)]
    quats = rng.normal(size=(count, 4))
    shapes = shape_matrices(rng.uniform(0.05, 0.4, (count, 3)),
                            quats / np.linalg.norm(quats, axis=1, keepdims=True))
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
    return make_scene(noisy, centers, shapes, potential, pairs, 0.2)


@pytest.mark.parametrize('seed', range(3))
def test_nothing_that_counts_is_left_out(seed):
    scene = make_storey(5_000, seed)
    samples = draw_ransac(scene.pairs, 300, np.random.default_rng(seed))
    workspace, scores = Workspace.allocate(len(scene.bearings)), []
    for sample in samples:
        which, _ = sample_pose(scene, sample, workspace)
        scores.append(-1.0 if which < 0 else verify(
            scene, workspace.rotations[which], workspace.translations[which], workspace))
    leaders = Leaders.none_yet(len(samples))
    list(search_samples(scene, samples, leaders))
    ranked = leaders.ranked()
    assert len(ranked) > 50
    for row in ranked:
        assert leaders.scores[row] == pytest.approx(scores[leaders.iterations[row] - 1],
                                                    abs=1e-9)


def test_every_landmark_has_one_leaf_and_neighbours_stand_together(rng):
    landmarks = np.zeros((1_000, 9))
    landmarks[:, :3] = rng.uniform(-50, 50, (1_000, 3))
    landmarks[:, [3, 6, 8]] = 0.01
    order = morton_order(landmarks[:, :3])
    assert (np.sort(order) == np.arange(1_000)).all()
    landmarks = landmarks[order]
    steps = np.linalg.norm(np.diff(landmarks[:, :3], axis=0), axis=1)
    assert np.median(steps) < 20
    boxes = np.array([[0.0, 0.0, 0.3, 0.2]])
    tree, reaches = make_tree(landmarks, np.full(1_000, 0.01), boxes, 0.2)
    rows = tree.rows[tree.leaves]
    assert (rows[:, 1] > rows[:, 0]).all()
    assert (np.concatenate([np.arange(*row[:2]) for row in rows]) == np.arange(1_000)).all()
    ranges = np.empty((len(rows), 2), dtype=np.int64)
    runs = visible_ranges(*tree, np.eye(3)[None], np.zeros((1, 3)), 0, ranges)
    visible = np.concatenate([np.arange(*run) for run in ranges[:runs]])
    seen = project_ellipsoids(np.eye(4), landmarks[:, :3], landmarks[:, 3:])
    overlap = ((np.abs(seen[:, 0]) < 0.3) & (np.abs(seen[:, 1]) < 0.2)
               & (np.linalg.norm(landmarks[:, :3], axis=1) < reaches))
    assert set(np.nonzero(overlap)[0]) <= set(visible)
    assert len(visible) < 500


def test_far_landmarks_appear_too_small():
    """The reach against the outlines of spheres."""
    radius, box_axes, iou_threshold = 0.3, 0.02, 0.2
    landmark = np.zeros((100, 9))
    landmark[:, [3, 6, 8]] = radius**2 / 3  # whose trace bounds the greatest semi-axis
    _, reaches = make_tree(landmark, np.full(100, box_axes), np.array([[0.0, 0, 0.4, 0.3]]),
                           iou_threshold)
    for x in (-0.5, 0.0, 0.5):
        direction = np.array([x, 0.2, 1.0])
        center = direction / np.linalg.norm(direction) * reaches[0] * 1.001
        shape = np.array([radius**2, 0, 0, radius**2, 0, radius**2])
        exx, exy, eyy = project_ellipsoids(np.eye(4), center[None], shape[None])[0, 2:]
        assert np.sqrt(exx * eyy - exy * exy) < iou_threshold * box_axes


def test_a_hypothesis_costs_little_more_in_a_large_map():
    times_us = {}
    for count in (100, 100_000):
        scene = make_storey(count)
        samples = draw_ransac(scene.pairs, 4_000, np.random.default_rng(0))
        least = np.inf
        for _ in range(5):
            start = time.perf_counter()
            list(search_samples(scene, samples, Leaders.none_yet()))
            whole = time.perf_counter() - start
            start = time.perf_counter()
            set_up(scene)
            least = min(least, whole - (time.perf_counter() - start))
        times_us[count] = 1e6 * least / len(samples)
    print(f'\na sample among 100 landmarks {times_us[100]:.1f} us, among 100,000 '
          f'{times_us[100_000]:.1f} us')
    assert times_us[100_000] < 5 * times_us[100]
