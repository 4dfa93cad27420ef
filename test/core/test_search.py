# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The samples of each strategy; the kernel compared with plain Python and golden values."""

from math import comb, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import candidate_mask, same_class, sample_pose, scene_of, solve_p3p, verify
from scene import CAMERA, MAP_FROM_CAMERA, make_room, see_room

from cliploc_ros.core.geometry.ellipse import ellipse_iou, iou_bound
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.search import strategies
from cliploc_ros.core.search.frame_search import balanced_order, nearest_candidates
from cliploc_ros.core.search.scene import Constraint, make_scene
from cliploc_ros.core.search.screening import make_hypothesis, set_up, verify_beyond


def test_growth_of_chum_and_matas():
    assert strategies.prosac_growth(33, 500)[:8].tolist() == [1, 2, 3, 4, 6, 8, 11, 15]


pairs = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=0, max_size=30,
                 unique=True).map(lambda rows: np.array(rows, dtype=np.int64).reshape(-1, 2))


@given(pairs, st.integers(1, 200), st.integers(0, 2**32), st.sampled_from([strategies.draw_ransac,
                                                                           strategies.draw_prosac]))
def test_samples_are_valid_and_repeat(pairs, iterations, seed, draw):
    samples = draw(pairs, iterations, np.random.default_rng(seed))
    assert samples.shape == (iterations, 3)
    assert (samples == draw(pairs, iterations, np.random.default_rng(seed))).all()
    for sample in samples[samples[:, 0] >= 0]:
        assert len(set(pairs[sample, 0])) == 3
        assert len(set(pairs[sample, 1])) == 3


def test_prosac_draws_the_newest_candidate_while_its_set_grows():
    pairs = np.stack([np.arange(33)] * 2, axis=1)
    samples = strategies.draw_prosac(pairs, 500, np.random.default_rng(0))
    sizes = np.searchsorted(strategies.prosac_growth(33, 500), np.arange(1, 501)) + 3
    for sample, size in zip(samples, np.minimum(sizes, 33), strict=True):
        assert sample.max() == size - 1 if size < 33 else sample.max() < 33


def test_ransac_draws_all_candidates_alike():
    pairs = np.stack([np.arange(10)] * 2, axis=1)
    counts = np.bincount(strategies.draw_ransac(pairs, 30_000, np.random.default_rng(0)).ravel())
    # 9,000 each is expected, with a standard deviation of about 80
    assert np.abs(counts - 9_000).max() < 400


def test_the_range_holds_every_distance(rng):
    for _ in range(200):
        a, b = rng.uniform(1, 10, 2)
        cosine = rng.uniform(0.3, 1.0)
        low, high = strategies._distance_range(a, b, cosine)
        u, v = np.meshgrid(*(np.linspace(strategies.NEAREST, strategies.FARTHEST, 60) * depth
                             for depth in (a, b)))
        distances = np.sqrt(np.maximum(0, u**2 + v**2 - 2 * u * v * cosine))
        assert low <= distances.min() + 1e-9
        assert high == pytest.approx(distances.max())
        assert low == pytest.approx(distances.min(), abs=0.05 * max(a, b))


def test_all_that_is_within_reach_is_found(room, rng):
    """With landmarks along a corridor, the sweep skips only samples that no distance allows."""
    seen = see_room(room)
    centers = rng.uniform(-1.0, 1.0, (60, 3)) * [40.0, 3.0, 3.0]
    pairs = np.column_stack([rng.integers(len(seen), size=200), rng.integers(60, size=200)])
    scene = make_scene(CAMERA.normalize_bboxes(seen.bboxes_xyxy), centers,
                       np.repeat(room.shapes, 5, axis=0), pairs, pairs, 0.2)
    depths, bearings = strategies._depths(scene), scene.bearings[pairs[:, 0]]
    expected = np.zeros((200, 200), dtype=bool)
    for i, j in np.argwhere((pairs[:, None] != pairs[None]).all(axis=2)):
        low, high = strategies._distance_range(depths[i], depths[j], bearings[i] @ bearings[j])
        expected[i, j] = low <= np.linalg.norm(centers[pairs[i, 1]] - centers[pairs[j, 1]]) <= high
    assert 100 < expected.sum() < 0.5 * expected.size
    np.testing.assert_array_equal(strategies.compatible_pairs(scene), expected)


def pose_of(leaders, row):
    return invert_transform(make_transform(leaders.rotations[row], leaders.translations[row]))


