# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the programs on the demo's walks through a lens with strong distortion."""

import json

import cv2
import numpy as np
import pytest
from capture_folders import ASSETS, copy_walk
from rig_bag import errors_of

from cliploc_ros.cli.build_map import main as build_map
from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.cli.tum_to_bag import main as tum_to_bag
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.datasets.frames import RawFrame
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.views import make_views
from cliploc_ros.offline.recording.networks import run_networks

NETWORKS = ('--model', ASSETS / 'yolo.onnx')
# Distortion of the TUM sequences fr1.
LENS = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, 'plumb_bob',
              (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))


def bend(source, folder, every=1):
    """Write every n-th image of a walk of the demo as seen through the lens."""
    rows = copy_walk(source, folder, every)
    straight = json.loads((folder / 'camera.json').read_text())
    pixels = np.stack(np.meshgrid(*map(np.arange, (640.0, 480.0))), axis=-1).reshape(-1, 1, 2)
    points = cv2.undistortPoints(pixels, LENS.matrix, np.array(LENS.distortion),
                                 criteria=(cv2.TERM_CRITERIA_COUNT, 100, 0.0)).reshape(-1, 2)
    places = Camera(**straight).project_normalized(points)
    places = places.reshape(LENS.height, LENS.width, 2).astype(np.float32)
    for row in rows:
        file = folder / row.split()[1]
        image = cv2.remap(cv2.imread(str(file)), places, None, cv2.INTER_LINEAR)
        assert cv2.imwrite(str(file), image)
    (folder / 'camera.json').write_text(json.dumps({
        'width': 640, 'height': 480, 'fx': LENS.fx, 'fy': LENS.fy, 'cx': LENS.cx, 'cy': LENS.cy,
        'distortion_model': LENS.distortion_model, 'd': LENS.distortion}))
    return folder


def arguments(*parts):
    return [*map(str, parts)]


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('bent')


@pytest.fixture(scope='module')
def recorded(folder):
    """Return the observations of the mapping walk; its map lies next to them."""
    bend(ASSETS / 'mapping', folder / 'mapping')
    assert build_map(arguments('--tum', folder / 'mapping', *NETWORKS, '--no-clip', '--no-check',
                               '--no-joint', '--no-keyframe-layer', '--out', folder / 'map.yaml',
                               '--record-to', folder / 'mapping.npz')) == 0
    return load_observations(folder / 'mapping.npz')


def test_a_folder_gives_the_map_of_the_room(recorded, folder):
    off = errors_of(folder / 'map.yaml', ASSETS / 'mapping')
    assert len(off) > 50 and (off < 0.1).mean() > 0.95, off
    assert recorded.cameras == (Camera(640, 480, 500.0, 500.0, 319.5, 239.5),)


def test_an_edge_at_the_border_of_the_image_is_open(recorded):
    """The lens moves the image border inwards, so a box edge there does not measure an object."""
    views = make_views(recorded)
    assert views.is_open.any(axis=0).all() and 0.02 < views.is_open.mean() < 0.1
    left, top, right, bottom = views.bounds[0] * LENS.fx + (319.5, 239.5, 319.5, 239.5)
    assert 5 < left < 30 and 3 < top < 30 and 610 < right < 635 and 450 < bottom < 477
    again = make_views(recorded.select_frames(range(5)))
    assert (again.is_open == views.is_open[:len(again.is_open)]).all()


def test_boxes_of_an_ideal_fisheye_are_undistorted():
    """With coefficients of zero, the radius is the angle. A box far from the axis is discarded."""
    lens = Camera(640, 480, 200.0, 200.0, 320.0, 240.0, 'equidistant', (0.0,) * 4)
    found = Detections(np.array([[400.0, 210.0, 480.0, 270.0], [600.0, 230.0, 638.0, 250.0]]),
                       ('cup', 'tv'), np.array([0.9, 0.9]))
    raw = RawFrame(0, 0, np.eye(4), lambda: (np.zeros((480, 640, 3), dtype=np.uint8), lens))
    seen = run_networks(lambda image: found, None, raw)
    assert seen.class_ids.tolist() == ['cup'] and seen.open_edges.tolist() == [[False] * 4]
    across = np.hypot(120.0, 30.0) / 200.0  # for the middle of the upper edge
    np.testing.assert_allclose(seen.bboxes_xyxy[0], [
        320 + 200 * np.tan(0.4), 240 - 30 * np.tan(across) / across,
        320 + 200 * np.tan(0.8), 240 + 30 * np.tan(across) / across], atol=1e-6)


def test_a_recording_is_localized_in_the_map_of_the_room(folder):
    bend(ASSETS / 'sequence', folder / 'sequence', every=4)
    assert tum_to_bag(arguments(folder / 'sequence', folder / 'bag')) == 0
    assert evaluate(arguments(
        '--bag', folder / 'bag', '--map', ASSETS / 'map.yaml', *NETWORKS, '--clip-pretrained',
        ASSETS / 'clip', '--methods', 'auto', '--trials', 1, '--workers', 1, '--no-figures',
        '--out', folder / 'out')) == 0
    results = json.loads((folder / 'out/results.json').read_text())
    right = [result['solved'] and result['error_m'] < 0.5 for result in results]
    accepted = [result['accepted'] for result in results]
    assert np.mean(right) > 0.9 and np.mean(accepted) > 0.85
    assert all(result['error_m'] < 1.0 for result in results if result['accepted'])
