# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map file as it was read, and the same file with other landmarks."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cliploc_ros.core.maps.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import replace_file
from cliploc_ros.studio.landmark import Landmark, map_of
from cliploc_ros.studio.map_text import patch_landmarks, write_tree

_PARAMETERS = 'ros__parameters'
#: The digest of a file that does not exist.
NO_FILE = ''


class ChangedOnDiskError(MapError):
    """Another program changed the map file; ``found`` is the digest of what it holds now."""

    def __init__(self, path: Path, found: str):
        super().__init__(f'{path}: another program changed this file after the studio read it; '
                         'overwrite it, or reload it')
        self.found = found


@dataclass(frozen=True)
class MapSource:
    """A map file.

    Parameters
    ----------
    path : Path
    text, digest : str
        Of the file; both are empty where there is none.
    node : str
        The key in the file whose parameters hold the map.
    tree : mapping
        The whole file.
    """

    path: Path
    text: str
    digest: str
    node: str
    tree: Mapping[str, Any]

    @property
    def frame_id(self) -> str:
        """Return the coordinate frame of the map."""
        return str(self._map['frame_id'])

    @property
    def landmarks(self) -> dict[str, Landmark]:
        """Return the landmarks by id."""
        return {key: Landmark(fields) for key, fields in self._map['landmarks'].items()}

    @property
    def _map(self) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.tree[self.node][_PARAMETERS]['map']
        return found

    def with_landmarks(self, landmarks: Mapping[str, Landmark]) -> 'MapSource':
        """Return the file with other landmarks, not yet written."""
        old = self._map['landmarks']
        # undo puts a deleted landmark last; in the file it keeps its place
        order = [*(key for key in old if key in landmarks),
                 *(key for key in landmarks if key not in old)]
        new = {key: landmarks[key].fields for key in order}
        tree = {**self.tree, self.node: {**self.tree[self.node], _PARAMETERS: {
            **self.tree[self.node][_PARAMETERS], 'map': {**self._map, 'landmarks': new}}}}
        text = ''
        if self.text:
            with suppress(LookupError, ValueError, yaml.YAMLError):
                text = patch_landmarks(self.text, (self.node, _PARAMETERS, 'map', 'landmarks'),
                                       old, new)
        text = text or write_tree(tree)
        return MapSource(self.path, text, digest_of(text.encode()), self.node, tree)

    def write(self) -> 'MapSource':
        """Write the file in one step, and return it as it was written.

        Raises
        ------
        MapError
            It cannot be written; nothing was changed.
        """
        try:
            with replace_file(self.path) as partial:
                partial.write_bytes(self.text.encode())
                written = self
                if not _says(partial, self.tree):
                    text = write_tree(self.tree)
                    written = MapSource(self.path, text, digest_of(text.encode()), self.node,
                                        self.tree)
                    partial.write_bytes(text.encode())
                    if not _says(partial, self.tree):
                        raise MapError(f'{self.path}: holds fields that cannot be written again; '
                                       'nothing was changed')
        except OSError as error:
            raise MapError(f'{self.path}: cannot be written: {error.strerror}; nothing was '
                           'changed') from error
        return written


def _says(path: Path, tree: Mapping[str, Any]) -> bool:
    """Return whether a file holds a tree; where both hold NaN, that is equal, too."""
    try:
        return repr(_sorted(read_parameter_file(path))) == repr(_sorted(tree))
    except MapError:
        return False


def _sorted(tree: Any) -> Any:
    """Return a tree with sorted keys, tuples as lists, and 1 as 1.0, which mean the same."""
    if isinstance(tree, Mapping):
        return {key: _sorted(tree[key]) for key in sorted(tree)}
    if isinstance(tree, list | tuple):
        return [_sorted(one) for one in tree]
    return float(tree) if isinstance(tree, int) and not isinstance(tree, bool) else tree


def digest_of(content: bytes) -> str:
    """Return what tells one content of a file from another."""
    return hashlib.sha256(content).hexdigest()


def digest_on_disk(path: Path) -> str:
    """Return the digest of a file as it is now, NO_FILE where there is none.

    Raises
    ------
    MapError
        It cannot be read.
    """
    try:
        return digest_of(path.read_bytes())
    except FileNotFoundError:
        return NO_FILE
    except OSError as error:
        raise MapError(f'{path}: {error.strerror}') from error


def read_source(path: Path) -> MapSource:
    """Return a map file; an empty map where there is none.

    Raises
    ------
    MapError
        It is no map, or a landmark is invalid. Unknown fields of landmarks are accepted.
    """
    path = path.resolve()
    if not path.exists():
        return MapSource(path, '', NO_FILE, '/**', {'/**': {_PARAMETERS: {'map': {
            'frame_id': 'map', 'landmarks': {}}}}})
    tree = read_parameter_file(path)
    try:
        text = path.read_bytes().decode('utf-8')
    except OSError as error:
        raise MapError(f'{path}: {error.strerror}') from error
    nodes = [name for name, node in tree.items() if isinstance(node, dict)
             and isinstance(node.get(_PARAMETERS), dict) and 'map' in node[_PARAMETERS]]
    if len(nodes) != 1:
        raise MapError(f"{path}: {'no' if not nodes else 'more than one'} map: expected one "
                       "'map' under '/**: ros__parameters:'")
    source = MapSource(path, text, digest_of(text.encode()), nodes[0], tree)
    _check(source)
    return source


def _check(source: MapSource) -> None:
    found = source._map
    if not isinstance(found, Mapping) or not isinstance(found.get('landmarks'), Mapping):
        raise MapError(f'{source.path}: map: expected the fields frame_id, landmarks')
    for landmark_id, fields in found['landmarks'].items():
        if not isinstance(fields, Mapping):
            raise MapError(f"{source.path}: landmark '{landmark_id}': expected fields, "
                           f'not {fields!r}'[:200])
    map_of(source.landmarks, found.get('frame_id') or '', str(source.path))
