# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer that is started wrongly says so, lives, and works once it is mended."""

import re

import pytest
from processes import PROJECT, wait_for
from rcl_interfaces.srv import GetParameters
from tester import make_frame


@pytest.mark.parametrize(('parameters', 'reason'), [
    ({'matching': 'magic'}, "matching: 'magic' is none of class, clip, hybrid"),
    ({'algorithm': 'lcuk'}, "algorithm: 'lcuk' is none of"),
    ({'iterations': '0'}, 'iterations: 0 must be 1 to'),
    ({'iterations': 'x'}, 'iterations: must be of type int'),
    ({'map_file': '/nowhere/map.yaml'}, '/nowhere/map.yaml: No such file'),
    ({'map_file': "''"}, 'no map: set map_file'),
    ({'matching': 'hybrid', 'algorithm': 'b-prosac', 'clip_pretrained': '/nowhere.pt'},
     '/nowhere.pt'),
    ({'matching': 'hybrid', 'algorithm': 'b-prosac', 'clip_model': 'ViT-L-41'}, 'ViT-L-14'),
    ({'matching': 'hybrid', 'algorithm': 'b-prosac', 'k': 13}, 'k = 13, but the map has 12'),
])
def test_bad_parameters_at_start_up(own_relocalizer, tester, parameters, reason):
    process = own_relocalizer(expect='[ERROR]', **parameters)
    answer = tester.answer(tester.ask())
    assert not answer.success
    assert reason in answer.message, answer.message
    assert process.alive
    assert 'Traceback' not in process.output()


@pytest.mark.parametrize('node', ['detector', 'relocalizer'])
def test_help_tells_of_a_node_and_starts_none(start, node):
    process = start(f'nodes.{node}', '--help', '--ros-args', '-r', '__node:=other')
    wait_for(lambda: not process.alive, 'the end')
    told = process.output()
    assert process.stop()[0] == 0
    assert told.startswith(f'usage: ros2 run cliploc_ros {node} ')
    (config,) = re.findall(r'config/\w+\.yaml', told)
    assert (PROJECT / config).is_file()
    names = re.findall(r'[\w~/]+(?=[,;\n])', ' '.join(re.findall(
        r'^  (?:in|out|services) +(.*\n(?: {13}.*\n)*)', told, re.MULTILINE)))
    assert len(names) >= 4
    page = (PROJECT / 'doc/interface.md').read_text()
    assert [name for name in names if f'`{name}`' not in page] == []


def test_a_mended_parameter_mends_the_node(own_relocalizer, tester):
    own_relocalizer(expect='[ERROR]', algorithm='luck')
    assert 'ros2 param set relocalizer algorithm' in tester.answer(tester.ask()).message
    assert tester.set_parameter('algorithm', 'bf').successful
    assert tester.relocalize(make_frame()).success


def test_a_mended_map_mends_the_node(own_relocalizer, tester, room_map, tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(room_map.read_text().replace('semi_axes', 'half_axes'))
    own_relocalizer(expect='unknown field: half_axes', map_file=path)
    assert 'unknown field: half_axes' in tester.answer(tester.ask()).message
    path.write_text(room_map.read_text())
    assert tester.relocalize(make_frame()).success


def test_mistyped_names_and_whole_numbers(own_relocalizer, tester):
    process = own_relocalizer(timeout_s=3, itterations=100)
    request = GetParameters.Request(names=['timeout_s'])
    answer = tester.call(GetParameters, '/relocalizer/get_parameters', request)
    assert answer.values[0].double_value == 3.0
    assert "unknown parameter 'itterations' has no effect (did you mean 'iterations'?)" in (
        process.output())
