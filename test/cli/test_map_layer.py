# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``build_map --keyframe-layer``: what it refuses, and the written file."""

from pathlib import Path

import numpy as np

from cliploc_ros.cli.build_map import make_parser
from cliploc_ros.cli.options import layer_options
from cliploc_ros.cli.sources import read_frames
from cliploc_ros.core.keyframes.layer import load_layer_of_map
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.map_recording import MapRecording
from cliploc_ros.offline.mapping.make_map import MadeMap, write_made_map
from cliploc_ros.offline.recording.keyframe_layer import build_layer

ASSETS = Path(__file__).resolve().parents[2] / 'demo/assets'
WALK = ['--tum', str(ASSETS / 'mapping')]


def test_a_walk_gives_a_layer_next_to_its_map(tmp_path):
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    options = make_parser().parse_args([
        *WALK, '--keyframe-layer', '--keyframe-points', '100', '--out', str(tmp_path / 'a.yaml')])
    wanted, note = layer_options(options)
    assert not note
    made = build_layer(read_frames(options), landmark_map, wanted)
    line, = write_made_map(options.out, MadeMap(landmark_map, None, layer=made), [],
                           MapRecording(tmp_path / 'a.npz'))
    layer = load_layer_of_map(tmp_path / 'a.keyframes.npz', landmark_map)
    assert line.startswith(f'keyframes: {len(layer)} with {len(layer.points)} points, ')
    assert len(layer) >= 20
    assert np.diff(layer.offsets).max() <= 100
    for declined, why in (('--no-keyframe-layer', ''), ('--every=2', 'no keyframes with --every')):
        without = make_parser().parse_args([*WALK, declined, '--out', str(tmp_path / 'b.yaml')])
        layer, note = layer_options(without)
        assert layer is None and note.startswith(why)
