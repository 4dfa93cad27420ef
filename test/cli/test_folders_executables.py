# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build a map of a COLMAP project, localize a phone's walk in it, and open it in the studio."""

import json

import numpy as np
import pytest
from capture_folders import ASSETS, WALK, copy_walk, shots_of, write_colmap, write_polycam
from scipy.spatial.transform import Rotation

from cliploc_ros.cli.build_map import main as build_map
from cliploc_ros.cli.check_map import main as check_map
from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.cli.tum_to_bag import main as tum_to_bag
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.images import open_images
from cliploc_ros.offline.datasets.map_recording import load_recording
from cliploc_ros.offline.mapping.evidence import explained_boxes
from cliploc_ros.offline.mapping.landmarks import landmarks_of_map
from cliploc_ros.offline.mapping.views import make_views

pytestmark = [pytest.mark.full, pytest.mark.needs('pycolmap')]
NETWORKS = ('--model', ASSETS / 'yolo.onnx')
CLIP = ('--clip-pretrained', ASSETS / 'clip')


def run(main, *arguments):
    more = {build_map: ['--no-check'], evaluate: ['--workers', '1']}.get(main, [])
    return main([*map(str, arguments), *more])


def test_a_project_becomes_a_map_in_which_a_phone_is_localized(tmp_path, capsys):
    shots = shots_of()[::2]
    first, last = shots[0], shots[-1]
    folder = write_colmap(tmp_path / 'scan', shots, scale=0.4, camera_of=lambda number: (
        'SIMPLE_PINHOLE', 640, 480, [500.0 + number % 3, 320.0, 240.0]))
    built = tmp_path / 'built.yaml'
    distance_m = np.linalg.norm(first.pose[:3, 3] - last.pose[:3, 3])
    arguments = ('--colmap', folder, *NETWORKS, *CLIP, '--keyframe-layer', '--out', built)
    assert run(build_map, *arguments) == 1
    assert run(build_map, *arguments, '--known-distance', first.path.name, last.path.name,
               distance_m) == 0
    shown = capsys.readouterr().out
    assert '15 of 15 images' in shown and '0.4 m' in shown
    landmarks = LandmarkMap.from_file(built)
    # keyframes have the camera of their image, and the poses of the map
    layer = load_layer_of_map(layer_path(built), landmarks)
    assert {layer.camera_of(row).fx for row in range(len(layer))} == {500.0, 501.0, 502.0}
    known = np.array([shot.pose[:3, 3] for shot in shots])
    for pose in layer.map_from_camera:
        assert np.linalg.norm(known - pose[:3, 3], axis=1).min() < 1e-3

    walk = write_polycam(tmp_path / 'phone', shots_of(ASSETS / 'sequence')[::6])
    assert run(evaluate, '--folder', walk, '--map', built, *NETWORKS, *CLIP, '--methods', 'auto',
               '--trials', 1, '--sweep', '--no-figures', '--out', tmp_path / 'out') == 0
    assert '8 of 8 images' in capsys.readouterr().out
    accepted = [trial for trial in json.loads((tmp_path / 'out/results.json').read_text())
                if trial['accepted']]
    assert len(accepted) > 3 and max(result['error_m'] for result in accepted) < 0.5

    studio = open_studio(make_parser().parse_args([str(built), '--images', str(walk)]))
    try:
        assert studio.views == 8 and studio.recording.detections.cameras[0].fx == 500.0
    finally:
        studio.document.close()
    # the studio shows each image through the camera of its boxes, whatever focal length it states
    image = open_images(folder, None).near(2.0, '', Camera(640, 480, 250.0, 250.0, 319.5, 239.5))
    assert (image[:110] == 0).all() and image[240, 320].any()


def errors_of(folder):
    return [trial['error_m'] for trial in json.loads((folder / 'results.json').read_text())
            if trial['accepted']]


