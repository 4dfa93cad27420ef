# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer that searches two floors, and whose maps change at run time."""

import importlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene import make_layer, make_room, see_room, write_map
from stand_ins import Nav2
from tester import make_frame

from cliploc_ros.core.keyframes.layer import layer_path, save_layer

ROOM = make_room()


def other_room():
    rng = np.random.default_rng(1)
    return replace(ROOM, centers=np.c_[rng.uniform(-2, 2, (12, 2)), rng.uniform(3, 6, 12)])


@pytest.fixture
def floors(tmp_path):
    """Write the maps of two floors; return their files."""
    files = [tmp_path / f'{number}.yaml' for number in range(2)]
    for number, (one, file) in enumerate(zip((ROOM, other_room()), files, strict=True)):
        write_map(replace(one, frame_id=f'floor_{number}'), file)
    return list(map(str, files))


def test_maps_change_while_the_node_runs_and_each_floor_has_its_own_frame(relocalizer, tester,
                                                                          floors, room_map):
    """A bad list changes nothing; one map is replaced, and restored."""
    first, second = floors
    there = make_frame(see_room(other_room()))

    def reloaded(**parameters):
        """Set parameters; return whether the maps could be reloaded."""
        assert all(tester.set_parameter(*parameter).successful for parameter in parameters.items())
        return tester.trigger('reload_map').success
    assert not tester.relocalize(there).success
    assert not reloaded(map_files=[first, second]), 'map_file is set, too'
    assert reloaded(map_file='')
    assert "24 landmarks in 2 maps, frames 'floor_0', 'floor_1'" in relocalizer.output()
    for bad in ([first, first], [first, '/nowhere.yaml']):
        assert not reloaded(map_files=bad)
    for number, room in enumerate((ROOM, other_room())):
        tester.forget()
        answer = tester.relocalize(make_frame(see_room(room), stamp_s=100.0 + number))
        assert answer.success, answer.message
        assert f' m in floor_{number}, ' in answer.message
        tester.wait(lambda: tester.poses, 'a pose')
        assert tester.poses[-1].header.frame_id == f'floor_{number}'
        assert tester.poses[-1].pose.pose.position.x == pytest.approx(0.3, abs=0.05)
    assert reloaded(map_files=[''], map_file=str(room_map))
    assert not tester.relocalize(there).success


def test_keyframes_of_all_floors_are_used_or_none(relocalizer, tester, floors, room_map):
    """A layer of one floor alone is named in the log; a place may look the same on the other."""
    rooms = [replace(room, frame_id=f'floor_{number}')
             for number, room in enumerate((ROOM, other_room()))]
    assert tester.set_parameter('map_file', '').successful
    assert tester.set_parameter('map_files', floors).successful
    for room, file, text in zip(rooms, floors, (
            '1.keyframes.npz: several maps need a layer each', '12 keyframes, '),
            strict=True):
        save_layer(layer_path(file), make_layer(room))
        assert tester.trigger('reload_map').success
        relocalizer.wait_for_output(text)
        tester.forget()
        answer = tester.relocalize(make_frame(see_room(ROOM)))
        assert answer.success, answer.message
        assert ' m in floor_0, ' in answer.message
    for name, value in (('map_files', ['']), ('map_file', str(room_map))):
        assert tester.set_parameter(name, value).successful


@pytest.mark.needs('nav2_msgs')
def test_nav2_follows_to_the_floor_and_not_during_a_ride(own_relocalizer, tester, floors):
    for number, (room, file) in enumerate(zip((ROOM, other_room()), floors, strict=True)):
        write_map(replace(room, frame_id=f'floor_{number}', nav2_map=f'grids/{number}.yaml'),
                  Path(file))
    own_relocalizer(map_file="''", map_files=f'[{", ".join(floors)}]', timeout_s=5.0)
    nav2, cabin, expected = Nav2(tester), see_room(ROOM).select(np.array([0, 1])), []
    for number in (0, 1, 0):
        assert not tester.relocalize(make_frame(cabin)).success
        assert nav2.order == expected
        answer = tester.relocalize(make_frame(see_room((ROOM, other_room())[number])))
        assert answer.success and f' m in floor_{number}, ' in answer.message, answer.message
        expected += [str(number), 'global', 'local', 'pose in map']
    assert nav2.order == expected


@pytest.fixture
def load(tester):
    """Load a map as Nav2's map server does; return the result."""
    srv = importlib.import_module('nav2_msgs.srv')
    return lambda url: tester.call(srv.LoadMap, 'relocalizer/load_map',
                                   srv.LoadMap.Request(map_url=url)).result


@pytest.mark.needs('nav2_msgs')
def test_a_map_is_loaded_as_nav2_loads_its_own(relocalizer, tester, floors, load, tmp_path):
    results = importlib.import_module('nav2_msgs.srv').LoadMap.Response
    assert tester.set_parameter('map_file', floors[1]).successful
    assert tester.trigger('reload_map').success
    for url in ('/nowhere.yaml', 'package://nowhere/map.yaml'):
        assert load(url) == results.RESULT_MAP_DOES_NOT_EXIST
    (tmp_path / 'broken.yaml').write_text('no map')
    assert load(str(tmp_path / 'broken.yaml')) == results.RESULT_INVALID_MAP_DATA
    assert tester.relocalize(make_frame(see_room(other_room()))).success
    assert load(f'file://{floors[0]}') == results.RESULT_SUCCESS
    assert tester.relocalize(make_frame()).success
    assert not tester.relocalize(make_frame(see_room(other_room()))).success


@pytest.mark.full
@pytest.mark.needs('nav2_msgs')
def test_no_url_keeps_the_relocalizer_from_answering(relocalizer, tester, floors, load, tmp_path):
    """Pipes, devices, sparse files, floods, and impossible names."""
    os.mkfifo(tmp_path / 'pipe')
    with (tmp_path / 'holes').open('wb') as file:
        file.truncate(3 * 2**30)
    (tmp_path / 'flood').write_text(f'a: [{"[]," * 1_600_000}1]')
    for url in (*(str(tmp_path / name) for name in (
            'pipe', 'holes', 'flood', '', 'x' * 300, 'x' * 1_000_000)), '/dev/zero', '/dev/stdin',
            'package://', 'package://nowhere/map.yaml', f'package://{"x" * 300}/map.yaml'):
        assert load(url) != 0, url[:80]
    assert load(floors[0]) == 0
    assert tester.relocalize(make_frame()).success
    assert relocalizer.memory_mib('VmHWM') < 1000
    assert max(map(len, relocalizer.output().splitlines())) < 2000
