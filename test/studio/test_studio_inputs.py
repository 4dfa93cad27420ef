# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The images of a recording, in any order, and the keyframes next to a map."""

from pathlib import Path

import numpy as np
from scene import make_layer, make_room, write_bare_map, write_map

from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bag_frames import BagTopics
from cliploc_ros.offline.datasets.bags import BagWriter
from cliploc_ros.offline.datasets.images import open_images
from cliploc_ros.offline.studio import edits

BAG_CAMERA = Camera(64, 48, 53.0, 53.0, 32.0, 24.0)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COUNT = 20


def test_each_view_gets_its_image_of_a_bag(tmp_path):
    """The images are recorded 0.4 s after their stamps, the last two at once."""
    with BagWriter(tmp_path / 'bag', 'mcap') as writer:
        writer.add_topic('/camera_info', bag_messages.CAMERA_INFO)
        writer.add_topic('/image', bag_messages.IMAGE)
        writer.write('/camera_info', START_NS, bag_messages.camera_info_message(
            START_NS, 'camera', BAG_CAMERA))
        for number in range(COUNT):
            taken_ns = START_NS + number * STEP_NS
            recorded_ns = START_NS + min(number, COUNT - 2) * STEP_NS + 4 * STEP_NS
            writer.write('/image', recorded_ns, bag_messages.image_message(
                taken_ns, 'camera', np.full((48, 64, 3), number, dtype=np.uint8)))
    images = open_images(tmp_path / 'bag', BagTopics())
    for number in (0, COUNT - 1, 7, COUNT - 2):
        image = images.near((START_NS + number * STEP_NS) / 1e9)
        assert image.shape == (48, 64, 3) and (image == number).all()
    assert images.near((START_NS + STEP_NS // 2) / 1e9) is None


def layer_of(path):
    studio = open_studio(make_parser().parse_args([str(path)]))
    studio.document.close()
    return studio.layer


def test_the_layer_comes_with_its_map(tmp_path, capsys):
    path, room = tmp_path / 'room.yaml', make_room()
    assert layer_of(path) is None, 'an empty map has none'
    write_map(room, path)
    assert layer_of(path) is None
    save_layer(layer_path(path), make_layer(room))
    assert len(layer_of(path)) == 6
    assert capsys.readouterr().out == ''
    layer_path(path).write_bytes(b'no layer')
    assert layer_of(path) is None
    assert 'without keyframes: ' in capsys.readouterr().out


def test_a_map_of_keyframes_alone_gets_its_first_landmark(tmp_path, capsys):
    """The keyframes stay the same as in the map."""
    path = tmp_path / 'bare.yaml'
    write_bare_map(path, make_layer(LandmarkMap.empty('map')))
    walk = Path(__file__).parents[2] / 'demo/assets/sequence'
    studio = open_studio(make_parser().parse_args([str(path), '--images', str(walk)]))
    assert len(studio.layer) == 6
    assert 'refused; the map has only keyframes' in studio.relocalize_here()
    studio.document.edit(edits.create, 'a lamp', 'lamp', np.ones(3), np.eye(3))
    studio.document.save()
    studio.document.close()
    assert len(LandmarkMap.from_file(path)) == 1 and len(layer_of(path)) == 6
    assert capsys.readouterr().out == ''
