# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scene import make_room

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.ros.frame_localizer import load_map


@pytest.fixture
def start_with(make_node):
    """Make a node as with `--params-file`."""
    def run(path):
        return make_node(cli_args=['--ros-args', '--params-file', str(path)],
                         automatically_declare_parameters_from_overrides=True)
    return run


def test_parameters_and_file_give_the_same_map(start_with, tmp_path):
    path, details = tmp_path / 'room.yaml', LandmarkDetails(
        labels=(('a red mug', 0.75), ('a cup: "hot"', 0.25)),
        class_weights=(('a', 0.6), ('cell phone', 0.4)))
    room = replace(make_room(), details=(details,) * 12)
    write_map(path, room)
    of_parameters, _ = load_map(start_with(path), [])
    of_file, _ = load_map(start_with(path), [str(path)])
    # rclpy passes parameters in arbitrary order
    again = of_parameters.select([of_parameters.landmark_ids.index(name)
                                  for name in of_file.landmark_ids])
    for name in ('frame_id', 'landmark_ids', 'labels', 'class_ids', 'details'):
        assert getattr(again, name) == getattr(of_file, name) == getattr(room, name)
    for name in ('centers', 'semi_axes', 'quats_xyzw'):
        np.testing.assert_array_equal(getattr(again, name), getattr(of_file, name))
    for loaded in (of_parameters, of_file):
        row = loaded.landmark_ids.index(room.landmark_ids[3])
        assert loaded.weighted_labels[row] == ((room.labels[3], 0.75), *details.labels)
        assert loaded.classes.sizes_of(loaded.classes.classes_of(['cell phone'])) == len(room)
