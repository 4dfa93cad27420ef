# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map in a node's parameters, where `--params-file map.yaml` puts it."""

from typing import Any

from rclpy.node import Node

from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError

_PREFIX = 'map.'


def load_map(node: Node, map_file: str) -> LandmarkMap:
    """Return the map of a file, or of the node's own parameters where no file is given.

    Raises
    ------
    MapError
        Names the source, the landmark and the field to fix.
    """
    if map_file:
        return LandmarkMap.from_file(map_file)
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
