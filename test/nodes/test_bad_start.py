# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A relocalizer with a bad start reports it, stays alive, and works once it is fixed."""


import pytest
from tester import make_frame


@pytest.mark.parametrize(('name', 'value', 'right'), [
    ('algorithm', 'luck', 'bf'), ('iterations', 'x', 1000)])
def test_a_mended_parameter_mends_the_node(own_relocalizer, tester, name, value, right):
    process = own_relocalizer(expect='[ERROR]', **{name: value})
    answer = tester.answer(tester.ask())
    assert not answer.success and f'{name}: ' in answer.message
    assert tester.set_parameter(name, right).successful
    assert tester.relocalize(make_frame()).success
    assert 'Traceback' not in process.output()


def test_a_mended_map_mends_the_node(own_relocalizer, tester, room_map, tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text(room_map.read_text().replace('semi_axes', 'half_axes'))
    own_relocalizer(expect='unknown field: half_axes', map_file=path)
    assert not tester.answer(tester.ask()).success
    path.write_text(room_map.read_text())
    assert tester.relocalize(make_frame()).success
