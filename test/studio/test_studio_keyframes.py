# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer next to a map comes into the studio with it; a bad one is named and left out."""

import numpy as np
from scene import CAMERA, make_room, write_map

from cliploc_ros.cli.studio import make_parser, open_studio
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.layer_file import layer_path, save_layer

ROOM = make_room()


def layer_of(path):
    studio = open_studio(make_parser().parse_args([str(path)]))
    studio.document.close()
    return studio.layer


def test_the_layer_comes_with_its_map(tmp_path, capsys):
    path = tmp_path / 'room.yaml'
    assert layer_of(path) is None, 'an empty map has none'
    write_map(ROOM, path)
    assert layer_of(path) is None
    save_layer(layer_path(path), KeyframeLayer(
        'map', ROOM.landmark_ids, ROOM.centers.astype(np.float32), CAMERA, np.eye(4)[None],
        np.array([0, 5]), np.zeros((5, 2), np.uint16), np.ones((5, 3), np.float32),
        np.ones((5, 128), np.uint8), np.zeros(5, np.uint16), np.ones((1, 128), np.uint8)))
    assert len(layer_of(path)) == 1
    assert capsys.readouterr().out == ''
    layer_path(path).write_bytes(b'no layer')
    assert layer_of(path) is None
    assert 'without keyframes: ' in capsys.readouterr().out
