# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare maps of a real office with the limits in test/thresholds.yaml."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from walk import disturb, draw_errors, nearest_errors

from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.building import build_map
from cliploc_ros.offline.mapping.evidence import explained_boxes
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.views import make_views


@pytest.fixture(scope='module')
def office(shared_data) -> Path:
    return shared_data / 'tum_fr3_office'


@pytest.fixture(scope='module')
def observations(office):
    return load_observations(office / 'observations.npz')


@pytest.fixture(scope='module')
def splits(office) -> dict:
    return json.loads((office / 'splits.json').read_text())


@pytest.fixture(scope='module')
def even(observations, splits):
    return observations.select_frames(splits['even']['map'])


@pytest.fixture(scope='module')
def even_map(even):
    return build_map(even).landmark_map


@pytest.fixture(scope='session')
def required() -> dict:
    path = Path(__file__).parents[1] / 'thresholds.yaml'
    return yaml.safe_load(path.read_text())['mapping']


def held_out(observations, split, landmark_map):
    frames = sorted({frame for _, _, frame in split['queries']})
    views = make_views(observations.select_frames(frames))
    quality = explained_boxes(views, landmarks_of_map(landmark_map, observations.class_names))
    return quality.explained, quality.median_iou


@pytest.mark.parametrize('name', ['even', *(pytest.param(name, marks=pytest.mark.full)
                                           for name in ('block0', 'block1'))])
def test_other_frames_are_explained(observations, splits, even_map, required, name):
    built = even_map if name == 'even' else build_map(
        observations.select_frames(splits[name]['map'])).landmark_map
    explained, iou = held_out(observations, splits[name], built)
    print(f'{name}: {len(built)} landmarks, explained {explained:.3f}, median IoU {iou:.3f}')
    assert explained >= required[name]['explained']
    assert iou >= required[name]['median_iou']


@pytest.mark.full
def test_joint_refinement_makes_up_for_slow_pose_errors(even, even_map, required):
    given = PoseErrors(0.05, 1.0, 3.0)
    noisy = disturb(even, draw_errors(even.stamps_s, given, seed=0))

    def median_offset(built):
        """Return the distances of landmarks to those of true poses [m]."""
        return float(np.median(nearest_errors(built.landmark_map, even_map)))

    plain = build_map(noisy)
    joint = build_map(noisy, MappingOptions(pose_errors=given))
    print(f'plain: {len(plain.landmark_map)} landmarks, off by {median_offset(plain):.3f} m; '
          f'joint: {len(joint.landmark_map)}, off by {median_offset(joint):.3f} m')
    assert median_offset(joint) <= required['joint_share'] * median_offset(plain)
    assert len(joint.landmark_map) < len(plain.landmark_map)


@pytest.mark.full
def test_poses_of_motion_capture_are_left_alone(even, even_map):
    built = build_map(even, MappingOptions(estimate_pose_errors=True))
    assert built.report.pose_change_m == 0.0
    assert (built.landmark_map.centers == even_map.centers).all()
