# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parameter keyframes_file: which layer is read, and that a bad one stops nothing."""

import logging
import time
from pathlib import Path

import numpy as np
import pytest
from scene import CAMERA, make_room, write_map

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.features import DIMENSIONS
from cliploc_ros.core.keyframes.layer import KeyframeLayer, layer_path, save_layer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.folders import tum_frames
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.recording.keyframe_layer import LayerOptions, build_layer
from cliploc_ros.ros.frame_localizer import Keyframes, load_keyframes
from cliploc_ros.ros.node.diagnostics import StageTimes
from cliploc_ros.ros.parameters import RelocalizerParameters

ROOM = make_room()
ASSETS = Path(__file__).resolve().parents[2] / 'cliploc_ros/demo/assets'
OPTIONS = RelocalizerOptions(matching='class')
NO_DETECTIONS = Detections(np.empty((0, 4)), (), np.empty(0))
# image 2 of the walk shows what these of the mapping walk do
QUERY, LIKE_QUERY = 2, range(2, 10)


@pytest.fixture
def room(tmp_path):
    """A map with a layer of one keyframe next to it."""
    path = tmp_path / 'room.yaml'
    write_map(ROOM, path)
    save_layer(layer_path(path), KeyframeLayer(
        'map', ROOM.landmark_ids, ROOM.centers.astype(np.float32), CAMERA, np.eye(4)[None],
        np.array([0, 5]), np.zeros((5, 2), np.uint16), np.ones((5, 3), np.float32),
        np.ones((5, DIMENSIONS), np.uint8), np.zeros(5, np.uint16),
        np.ones((1, DIMENSIONS), np.uint8)))
    return path


def load(map_file, keyframes_file='auto'):
    return load_keyframes(RelocalizerParameters(
        map_file=str(map_file), keyframes_file=str(keyframes_file)), ROOM)


def test_the_layer_next_to_the_map_or_a_named_one_is_read(room, tmp_path):
    assert len(load(room)) == 1
    moved = tmp_path / 'other.npz'
    (tmp_path / 'room.keyframes.npz').rename(moved)
    assert load(room) is None
    assert len(load(room, moved)) == 1
    assert len(load('', moved)) == 1


def test_no_layer_is_read_where_none_is_wanted(room):
    assert load(room, '') is None
    assert load('') is None


@pytest.mark.parametrize('spoil', ['truncated', 'missing'])
def test_a_bad_layer_is_logged_and_left_out(room, caplog, spoil):
    layer = room.with_name('room.keyframes.npz')
    named = 'auto'
    if spoil == 'truncated':
        layer.write_bytes(layer.read_bytes()[:300])
    else:
        named = room.with_name('none.npz')
    with caplog.at_level(logging.ERROR):
        assert load(room, named) is None
    assert 'localizing without keyframes' in caplog.text
    assert str(layer if spoil == 'truncated' else named) in caplog.text


def frames_of(folder):
    return tum_frames(read_tum(folder), find_camera(None, folder)[0])


def test_a_request_finds_the_demo_robot_without_any_object(caplog):
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    mapped = frames_of(ASSETS / 'mapping').select(LIKE_QUERY)
    layer = build_layer(mapped, landmark_map, LayerOptions(0.0, 0.0, 300))
    keyframes = Keyframes(KeyframeLocalizer(layer), landmark_map)
    frame = next(one for number, one in enumerate(frames_of(ASSETS / 'sequence').read())
                 if number == QUERY)

    def localize(camera, deadline):
        recognizer = keyframes.recognizer(frame.image_rgb, camera, deadline,
                                          StageTimes('search', 0.0))
        return recognizer and Relocalizer(landmark_map, OPTIONS).relocalize(
            [Observation(camera, NO_DETECTIONS)], recognizer)

    later, camera = time.monotonic() + 60.0, frame.camera
    found = localize(camera, later)
    assert found.accepted, found.reason
    assert found.source == 'keyframes'
    assert pose_error(found.map_from_camera, frame.map_from_camera)[0] < 0.05
    assert localize(camera, time.monotonic()) is None, 'there is no time for features'
    assert not caplog.records
    other = Camera(camera.width, camera.height, 1.2 * camera.fx, 1.2 * camera.fy, camera.cx,
                   camera.cy)
    for _ in range(2):
        localize(other, later)
    assert [record.getMessage()[:18] for record in caplog.records] == ['the camera differs']
