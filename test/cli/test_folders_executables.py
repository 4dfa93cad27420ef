# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map of a COLMAP project, a walk of a phone in it, and the studio with its images."""

import json

import numpy as np
import pytest
from capture_folders import ASSETS, shots_of, write_colmap, write_polycam

from cliploc_ros.cli.build_map import main as build_map
from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.images import open_images

pytestmark = [pytest.mark.full, pytest.mark.needs('pycolmap')]
NETWORKS = ('--model', ASSETS / 'yolo.pt', '--device', 'cpu')
CLIP = ('--clip-model', ASSETS / 'clip.json', '--clip-pretrained', ASSETS / 'clip.safetensors')


def run(main, *arguments):
    return main([*map(str, arguments), *(['--no-check'] if main is build_map else [])])


def test_a_project_becomes_a_map_in_which_a_phone_is_localized(tmp_path, capsys):
    shots = shots_of()
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
    assert '30 of 30 images' in shown
    assert '0.4 m' in shown
    landmarks = LandmarkMap.from_file(built)
    # keyframes have the camera of their image, and the poses of the map
    layer = load_layer_of_map(layer_path(built), landmarks)
    assert {layer.camera_of(row).fx for row in range(len(layer))} == {500.0, 501.0, 502.0}
    known = np.array([shot.pose[:3, 3] for shot in shots])
    for pose in layer.map_from_camera:
        assert np.linalg.norm(known - pose[:3, 3], axis=1).min() < 1e-3

    walk = write_polycam(tmp_path / 'phone', shots_of(ASSETS / 'sequence')[::4])
    assert run(evaluate, '--folder', walk, '--map', built, *NETWORKS, *CLIP, '--methods', 'auto',
               '--trials', 1, '--sweep', '--no-figures', '--out', tmp_path / 'out') == 0
    assert '12 of 12 images' in capsys.readouterr().out
    accepted = [one for one in json.loads((tmp_path / 'out/results.json').read_text())
                if one['accepted']]
    assert len(accepted) > 4 and max(one['error_m'] for one in accepted) < 0.5

    studio = open_studio(make_parser().parse_args([str(built), '--images', str(walk)]))
    try:
        assert studio.views == 12 and studio.recording.detections.cameras[0].fx == 500.0
        assert open_images(walk, None).near(float(
            studio.recording.detections.stamps_s[3])).shape == (480, 640, 3)
    finally:
        studio.document.close()
    # the studio shows each image as the camera of the boxes does, whatever its own focus is
    image = open_images(folder, None).near(2.0, '', Camera(640, 480, 250.0, 250.0, 319.5, 239.5))
    assert (image[:110] == 0).all() and image[240, 320].any()
