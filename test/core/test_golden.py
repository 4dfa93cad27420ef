# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the method with values of an independent implementation (../shared/data/README.md)."""

import numpy as np
import pytest
from reference import candidate_mask, same_class, sample_pose, solve_p3p, verify

from cliploc_ros.core.search.frame_search import balanced_order, nearest_candidates, prosac_order
from cliploc_ros.core.search.scene import make_scene
from cliploc_ros.core.search.strategies import Leaders, search_exhaustively


@pytest.fixture(scope='module')
def golden_scenes(office, office_map, queries, observed):
    """Return scene, B-PROSAC pairs and golden values of each query that has them."""
    golden = np.load(office / 'golden.npz')
    scenes = []
    for number, frame in enumerate(frame for frame in queries if frame.is_main):
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
        assert (prosac_order(nearest).pairs == values['prosac']).all()
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
        leaders = Leaders.none_yet()
        *_, last = search_exhaustively(scene, leaders)
        assert last.tried > 0
        assert last.coverage == 1.0
        assert leaders.scores.max() == pytest.approx(float(values['bestS']), abs=1e-3)