def test_it_ends_where_the_exhaustive_search_ends(room):
    scene = scene_of(room)
    whole, gated = strategies.Leaders.none_yet(), strategies.Leaders.none_yet()
    *_, all_tried = strategies.search_exhaustively(scene, whole)
    compatible = strategies.compatible_pairs(scene)
    *_, progress = strategies.search_progressively(scene, compatible, gated)
    assert (progress.coverage, progress.reach) == (1.0, len(scene.pairs))
    assert progress.tried == np.einsum('ij,jk,ki', *[compatible.astype(int)] * 3) / 6
    assert progress.tried < 0.8 * all_tried.tried
    best = [leaders.ranked()[0] for leaders in (whole, gated)]
    assert gated.scores[best[1]] == pytest.approx(whole.scores[best[0]], rel=1e-6)
    assert pose_error(pose_of(gated, best[1]), MAP_FROM_CAMERA)[0] < 1e-2


def test_the_first_candidates_are_done_before_the_next(room):
    scene = scene_of(room, rows=slice(0, 9))
    everything = np.ones((len(scene.pairs),) * 2, dtype=bool)
    steps = list(strategies.search_progressively(scene, everything, strategies.Leaders.none_yet()))
    reaches = [step.reach for step in steps]
    assert reaches == sorted(reaches)
    count = len(scene.pairs)
    for step in steps[:-1]:
        assert step.coverage == pytest.approx(comb(step.reach, 3) / comb(count, 3))
    assert steps[-1].coverage == 1.0 and steps[-1].tried == comb(count, 3)


UP_IN_MAP = np.array([0.0, -1.0, 0.0])
UP_IN_CAMERA = MAP_FROM_CAMERA[:3, :3].T @ UP_IN_MAP
HEIGHT = float(MAP_FROM_CAMERA[:3, 3] @ UP_IN_MAP)


def upright(**known):
    return Constraint(tuple(UP_IN_CAMERA), tuple(UP_IN_MAP), **known)


@pytest.fixture(scope='module')
def scene():
    return scene_of(make_room(), noise_px=4, rng=np.random.default_rng(3))


def test_it_chooses_and_scores_as_the_reference(scene, rng):
    candidates, constraint, targets, memory, poses, overlaps = set_up(scene)
    samples, compared, dropped = strategies.draw_ransac(scene.pairs, 2_000, rng), 0, 0
    for number, sample in enumerate(samples):
        expected, total = sample_pose(scene, sample)
        # a least overlap drops what overlaps less
        best = make_hypothesis(candidates, constraint, memory, poses, samples, number, 1.0)
        assert (best >= 0) == (total >= 1.0)
        which = make_hypothesis(candidates, constraint, memory, poses, samples, number, 0.0)
        assert (which >= 0) == (expected is not None)
        if expected is None:
            continue
        assert best in (-1, which)
        compared, dropped = compared + 1, dropped + (best < 0)
        assert total >= 0.0
        assert (poses.rotations[which] == expected[0]).all()
        assert (poses.translations[which] == expected[1]).all()
        plain = verify(scene, *expected).score  # see the golden values below
        for floor in (-1.0, 0.5 * plain, plain - 1e-6, plain + 1e-6, plain + 1.0):
            found = verify_beyond(targets, poses, which, overlaps, floor)
            assert found == pytest.approx(max(plain, floor), abs=1e-9)
    assert compared > 500 and dropped > 80


sizes = st.floats(0.05, 20.0)
offsets = st.floats(-3.0, 3.0)


@given(sizes, sizes, sizes, sizes, offsets, offsets, st.floats(0.0, np.pi))
def test_the_bound_is_never_below_the_iou(a, b, p, q, x, y, angle):
    c, s = np.cos(angle), np.sin(angle)
    exx, eyy, exy = (p * c)**2 + (q * s)**2, (p * s)**2 + (q * c)**2, (p * p - q * q) * c * s
    iou = ellipse_iou(0.0, 0.0, a, b, x, y, exx, exy, eyy)
    assert iou <= iou_bound(0.0, 0.0, a, b, x, y, np.sqrt(exx), np.sqrt(eyy), p * q)


@pytest.mark.parametrize(('constraint', 'remains'), [
    (upright(max_tilt=radians(10)), True), (upright(max_height=HEIGHT - 0.3), False),
    (Constraint(tuple(-UP_IN_CAMERA), tuple(UP_IN_MAP), max_tilt=radians(10)), False),
])
def test_a_constraint_rules_poses_out(scene, constraint, remains):
    searches = (strategies.search_exhaustively, lambda *given: strategies.search_progressively(
        scene, strategies.compatible_pairs(scene), *given[1:]))
    for search in searches:
        leaders = strategies.Leaders.none_yet()
        *_, progress = search(scene, leaders, constraint)
        assert progress.coverage == 1.0
        near = False
        for row in leaders.ranked():
            pose = pose_of(leaders, row)
            height = pose[:3, 3] @ UP_IN_MAP
            assert constraint.min_height <= height <= constraint.max_height
            tilt = (pose[:3, :3] @ np.array(constraint.up_in_camera)) @ UP_IN_MAP
            assert tilt >= np.cos(constraint.max_tilt) - 1e-12
            near |= pose_error(pose, MAP_FROM_CAMERA)[0] < 0.3
        assert near == remains


