# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter services: a dump starts an equal node, and the map is read again."""


import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from tester import class_matching, make_frame


def dump(tester, name):
    """Return the parameters of a node by name."""
    names = tester.call(ListParameters, f'/{name}/list_parameters',
                        ListParameters.Request()).result.names
    values = tester.call(GetParameters, f'/{name}/get_parameters',
                         GetParameters.Request(names=names)).values
    return dict(zip(names, map(parameter_value_to_python, values), strict=True))


def write_dump(values, name, path):
    """Write parameters as `ros2 param dump` does, a level for each part of a name."""
    tree = {}
    for parameter, value in values.items():
        *folders, leaf = parameter.split('.')
        branch = tree
        for folder in folders:
            branch = branch.setdefault(folder, {})
        branch[leaf] = value
    path.write_text(yaml.safe_dump({f'/{name}': {'ros__parameters': tree}}))


def test_a_dump_starts_the_same_relocalizer(start, tester, room_map, tmp_path):
    first = start('nodes.relocalizer', '--ros-args', '--params-file', room_map, parameters={
        **class_matching("''"), 'timeout_s': 30, 'random_seed': -1, 'base_frame': 'base_link',
        'base_from_camera': '[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]'})
    first.wait_for_output('12 landmarks')
    tester.connect()
    assert tester.relocalize(make_frame()).success  # declares what subscriptions declare
    assert tester.set_parameter('k', 5).successful
    dumped = dump(tester, 'relocalizer')
    assert first.stop()[0] == 0
    tester.wait(lambda: tester.count_publishers('/relocalizer/pose') == 0, 'its end')

    path = tmp_path / 'dump.yaml'
    write_dump(dumped, 'relocalizer', path)
    second = start('nodes.relocalizer', '--ros-args', '--params-file', path)
    second.wait_for_output('12 landmarks')
    tester.connect()
    again = dump(tester, 'relocalizer')
    assert {name: again[name] for name in dumped} == dumped
    assert again['k'] == 5
    assert tester.relocalize(make_frame()).success
    assert 'unknown parameter' not in second.output()
