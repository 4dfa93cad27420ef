# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter files of several robots: a node gets the same parameters as from ROS."""

import pytest
import yaml

from cliploc_ros.errors import OptionsError
from cliploc_ros.ros.running import parameters_of_files


def of(value):
    return {'ros__parameters': {'k': value, 'map': {'frame_id': f'frame_{value}'}}}


FILES = {
    'two robots': {'/a/relocalizer': of(1), '/b/relocalizer': of(2)},
    'nested namespaces': {'a': {'relocalizer': of(1)}, 'b': {'c': {'relocalizer': of(2)}}},
    'namespaces in a key': {'b/c': {'relocalizer': of(3)}, 'a': {'relocalizer': of(1)}},
    'everywhere': {'/**': of(1), '/b/relocalizer': of(2)},
    'any namespace': {'/**/relocalizer': of(1), '/**/detector': of(2)},
    'one word': {'/*/relocalizer': of(1), '/b/*': of(2)},
    'a namespace': {'/b/**': of(1), '/a/**': of(2)},
    'no namespace': {'relocalizer': of(1)}}


@pytest.mark.parametrize('name', ['/relocalizer', '/a/relocalizer', '/b/relocalizer',
                                  '/b/c/relocalizer'])
@pytest.mark.parametrize('content', FILES.values(), ids=list(FILES))
def test_a_node_has_the_parameters_that_ros_gives_to_it(make_node, tmp_path, content, name):
    file = tmp_path / 'robots.yaml'
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    namespace, _, base = name.rpartition('/')
    node = make_node(base, namespace=namespace, automatically_declare_parameters_from_overrides=
                     True, start_parameter_services=False,
                     cli_args=['--ros-args', '--params-file', str(file)])
    given = {key: node.get_parameter(key).value for key in ('k', 'map.frame_id')
             if node.has_parameter(key)}
    if given:
        found = parameters_of_files([file], name)
        assert {parameter.name: parameter.value for parameter in found} == given
    else:
        with pytest.raises(OptionsError, match='--relocalizer'):
            parameters_of_files([file], name)
