# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places of a map: a path, a file:// URL, or a file of an installed package."""

import pytest

from cliploc_ros.errors import MapError
from cliploc_ros.ros.parameters import RelocalizerParameters, map_files, path_of


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
