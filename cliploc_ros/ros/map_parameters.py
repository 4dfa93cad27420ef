# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The maps of a node: in files, or in its parameters, where `--params-file map.yaml` puts one."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.node import Node

from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.ros.parameters import RelocalizerParameters

_FILE, _PACKAGE = 'file://', 'package://'
_PREFIX = 'map.'
_DIGITS = 12
# A file that is replaced while it is read is read again.
_ATTEMPTS = 3


def path_of(name: str) -> str:
    """Return the path of a map.

    Parameters
    ----------
    name : str
        A path; ``file:///PATH``; or ``package://PACKAGE/PATH``, a path in the package's share
        folder, as in URDF files.

    Raises
    ------
    MapError
        The package is not installed, or the URL names no file in it.
    """
    if not name.startswith(_PACKAGE):
        return name.removeprefix(_FILE)
    package, _, path = name.removeprefix(_PACKAGE).partition('/')
    if not package or not path:
        raise MapError(f'{name}: no package://PACKAGE/PATH, such as package://my_maps/office.yaml')
    try:
        return str(Path(get_package_share_directory(package)) / path)
    except (LookupError, ValueError) as error:
        raise MapError(f"{name}: there is no package '{package}' here: install it, or source "
                       'the workspace that has it') from error


def map_files(parameters: RelocalizerParameters) -> list[str]:
    """Return the paths of the files that the parameters map_file and map_files name.

    Raises
    ------
    OptionsError
        Both parameters name files.
    MapError
        A URL names a package that is not installed.
    """
    several = [name for name in parameters.map_files if name]
    if several and parameters.map_file:
        raise OptionsError("map_file and map_files both name files: set map_file to '' to search "
                           'all of map_files')
    return [path_of(name) for name in several or [parameters.map_file] if name]


def load_map(node: Node, files: Sequence[str]) -> LandmarkMap:
    """Return the map of files, or of the node's own parameters where no file is given.

    MapError: names the source, the landmark and the field to fix.
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


def load_hashed_map(node: Node, files: Sequence[str]) -> tuple[LandmarkMap, str]:
    """Load one map or several and return them with their hash.

    The hash is the beginning of what `cat FILE... | sha256sum` prints. A map in parameters has
    the hash of its landmarks.

    MapError: see load_map; or a file changes again and again.
    """
    for _ in range(_ATTEMPTS):
        before = _hash_of(files)
        landmark_map = load_map(node, files)
        if not files:
            content = b''.join([
                repr((landmark_map.frame_id, landmark_map.landmark_ids, landmark_map.labels,
                      landmark_map.class_ids)).encode(),
                landmark_map.centers.tobytes(), landmark_map.semi_axes.tobytes(),
                landmark_map.quats_xyzw.tobytes()])
            return landmark_map, _hash(content)
        if before == _hash_of(files):
            return landmark_map, before
    raise MapError(f'{", ".join(files)}: changes while it is read: write another file and '
                   'rename it')


def _hash_of(files: Sequence[str]) -> str:
    """Return the hash of files; empty where load_map says what is wrong."""
    try:
        return _hash(b''.join(Path(file).read_bytes() for file in files))
    except (OSError, ValueError):
        return ''


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
