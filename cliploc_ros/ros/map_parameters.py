# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The maps of a node: in files, or in its parameters, where `--params-file map.yaml` puts one."""

from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node

from cliploc_ros.core.maps.joined_map import join_maps
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.ros.map_urls import path_of

_PREFIX = 'map.'


def map_files(values: Mapping[str, Any]) -> list[str]:
    """Return the paths of the files that the parameters map_file and map_files name.

    Raises
    ------
    OptionsError
        Both parameters name files.
    MapError
        A URL names a package that is not installed.
    """
    several = [name for name in values['map_files'] if name]
    if several and values['map_file']:
        raise OptionsError("map_file and map_files both name files: set map_file to '' to search "
                           'all of map_files')
    return [path_of(name) for name in several or [values['map_file']] if name]


def load_map(node: Node, files: Sequence[str]) -> LandmarkMap:
    """Return the map of files, or of the node's own parameters where no file is given.

    Raises
    ------
    MapError
        Names the source, the landmark and the field to fix.
    """
    if files:
        return join_maps([LandmarkMap.from_file(file) for file in files], files)
    parameters = node.get_parameters_by_prefix('map')
    if not parameters:
        raise MapError('no map: set map_file, or load a map with --params-file')
    tree: dict[str, Any] = {}
    for name, parameter in parameters.items():
        _insert(tree, name.split('.'), parameter.value)
    return LandmarkMap.from_mapping(tree, 'parameters')


def _insert(tree: dict[str, Any], path: list[str], value: Any) -> None:
    """Insert a value at its dotted name."""
    for key in path[:-1]:
        branch = tree.setdefault(key, {})
        if not isinstance(branch, dict):
            raise MapError(f"parameters: {_PREFIX}{'.'.join(path)}: '{key}' has both a value "
                           'and fields')
        tree = branch
    tree[path[-1]] = value
