# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relocalizer as a process with a keyframe layer next to its map, in the demo's room."""

import re
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from frames import header_of, messages_of
from scene import make_room, write_bare_map, write_map
from tester import make_frame, transform_of

from cliploc_ros.cli.evaluate import main as evaluate
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.layer import layer_hash, layer_path, save_layer
from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions, build_layer
from demo import ASSETS

ROOM = make_room()  # its objects are nowhere in the images
# image 2 of the walk shows what these of the mapping walk do
QUERY, LIKE_QUERY = 2, range(2, 8)
UNKNOWN = Detections(np.array([[10.0, 10.0, 90.0, 90.0]]), ('z',), np.ones(1))


def frames_of(name):
    return read_folder(ASSETS / name, FolderOptions(layout='tum'))


@pytest.fixture(scope='module')
def layer():
    mapped = frames_of('mapping').select(LIKE_QUERY)
    return build_layer(mapped, ROOM, LayerOptions(0.0, 0.0, 300))


@pytest.fixture
def room_map(layer, tmp_path):
    path = tmp_path / 'room.yaml'
    write_map(ROOM, path)
    save_layer(layer_path(path), layer)
    return path


def query_frame():
    """Return image 2 of the walk with its pose and messages."""
    seen = next(frames_of('sequence').select([QUERY]).read())
    return seen, messages_of(UNKNOWN, header_of(100 * 10**9, 'camera_optical_frame'),
                             seen.image_rgb, seen.camera)


def test_keyframes_answer_where_no_object_is_seen_and_a_bad_layer_stops_nothing(
        own_relocalizer, tester, layer, room_map, tmp_path):
    process = own_relocalizer()
    assert f'{len(layer)} keyframes' in process.output()
    seen, (image, info, detections) = query_frame()
    answer = tester.relocalize((image, info, detections))
    assert answer.success, answer.message
    assert re.search(r' deg; by \d+ keyframe points; [0-9.]+ s$', answer.message)
    tester.wait(lambda: tester.poses, 'a pose')
    assert pose_error(transform_of(tester.poses[0].pose.pose), seen.map_from_camera)[0] < 0.05
    # boxes that the object search accepts, in an image of another place
    contradicted = tester.relocalize((image, info, make_frame()[2]))
    assert not contradicted.success
    assert 'keyframes give poses ' in contradicted.message
    health = diagnostics_of(tester)
    assert [health[name] for name in ('keyframes', 'keyframes file', 'keyframes hash')] == [
        str(len(layer)), str(layer_path(room_map)), layer_hash(layer_path(room_map))]
    layer_path(room_map).rename(tmp_path / 'other.npz')  # and the layer of a named file
    for name, has_keyframes in (('auto', False), (str(tmp_path / 'other.npz'), True)):
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
    assert tester.relocalize(make_frame()).success


def test_a_map_of_keyframes_alone(start, tester, layer, room_map, tmp_path, capsys):
    """It is a valid map with default options and without CLIP; landmarks may come and go."""
    bare = tmp_path / 'bare.yaml'
    write_bare_map(bare, replace(layer, landmark_ids=(), landmark_centers=np.empty((0, 3))))
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
    assert f'camera): {answer.message.rpartition("; ")[0]}; ' in capsys.readouterr().out
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
