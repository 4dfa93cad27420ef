# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer that is started wrongly says so, lives, and works once it is mended."""


import pytest
from tester import make_frame


@pytest.mark.parametrize(('parameters', 'reason'), [
    ({'matching': 'magic'}, "matching: 'magic'"),
    ({'iterations': 'x'}, 'iterations: '),
    ({'map_file': '/nowhere/map.yaml'}, '/nowhere/map.yaml: '),
    ({'matching': 'hybrid', 'algorithm': 'b-prosac', 'k': 13}, 'k = 13')])
def test_bad_parameters_at_start_up(own_relocalizer, tester, parameters, reason):
    process = own_relocalizer(expect='[ERROR]', **parameters)
    answer = tester.answer(tester.ask())
    assert not answer.success
    assert reason in answer.message, answer.message
    assert process.alive
    assert 'Traceback' not in process.output()


def test_a_mended_parameter_mends_the_node(own_relocalizer, tester):
    own_relocalizer(expect='[ERROR]', algorithm='luck')
    assert not tester.answer(tester.ask()).success
    assert tester.set_parameter('algorithm', 'bf').successful
    assert tester.relocalize(make_frame()).success


def test_a_mended_map_mends_the_node(own_relocalizer, tester, room_map, tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(room_map.read_text().replace('semi_axes', 'half_axes'))
    own_relocalizer(expect='unknown field: half_axes', map_file=path)
    assert not tester.answer(tester.ask()).success
    path.write_text(room_map.read_text())
    assert tester.relocalize(make_frame()).success
