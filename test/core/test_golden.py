# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method against values of an independent implementation (../shared/data/README.md)."""

import numpy as np
import pytest

from cliploc_ros.core.association import candidates as association
from cliploc_ros.core.association.scene import Workspace, make_scene, sample_pose, verify
from cliploc_ros.core.geometry.p3p import solve_p3p
from cliploc_ros.core.search.search import Leaders, search_exhaustively


@pytest.fixture(scope='module')
def golden_scenes(office, office_map, queries, observe):
    """Scene, B-PROSAC pairs and golden values of each query that has them."""
    golden = np.load(office / 'golden.npz')
    scenes = []
    for number, frame in enumerate(queries.main_frames()):
        values = {name.removeprefix(f'q{number}_'): golden[name] for name in golden.files
                  if name.startswith(f'q{number}_')}
        if 'H' not in values:  # fewer than three boxes
            continue
        observation = observe(frame)
        nearest = association.nearest_candidates(frame.similarities, 3)
        potential = association.same_class(frame.class_ids, office_map.class_ids)
        potential |= association.candidate_mask(nearest, potential.shape)
        pairs = association.balanced_order(nearest).pairs
        scene = make_scene(observation.camera.normalize_bboxes(frame.bboxes_xyxy),
                           office_map.centers, office_map.shapes, potential, pairs,
                           float(golden['thr']))
        scenes.append((scene, nearest, potential, values))
    assert len(scenes) >= 45
    return scenes


def test_orders_and_masks_are_identical(golden_scenes):
    for _, nearest, potential, values in golden_scenes:
        assert (association.prosac_order(nearest).pairs == values['prosac']).all()
        assert (association.balanced_order(nearest).pairs == values['bprosac']).all()
        assert (potential == values['vmask'].astype(bool)).all()


def test_scores_inliers_and_poses_agree(golden_scenes):
    compared, worst, only_ours = 0, 0.0, 0
    for scene, _, _, values in golden_scenes:
        row_of = {tuple(pair): row for row, pair in enumerate(scene.pairs.tolist())}
        workspace = Workspace.allocate(len(scene.bearings))
        for sample, score, inliers, pose in zip(values['H'], values['S'], values['inl'],
                                                values['RT'], strict=True):
            if sample[0] < 0:
                continue
            rows = np.array([row_of[sample[i], sample[i + 3]] for i in range(3)])
            solution, _ = sample_pose(scene, rows, workspace)
            if score < 0 and solution >= 0:
                only_ours += 1
                assert_solves(scene, rows, workspace, solution)
                continue
            assert (score < 0) == (solution < 0)
            compared += 1
            if solution < 0:
                continue
            rotation = workspace.rotations[solution]
            translation = workspace.translations[solution]
            worst = max(worst, abs(verify(scene, rotation, translation, workspace) - score))
            assert (workspace.landmarks >= 0).sum() == inliers
            # theirs is rounded to single precision
            assert np.abs(rotation - pose[:, :3]).max() < 1e-2
            assert np.abs(translation - pose[:, 3]).max() < 1e-2
    print(f'\n{compared} golden hypotheses: scores at most {worst:.1e} off; {only_ours} more that '
          'the other implementation did not find')
    assert compared > 8_000
    assert worst < 1e-3
    assert only_ours <= 2


def assert_solves(scene, rows, workspace, solution):
    """A pose that only we found must look along the three bearings."""
    rotation, translation = workspace.rotations[solution], workspace.translations[solution]
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