def test_pairs_and_a_vertical_find_the_pose(scene):
    leaders, compatible = strategies.Leaders.none_yet(), strategies.compatible_pairs(scene)
    steps = list(strategies.search_progressively(scene, compatible, leaders, upright(), size=2))
    best = leaders.ranked()[0]
    assert pose_error(pose_of(leaders, best), MAP_FROM_CAMERA)[0] < 0.2
    assert leaders.samples[best, 2] == -1
    assert (scene.pairs[leaders.samples[best, 0]] != scene.pairs[leaders.samples[best, 1]]).all()
    assert steps[-1].tried == np.tril(compatible).sum()
    assert (steps[-1].coverage, steps[-1].reach) == (1.0, len(scene.pairs))


# ---- values of an independent implementation (../shared/data/README.md)
@pytest.fixture(scope='module')
def golden_scenes(office, office_map, queries, observed):
    """Return scene, B-PROSAC pairs and golden values of each query that has them."""
    golden = np.load(office / 'golden.npz')
    scenes = []
    for number, frame in enumerate(frame for frame in queries.frames if frame.is_main):
        values = {name.removeprefix(f'q{number}_'): golden[name] for name in golden.files
                  if name.startswith(f'q{number}_')}
        if 'H' not in values:  # fewer than three boxes
            continue
        observation = observed(frame)
        nearest = nearest_candidates(observation.similarities, 3)
        potential = same_class(observation.detections.class_ids, office_map.class_ids)
        potential |= candidate_mask(nearest, potential.shape)
        pairs = balanced_order(nearest).pairs
        scene = make_scene(observation.camera.normalize_bboxes(observation.detections.bboxes_xyxy),
                           office_map.centers, office_map.shapes, potential, pairs,
                           float(golden['thr']))
        scenes.append((scene, nearest, potential, values))
    assert len(scenes) >= 45
    return scenes


def test_orders_and_masks_are_identical(golden_scenes):
    for _, nearest, potential, values in golden_scenes:
        assert (nearest.ordered(-nearest.similarities).pairs == values['prosac']).all()
        assert (balanced_order(nearest).pairs == values['bprosac']).all()
        assert (potential == values['vmask'].astype(bool)).all()


def test_scores_inliers_and_poses_agree(golden_scenes):
    compared, worst, only_ours = 0, 0.0, 0
    for scene, _, _, values in golden_scenes:
        row_of = {tuple(pair): row for row, pair in enumerate(scene.pairs.tolist())}
        for sample, score, inliers, pose in zip(values['H'], values['S'], values['inl'],
                                                values['RT'], strict=True):
            if sample[0] < 0:
                continue
            rows = np.array([row_of[sample[i], sample[i + 3]] for i in range(3)])
            found, _ = sample_pose(scene, rows)
            if score < 0 and found is not None:
                only_ours += 1
                assert_solves(scene, rows, *found)
                continue
            assert (score < 0) == (found is None)
            compared += 1
            if found is None:
                continue
            rotation, translation = found
            verified = verify(scene, rotation, translation)
            worst = max(worst, abs(verified.score - score))
            assert (verified.landmarks >= 0).sum() == inliers
            # the other implementation rounds to single precision
            assert np.abs(rotation - pose[:, :3]).max() < 1e-2
            assert np.abs(translation - pose[:, 3]).max() < 1e-2
    print(f'\n{compared} golden hypotheses: scores at most {worst:.1e} off; {only_ours} more that '
          'the other implementation did not find')
    assert compared > 8_000
    assert worst < 1e-3
    assert only_ours <= 2


def assert_solves(scene, rows, rotation, translation):
    """A pose that only this implementation found must look along the three bearings."""
    seen = scene.centers[scene.pairs[rows, 1]] @ rotation.T + translation
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    assert np.abs(seen - scene.bearings[scene.pairs[rows, 0]]).max() < 1e-8
    assert len(solve_p3p(scene.bearings[scene.pairs[rows, 0]],
                         scene.centers[scene.pairs[rows, 1]])[0]) >= 1


def test_the_exhaustive_optimum_is_found_in_every_query(golden_scenes):
    for scene, _, _, values in golden_scenes:
        leaders = strategies.Leaders.none_yet()
        *_, last = strategies.search_exhaustively(scene, leaders)
        assert last.tried > 0 and last.coverage == 1.0
        assert leaders.scores.max() == pytest.approx(float(values['bestS']), abs=1e-3)
