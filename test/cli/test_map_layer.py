# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``build_map --keyframe-layer``: what it refuses, and the file that it writes."""

from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.cli.build_map import main, make_parser
from cliploc_ros.cli.map_layer import layer_input, write_layer
from cliploc_ros.core.keyframes.layer import layer_path, load_layer_of_map, remove_layer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError, MappingError
from cliploc_ros.recording.keyframe_layer import build_layer

ASSETS = Path(__file__).resolve().parents[2] / 'cliploc_ros/demo/assets'
WALK = ['--tum', str(ASSETS / 'mapping')]


@pytest.mark.parametrize('others', [
    ['--observations', 'none.npz'], [*WALK, '--update', 'old.yaml'], [*WALK, '--refine-mount'],
    [*WALK, '--every', '2']])
def test_options_that_do_not_go_together_are_refused_at_once(tmp_path, capsys, others):
    out = tmp_path / 'map.yaml'
    assert main([*others, '--keyframe-layer', '--out', str(out)]) == 1
    assert '--keyframe-layer is not for' in capsys.readouterr().err
    assert not out.exists()


def test_images_without_a_layer_are_refused(tmp_path, capsys):
    out = tmp_path / 'map.yaml'
    assert main([*WALK, '--keyframe-images', '--out', str(out)]) == 1
    assert '--keyframe-images is for --keyframe-layer' in capsys.readouterr().err


def test_a_walk_gives_a_layer_next_to_its_map(tmp_path):
    landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
    options = make_parser().parse_args([
        *WALK, '--keyframe-layer', '--keyframe-points', '100', '--out', str(tmp_path / 'a.yaml')])
    frames, wanted = layer_input(options)
    line = write_layer(options.out, build_layer(frames, landmark_map, wanted))
    layer = load_layer_of_map(tmp_path / 'a.keyframes.npz', landmark_map)
    assert line.startswith(f'keyframes: {len(layer)} with {len(layer.points)} points, ')
    assert len(layer) >= 20
    assert np.diff(layer.offsets).max() <= 100
    without = make_parser().parse_args([*WALK, '--out', str(tmp_path / 'b.yaml')])
    assert layer_input(without) == (None, None)


def test_images_that_do_not_overlap_give_an_error(tmp_path):
    options = make_parser().parse_args([*WALK, '--keyframe-layer', '--keyframes', '50', '360',
                                        '--out', str(tmp_path / 'a.yaml')])
    with pytest.raises(MappingError, match='no keyframe: of 1 images none has'):
        frames, wanted = layer_input(options)
        build_layer(frames, LandmarkMap.from_file(ASSETS / 'map.yaml'), wanted)


def test_the_layer_of_a_map_that_is_replaced_is_removed(tmp_path):
    layer = layer_path(tmp_path / 'a.yaml')
    layer.touch()
    assert remove_layer(tmp_path / 'a.yaml') == (
        f'removed {layer}: its keyframes belonged to the map before')
    assert remove_layer(tmp_path / 'a.yaml') == ''
    layer.mkdir()
    with pytest.raises(MapError, match='cannot be removed: Is a directory; remove it'):
        remove_layer(tmp_path / 'a.yaml')