def test_a_scaled_and_levelled_map_is_evaluated_on_its_own_recording(tmp_path, capsys, caplog):
    """The options are known from the map; a different scale does not run the networks again."""
    import pycolmap

    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler('x', 25.0, degrees=True).as_matrix()
    folder, built = write_colmap(tmp_path / 'scan', shots_of(), scale=0.4, world=tilt), (
        tmp_path / 'built.yaml')
    networks = (*NETWORKS, '--no-clip')
    arguments = ('--colmap', folder, *networks, '--level', '--no-keyframe-layer')
    assert run(build_map, *arguments, '--keyframes', 0, 0, '--object-size', 'clock', 0.3,
               '--out', built) == 0
    assert run(evaluate, '--colmap', folder, '--map', built, *networks, '--every', 3,
               '--methods', 'auto', '--no-keyframes', '--trials', 1, '--sweep', '--no-figures',
               '--out', tmp_path / 'out') == 0
    errors = errors_of(tmp_path / 'out')
    assert len(errors) >= 3 and max(errors) < 0.25
    assert check_map([str(built), '--positions', '4', '--headings', '2', '--frames', '4']) < 2
    assert 'verdict: ' in capsys.readouterr().out
    detections = load_recording(built).load()
    up = LandmarkMap.from_file(built)
    assert explained_boxes(make_views(detections), landmarks_of_map(
        up, detections.class_names)).explained > 0.5
    studio = open_studio(make_parser().parse_args([str(built)]))
    try:
        assert np.allclose(studio.recording.detections.map_from_camera, detections.map_from_camera)
        assert studio.recording.images.of_folder
        assert studio.recording.images.of(detections, 3).shape == (480, 640, 3)
    finally:
        studio.document.close()
    caplog.clear()
    scaled = (*arguments, '--scale', 0.8)
    assert run(build_map, *scaled, '--out', tmp_path / 'twice.yaml') == 0
    assert any('images of earlier runs' in message for message in caplog.messages)
    # boxes refer to the pinhole of their camera, so boxes of another camera would be wrong
    model = pycolmap.Reconstruction(str(folder / 'sparse/0'))
    for camera in model.cameras.values():
        camera.focal_length_x *= 1.01
    model.write_binary(str(folder / 'sparse/0'))
    caplog.clear()
    assert run(build_map, *scaled, '--out', tmp_path / 'longer.yaml') < 2
    assert not any('images of earlier runs' in message for message in caplog.messages)


def test_a_levelled_map_is_evaluated_on_the_bag_that_made_it(tmp_path, capsys):
    copy_walk(WALK, tmp_path / 'walk', 2)
    tilt = Rotation.from_euler('x', 25.0, degrees=True)
    truth = np.loadtxt(tmp_path / 'walk/groundtruth.txt')
    truth[:, 1:4] = tilt.apply(truth[:, 1:4])
    truth[:, 4:] = (tilt * Rotation.from_quat(truth[:, 4:])).as_quat()
    (tmp_path / 'walk/groundtruth.txt').unlink()
    np.savetxt(tmp_path / 'walk/groundtruth.txt', truth, fmt='%.9f')
    bag, other, built = tmp_path / 'bag', tmp_path / 'other', tmp_path / 'built.yaml'
    assert [run(tum_to_bag, tmp_path / 'walk', path) for path in (bag, other)] == [0, 0]
    assert run(build_map, '--bag', bag, '--level', *NETWORKS, '--no-clip', '--out', built) == 0
    asked = ('--map', built, *NETWORKS, '--no-clip', '--methods', 'auto', '--trials', 1, '--sweep',
             '--no-figures', '--out', tmp_path / 'out')
    assert run(evaluate, '--bag', bag, *asked) == 0
    errors = errors_of(tmp_path / 'out')
    assert len(errors) >= 7 and max(errors) < 0.1
    capsys.readouterr()
    assert run(evaluate, '--bag', other, *asked) == 1
    assert 'was levelled or scaled' in capsys.readouterr().err
