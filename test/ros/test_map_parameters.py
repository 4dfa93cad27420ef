# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scene import make_room, write_map

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.map_file import write_map as write_whole_map
from cliploc_ros.errors import MapError
from cliploc_ros.ros.map_parameters import load_map

CUP = {'label': 'a red cup', 'class_id': 'cup', 'center': [1.0, 2.0, 3.0],
       'semi_axes': [0.1, 0.2, 0.3], 'orientation': [0.0, 0.0, 0.0, 1.0]}


@pytest.fixture
def start_with(make_node):
    """Make a node as `--params-file` makes it."""
    def run(path):
        return make_node(cli_args=['--ros-args', '--params-file', str(path)],
                         automatically_declare_parameters_from_overrides=True)
    return run


@pytest.fixture
def load(start_with, tmp_path):
    """Load a map that stands in a node's parameters."""
    def run(tree):
        path = tmp_path / 'map.yaml'
        path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {'map': tree}}}))
        return load_map(start_with(path), [])
    return run


def test_parameters_and_file_give_the_same_map(start_with, tmp_path):
    path = tmp_path / 'room.yaml'
    write_map(make_room(), path)
    of_parameters = load_map(start_with(path), [])
    of_file = load_map(start_with(path), [str(path)])
    # rclpy hands parameters over in an order of its own
    rows = [of_parameters.landmark_ids.index(name) for name in of_file.landmark_ids]
    assert of_parameters.frame_id == of_file.frame_id == 'map'
    assert len(of_parameters) == len(of_file) == 12
    assert [of_parameters.labels[row] for row in rows] == list(of_file.labels)
    assert [of_parameters.class_ids[row] for row in rows] == list(of_file.class_ids)
    for field in ('centers', 'semi_axes', 'quats_xyzw'):
        np.testing.assert_array_equal(getattr(of_parameters, field)[rows],
                                      getattr(of_file, field))


def test_weighted_labels_and_class_weights_come_both_ways(start_with, tmp_path):
    room, path = make_room(), tmp_path / 'room.yaml'
    details = LandmarkDetails(labels=(('a red mug', 0.75), ('a cup: "hot"', 0.25)),
                              class_weights=(('a', 0.6), ('cell phone', 0.4)))
    write_whole_map(path, replace(room, details=(details,) * len(room)))
    for loaded in (load_map(start_with(path), []), load_map(start_with(path), [str(path)])):
        row = loaded.landmark_ids.index(room.landmark_ids[3])
        assert loaded.weighted_labels[row] == ((room.labels[3], 0.75), *details.labels)
        assert loaded.classes.sizes_of(loaded.classes.classes_of(['cell phone'])) == len(room)


def test_a_node_without_any_map_says_what_to_do(make_node):
    with pytest.raises(MapError, match='set map_file'):
        load_map(make_node(), [])


@pytest.mark.parametrize(('change', 'message'), [
    ({'center': [1.0, 2.0]}, "'cup_1': center: "),
    ({'center': [float('nan'), 0.0, 0.0]}, 'center: .*finite'),
    ({'colour': 'red'}, 'colour')])
def test_a_bad_landmark_is_named(load, change, message):
    with pytest.raises(MapError, match=message):
        load({'frame_id': 'map', 'landmarks': {'cup_1': CUP | change}})


def test_a_value_beside_its_own_fields_is_named(make_node):
    node = make_node()
    node.declare_parameter('map.frame_id', 'map')
    node.declare_parameter('map.frame_id.name', 'map')
    with pytest.raises(MapError, match="'frame_id' has both"):
        load_map(node, [])
