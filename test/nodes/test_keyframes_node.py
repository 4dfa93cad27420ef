# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process with a keyframe layer next to its map, in the demo's room."""

from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from scene import make_room, write_bare_map, write_map
from tester import class_matching, make_frame, transform_of

from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.layer import layer_hash, layer_path, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer

ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
ROOM = make_room()  # its objects are nowhere in the images
# image 2 of the walk shows what these of the mapping walk do
QUERY, LIKE_QUERY = 2, range(2, 10)
UNKNOWN = Detections(np.array([[10.0, 10.0, 90.0, 90.0]]), ('z',), np.ones(1))


def frames_of(name):
    return read_folder(ASSETS / name, FolderOptions(layout='tum'))


@pytest.fixture
def room_map(tmp_path):
    path = tmp_path / 'room.yaml'
    write_map(ROOM, path)
    mapped = frames_of('mapping').select(LIKE_QUERY)
    save_layer(layer_path(path), build_layer(mapped, ROOM, LayerOptions(0.0, 0.0, 300)))
    return path


def bare_layer():
    return build_layer(frames_of('mapping').select(LIKE_QUERY), LandmarkMap.empty('map'),
                       LayerOptions(0.0, 0.0, 300))


def query_frame(stamp_s=100.0):
    """Return image 2 of the walk with its pose and messages."""
    seen = next(one for number, one in enumerate(frames_of('sequence').read()) if number == QUERY)
    image, info, detections = make_frame(UNKNOWN, stamp_s)
    image.width, image.height, image.step = seen.camera.width, seen.camera.height, \
        3 * seen.camera.width
    image.data = seen.image_rgb.tobytes()
    info.width, info.height = seen.camera.width, seen.camera.height
    info.k = seen.camera.matrix.ravel()
    info.p = np.c_[seen.camera.matrix, np.zeros(3)].ravel()
    return seen, (image, info, detections)


def test_keyframes_answer_where_no_object_is_seen_and_a_bad_layer_stops_nothing(
        start, tester, room_map, tmp_path, capsys):
    process = start('nodes.relocalizer',
                    parameters=class_matching(room_map, record_folder=tmp_path / 'cases'))
    process.wait_for_output('ready after')
    assert '8 keyframes' in process.output()
    tester.connect()
    seen, (image, info, detections) = query_frame()
    answer = tester.relocalize((image, info, detections))
    assert answer.success, answer.message
    assert 'pose by keyframes' in answer.message
    assert 'points of keyframes' in answer.message
    assert tester.trigger('record').success
    case, = (tmp_path / 'cases').iterdir()
    again = ['--bag', str(case), '--map', str(room_map)]
    assert evaluate(again) == 0
    assert 'again:    accepted' in capsys.readouterr().out
    tester.wait(lambda: tester.poses, 'a pose')
    assert pose_error(transform_of(tester.poses[0].pose.pose), seen.map_from_camera)[0] < 0.05
    # boxes that the object search accepts, in an image of another place
    contradicted = tester.relocalize((image, info, make_frame()[2]))
    assert not contradicted.success
    assert 'keyframes give poses ' in contradicted.message
    health = diagnostics_of(tester)
    assert health['keyframes'] == '8'
    assert health['keyframes file'] == str(layer_path(room_map))
    assert health['keyframes hash'] == layer_hash(layer_path(room_map))
    layer_path(room_map).rename(tmp_path / 'other.npz')  # and the layer of a named file
    for name, has_keyframes in (('auto', False), (str(tmp_path / 'other.npz'), True), ('', False)):
        assert tester.set_parameter('keyframes_file', name).successful
        assert tester.trigger('reload_map').success
        assert ('keyframes' in diagnostics_of(tester)) == has_keyframes
    layer_path(room_map).write_bytes(b'no layer')
    assert tester.set_parameter('keyframes_file', 'auto').successful
    assert tester.trigger('reload_map').success
    process.wait_for_output('without keyframes')
    assert '[ERROR]' in next(line for line in process.output().splitlines()
                             if 'without keyframes' in line), 'also of Python loggers'
    assert not tester.relocalize((image, info, detections)).success
    assert 'keyframes' not in diagnostics_of(tester)
    write_bare_map(tmp_path / 'bare.yaml', bare_layer())  # landmarks may come and go
    for path, frame in ((tmp_path / 'bare.yaml', (image, info, detections)),
                        (room_map, make_frame())):
        assert tester.set_parameter('map_file', str(path)).successful
        assert tester.trigger('reload_map').success
        assert tester.relocalize(frame).success


def test_a_map_of_keyframes_alone(start, tester, room_map, tmp_path, capsys):
    """It is a valid map with default options and without CLIP."""
    bare = tmp_path / 'bare.yaml'
    write_bare_map(bare, bare_layer())
    process = start('nodes.relocalizer', parameters={'map_file': bare,
                                                     'record_folder': tmp_path / 'cases'})
    process.wait_for_output('ready after')
    tester.connect()
    seen, frame = query_frame()
    answer = tester.relocalize(frame)
    assert answer.success, answer.message
    assert pose_error(transform_of(tester.poses[0].pose.pose), seen.map_from_camera)[0] < 0.05
    assert tester.trigger('record').success
    case, = (tmp_path / 'cases').iterdir()
    assert evaluate(['--bag', str(case), '--map', str(bare)]) == 0
    refusal = tester.relocalize(make_frame()).message
    assert 'the map has only keyframes, and none matches' in refusal
    assert 'detector' not in process.output()
    for methods, problem in ((['all'], "'class_bf' uses landmarks only"),
                             (['auto', '--no-keyframes'], 'has no landmarks')):
        assert evaluate(['--tum', str(ASSETS / 'sequence'), '--map', str(bare),
                         '--methods', *methods]) == 1
        assert problem in capsys.readouterr().err


def diagnostics_of(tester):
    """Return the relocalizer's next diagnostics."""
    heard = []
    subscription = tester.create_subscription(
        DiagnosticArray, '/diagnostics', lambda msg: heard.extend(
            status for status in msg.status if 'relocalizer' in status.name), 10)
    tester.wait(lambda: heard, 'diagnostics')
    tester.destroy_subscription(subscription)
    return {value.key: value.value for value in heard[-1].values}
