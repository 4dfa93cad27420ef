# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the keyframes next to a map reach: in the check's report, its page and its advice."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scene import make_layer, make_room
from scipy.spatial.transform import Rotation

from cliploc_ros.cli.check_map import main
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.offline.mapping.check.advice import give_advice
from cliploc_ros.offline.mapping.check.checking import check_map
from cliploc_ros.offline.mapping.check.report import check_keyframes, in_reach
from cliploc_ros.offline.mapping.options import CheckOptions

ROOM = make_room()
#: The camera looks along x, z is up.
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def layer_at(*poses):
    return replace(make_layer(ROOM, len(poses), points=5), map_from_camera=np.array(poses))


def view(x=0.0, degrees=0.0):
    turn = Rotation.from_euler('z', degrees, degrees=True).as_matrix()
    return make_transform(turn @ LEVEL, np.array([x, 0.0, 1.0]))


@pytest.mark.parametrize(('x', 'degrees', 'reached'), [
    (0.0, 0.0, True), (1.9, 0.0, True), (2.1, 0.0, False), (0.0, 39.0, True), (0.0, -41.0, False),
    (0.9, 20.0, True), (1.1, 20.0, False), (0.0, 180.0, False)])
def test_reach_is_near_and_in_the_same_direction(x, degrees, reached):
    here = view(x, degrees)
    assert in_reach(layer_at(view()), here[None, :3, 3], here[None, :3, 2]) == [reached]


@pytest.fixture(scope='module')
def report():
    return check_map(ROOM, options=CheckOptions(max_positions=6, headings=4))


def test_places_without_a_keyframe_are_counted_and_named(report):
    grid = report.grid
    everywhere = layer_at(*(make_transform(
        Rotation.from_euler('z', angle, degrees=True).as_matrix() @ LEVEL, place)
        for place in grid.positions for angle in range(0, 360, 30)))
    full = check_keyframes(everywhere, grid, np.array([view(), view(50.0)]))
    assert full.reached_positions == 1.0 and not len(full.without)
    assert (full.headings == grid.headings).all()
    nowhere = check_keyframes(layer_at(view(500.0)), grid, np.array([view(), view(500.0)]))
    assert nowhere.reached_positions == 0.0
    assert nowhere.recorded.tolist() == [False, True]
    assert len(nowhere.without) == len(grid.positions)
    assert len(nowhere.as_dict()['positions_without']) == len(grid.positions)
    assert nowhere.as_dict()['recorded_frames_in_reach'] == 0.5
    text = 'no keyframe is'
    assert any(text in one.text for one in give_advice(replace(report, keyframes=nowhere)))
    assert not any(text in one.text for one in give_advice(replace(report, keyframes=full)))
    by_keyframes = replace(report, keyframes=full, grid=replace(grid, accepted=0 * grid.accepted))
    assert any('only keyframes' in one.text for one in give_advice(by_keyframes))


def test_the_report_has_keyframes_only_where_there_are_some(tmp_path, run_here):
    write_map(tmp_path / 'room.yaml', ROOM)
    given = [tmp_path / 'room.yaml', '--positions', '4', '--headings', '2',
             '--min-positions', '0', '--out', tmp_path / 'out']
    done = run_here(main, *given, '--keyframes')
    assert done.returncode == 1 and 'room.keyframes.npz:' in done.stderr
    assert run_here(main, *given).returncode == 0
    assert json.loads((tmp_path / 'out/check.json').read_text())['keyframes'] is None
    save_layer(layer_path(tmp_path / 'room.yaml'), layer_at(view(), view(1.0)))
    done = run_here(main, *given)
    assert done.returncode == 0 and 'keyframes: 2 with' in done.stdout
    assert json.loads((tmp_path / 'out/check.json').read_text())['keyframes']['points'] == 10
    assert '2 with 10 points' in (tmp_path / 'out/check.html').read_text()
