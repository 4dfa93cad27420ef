# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scene import make_room

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import MapError
from cliploc_ros.ros.frame_localizer import load_map
from cliploc_ros.ros.parameters import RelocalizerParameters, map_files, path_of


def test_parameters_and_file_give_the_same_map(make_node, tmp_path):
    path, details = tmp_path / 'room.yaml', LandmarkDetails(
        labels=(('a red mug', 0.75), ('a cup: "hot"', 0.25)),
        class_weights=(('a', 0.6), ('cell phone', 0.4)))
    room = replace(make_room(), details=(details,) * 12)
    write_map(path, room)
    node = make_node(cli_args=['--ros-args', '--params-file', str(path)],
                     automatically_declare_parameters_from_overrides=True)
    of_parameters, _ = load_map(node, [])
    of_file, _ = load_map(node, [str(path)])
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


@pytest.fixture
def prefix(tmp_path, monkeypatch):
    """Create a workspace with the package my_maps."""
    marker = tmp_path / 'share/ament_index/resource_index/packages/my_maps'
    marker.parent.mkdir(parents=True)
    marker.touch()
    (tmp_path / 'share/my_maps').mkdir()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    return tmp_path


def test_paths_and_urls(prefix):
    share = prefix / 'share/my_maps'
    assert path_of('maps/office.yaml') == 'maps/office.yaml'
    assert path_of('file:///maps/office.yaml') == '/maps/office.yaml'
    assert path_of('package://my_maps/a/office.yaml') == f'{share}/a/office.yaml'
    assert map_files(RelocalizerParameters(map_file='package://my_maps/b.yaml')) == [
        f'{share}/b.yaml']
    assert map_files(RelocalizerParameters(map_files=['a.yaml', 'package://my_maps/b.yaml'])) == [
        'a.yaml', f'{share}/b.yaml']


@pytest.mark.parametrize(('url', 'message'), [
    ('package://nowhere/office.yaml', "package 'nowhere' is not found"),
    ('package://my_maps/', 'PACKAGE/PATH')])
def test_what_is_wrong_is_named(prefix, url, message):
    with pytest.raises(MapError, match=message):
        path_of(url)
