# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search kernel against the plain reference."""

from math import radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import sample_pose, score, verify
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.geometry.ellipse import ellipse_iou, iou_bound
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.search.scene import Constraint, make_scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond
from cliploc_ros.core.search.strategies import (
    Leaders,
    compatible_pairs,
    draw_ransac,
    search_exhaustively,
    search_progressively,
    search_samples,
)

UP_IN_MAP = np.array([0.0, -1.0, 0.0])
UP_IN_CAMERA = MAP_FROM_CAMERA[:3, :3].T @ UP_IN_MAP
HEIGHT = float(MAP_FROM_CAMERA[:3, 3] @ UP_IN_MAP)


def upright(**known):
    return Constraint(tuple(UP_IN_CAMERA), tuple(UP_IN_MAP), **known)


@pytest.fixture(scope='module')
def potential():
    room = make_room()
    seen = see_room(room)
    return np.array(seen.class_ids)[:, None] == np.array(room.class_ids)[None]


@pytest.fixture(scope='module')
def scene(potential):
    room = make_room()
    seen = see_room(room)
    rng = np.random.default_rng(3)
    boxes = CAMERA.normalize_bboxes(seen.bboxes_xyxy + rng.normal(0, 4, (len(room), 4)))
    return make_scene(boxes, room.centers, room.shapes, potential, np.argwhere(potential), 0.2)


def test_it_chooses_and_scores_as_the_reference(scene, potential, rng):
    (candidates, constraint, targets, memory, poses, overlaps), compared = set_up(scene), 0
    samples = draw_ransac(scene.pairs, 2_000, rng)
    for number, sample in enumerate(samples):
        which = make_hypothesis(candidates, constraint, memory, poses, samples, number, 0.0)
        expected, total = sample_pose(scene, sample)
        assert (which >= 0) == (expected is not None)
        if expected is None:
            continue
        compared += 1
        assert total >= 0.0
        assert (poses.rotations[which] == expected[0]).all()
        assert (poses.translations[which] == expected[1]).all()
        plain, landmarks = score(scene, potential, expected)
        verified = verify(scene, *expected)
        assert verified.score == pytest.approx(plain, abs=1e-12)
        assert (verified.landmarks == landmarks).all()
        for floor in (-1.0, 0.5 * plain, plain - 1e-6, plain + 1e-6, plain + 1.0):
            found = verify_beyond(targets, poses, which, overlaps, floor)
            assert found == pytest.approx(max(plain, floor), abs=1e-9)
    assert compared > 500


def test_a_least_overlap_drops_what_overlaps_less(scene, rng):
    (candidates, constraint, _, memory, poses, _), dropped = set_up(scene), 0
    samples = draw_ransac(scene.pairs, 500, rng)
    for number, sample in enumerate(samples):
        which = make_hypothesis(candidates, constraint, memory, poses, samples, number, 1.0)
        expected, total = sample_pose(scene, sample)
        assert (which >= 0) == (total >= 1.0)
        if which >= 0:
            assert (poses.rotations[which] == expected[0]).all()
        dropped += expected is not None and which < 0
    assert dropped > 20


sizes = st.floats(0.05, 20.0)
offsets = st.floats(-3.0, 3.0)


@given(sizes, sizes, sizes, sizes, offsets, offsets, st.floats(0.0, np.pi))
def test_the_bound_is_never_below_the_iou(a, b, p, q, x, y, angle):
    c, s = np.cos(angle), np.sin(angle)
    exx, eyy, exy = (p * c)**2 + (q * s)**2, (p * s)**2 + (q * c)**2, (p * p - q * q) * c * s
    iou = ellipse_iou(0.0, 0.0, a, b, x, y, exx, exy, eyy)
    assert iou <= iou_bound(0.0, 0.0, a, b, x, y, np.sqrt(exx), np.sqrt(eyy), p * q)


def test_leaders_are_those_of_scoring_every_sample(scene, rng):
    samples = draw_ransac(scene.pairs, 1_000, rng)
    poses = [sample_pose(scene, sample)[0] for sample in samples]
    scores = [-1.0 if pose is None else verify(scene, *pose).score for pose in poses]
    leaders = Leaders.none_yet()
    *_, progress = search_samples(scene, samples, leaders)
    best = leaders.ranked()[0]
    assert progress.tried == len(samples)
    assert leaders.scores[best] == pytest.approx(max(scores), abs=1e-9)
    assert scores[leaders.iterations[best] - 1] == pytest.approx(max(scores), abs=1e-8)
    assert (samples[leaders.iterations[best] - 1] == leaders.samples[best]).all()


@pytest.mark.parametrize(('constraint', 'remains'), [
    (upright(min_height=HEIGHT - 0.3, max_height=HEIGHT + 0.3), True),
    (upright(max_tilt=radians(10)), True),
    (upright(min_height=HEIGHT + 0.3), False),
    (upright(max_height=HEIGHT - 0.3), False),
    (Constraint(tuple(-UP_IN_CAMERA), tuple(UP_IN_MAP), max_tilt=radians(10)), False),
])
def test_a_constraint_rules_poses_out(scene, constraint, remains):
    search = (search_exhaustively, lambda *given: search_progressively(
        scene, compatible_pairs(scene), *given[1:]))
    for one in search:
        leaders = Leaders.none_yet()
        *_, progress = one(scene, leaders, constraint)
        assert progress.coverage == 1.0
        near = False
        for row in leaders.ranked():
            pose = invert_transform(make_transform(leaders.rotations[row],
                                                   leaders.translations[row]))
            height = pose[:3, 3] @ UP_IN_MAP
            assert constraint.min_height <= height <= constraint.max_height
            tilt = (pose[:3, :3] @ np.array(constraint.up_in_camera)) @ UP_IN_MAP
            assert tilt >= np.cos(constraint.max_tilt) - 1e-12
            near |= pose_error(pose, MAP_FROM_CAMERA)[0] < 0.3
        assert near == remains


def test_pairs_and_a_vertical_find_the_pose(scene):
    leaders = Leaders.none_yet()
    steps = list(search_progressively(scene, compatible_pairs(scene), leaders, upright(), size=2))
    best = leaders.ranked()[0]
    pose = invert_transform(make_transform(leaders.rotations[best], leaders.translations[best]))
    assert pose_error(pose, MAP_FROM_CAMERA)[0] < 0.2
    assert leaders.samples[best, 2] == -1
    assert (scene.pairs[leaders.samples[best, 0]] != scene.pairs[leaders.samples[best, 1]]).all()
    assert steps[-1].tried == np.tril(compatible_pairs(scene)).sum()
    assert (steps[-1].coverage, steps[-1].reach) == (1.0, len(scene.pairs))
