# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test ``build_map --bag --cameras`` with the demo's rig: four cameras at six places."""

import numpy as np
import pytest
from rig_bag import MOUNTS, RIG, errors_of, write_rig_bag

from cliploc_ros.cli.build_map import main as build_map
from cliploc_ros.core.keyframes.layer import load_layer_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.datasets.tum import read_tum

ASSETS = RIG.parent
ALL = tuple(MOUNTS)
NETWORKS = ('--model', ASSETS / 'yolo.onnx', '--no-clip', '--image', 'image/compressed',
            '--keyframes', 0, 0)


def run(main, *arguments):
    more = ['--no-check'] if main is build_map else []
    return main([*map(str, arguments), *more])


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """The images of one camera have half the size of the others."""
    return write_rig_bag(tmp_path_factory.mktemp('rig') / 'bag', halved=('left',))


@pytest.fixture(scope='module')
def built(bag):
    """Return the files of two maps: from all cameras, with poses in tf, and from one camera."""
    paths = {}
    for names in (ALL, ('back',)):
        paths[names] = path = bag.with_name(f'{len(names)}.yaml')
        assert run(build_map, '--bag', bag, '--cameras', *names, *NETWORKS, '--map-frame', 'map',
                   '--out', path, '--record-to', path.with_suffix('.npz'),
                   '--keyframe-points', 200) == 0
    return paths


def test_four_cameras_find_more_and_are_as_near_the_truth(built):
    one, four = (errors_of(built[names], RIG / 'front') for names in (('back',), ALL))
    print(f'\nlandmarks, median error: one camera {len(one)}, {1e3 * np.median(one):.0f} mm; '
          f'four {len(four)}, {1e3 * np.median(four):.0f} mm')
    assert len(four) > 1.5 * len(one)
    assert np.median(four) < max(0.03, 1.1 * np.median(one))


def test_the_observations_keep_cameras_and_poses(built):
    recorded = load_observations(built[ALL].with_suffix('.npz'))
    assert recorded.camera_names == ALL
    assert np.bincount(recorded.frame_cameras).tolist() == [6] * 4
    assert [(camera.width, camera.fx) for camera in recorded.cameras] == [
        (640, 500.0), (320, 250.0), (640, 500.0), (640, 500.0)]
    for frame in range(24):
        truth = read_tum(RIG / recorded.name_of(frame)).pose_at(
            round(1e9 * recorded.stamps_s[frame]))
        np.testing.assert_allclose(recorded.map_from_camera[frame], truth, atol=1e-5)


def test_each_camera_has_keyframes(built):
    layer = load_layer_of_map(built[ALL].with_suffix('.keyframes.npz'),
                              LandmarkMap.from_file(built[ALL]))
    # small images have fewer features
    assert np.bincount(layer.camera_rows).tolist() == pytest.approx([18, 6], abs=1)
    assert {layer.camera_of(row).width for row in range(len(layer))} == {320, 640}
    assert np.diff(layer.offsets).max() == 200
    for row in range(len(layer)):  # the points lie where the keyframe shows them
        points, camera = layer.points[layer.rows(row)], layer.camera_of(row)
        pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        shown = np.asarray(layer.pixels[layer.rows(row)]) / 16.0
        assert np.median(np.linalg.norm(pixels - shown, axis=1)) < 1.0


@pytest.mark.parametrize('poses', [
    pytest.param(('--pose-topic', 'ground_truth'), marks=pytest.mark.full),
    ('--pose-topic', '/robot', '--mount', *(value for name in ALL for value in MOUNTS[name]))])
def test_poses_of_each_camera_or_of_the_robot_give_the_same_map(bag, built, tmp_path, poses):
    out = tmp_path / 'again.yaml'
    assert run(build_map, '--bag', bag, '--cameras', *ALL, *NETWORKS, *poses,
               '--no-keyframe-layer', '--out', out) == 0
    again, first = LandmarkMap.from_file(out), LandmarkMap.from_file(built[ALL])
    assert len(again) == len(first)
    np.testing.assert_allclose(again.centers, first.centers, atol=5e-3)
