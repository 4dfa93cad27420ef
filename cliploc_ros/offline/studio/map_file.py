# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of an edited map: its YAML, and the image embeddings next to it.

Only the lines of edited fields are replaced, so that comments, order and style are kept. The new
text is parsed for verification. If it differs from the edited map, as for files with landmarks in
flow style, the whole file is rewritten without its comments.
The round trip of ruamel.yaml keeps comments, too, but takes 9 s for a map of 5,000 landmarks that
this module reads and saves in 1.4 s.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml

from cliploc_ros.core.map import parameter_file
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    concatenated,
    embeddings_path,
    load_landmark_embeddings,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.landmark_map import find_map_node
from cliploc_ros.core.map.map_file import quoted
from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import finish_set, write_file
from cliploc_ros.offline.studio.edits import KNOWN_FIELDS, Landmark, Landmarks, map_of

_PARAMETERS = 'ros__parameters'
_GEOMETRY = ('center', 'semi_axes', 'orientation')
_PLAIN = {*KNOWN_FIELDS, 'text', 'weight', '/**', _PARAMETERS, 'map', 'frame_id', 'landmarks'}


@dataclass(frozen=True)
class MapFile:
    """A map file: its text, '' for a file that does not exist, the parsed tree, and the looks.

    ``node`` is the key of the node whose parameters contain the map. ``encoder_key`` is '' if the
    file of image embeddings is missing or unusable. ``notes`` are remarks for the user.
    """

    path: Path
    text: str
    node: str
    tree: Mapping[str, Any]
    encoder_key: str = ''
    looks: Mapping[str, LandmarkEmbeddings] = MappingProxyType({})  #: By landmark id
    notes: tuple[str, ...] = ()

    @property
    def digest(self) -> str:
        """The digest of the text; '' without a file."""
        return hashlib.sha256(self.text.encode()).hexdigest() if self.text else ''

    @property
    def map_set(self) -> parameter_file.MapSet:
        """The identity that the files next to the map must have."""
        return parameter_file.set_of(self.text)

    @property
    def frame_id(self) -> str:
        """The coordinate frame of the map."""
        return str(self._map['frame_id'])

    @property
    def landmarks(self) -> dict[str, Landmark]:
        """The landmarks by id."""
        return {key: Landmark(fields, self.looks.get(key))
                for key, fields in self._map['landmarks'].items()}

    @property
    def _map(self) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.tree[self.node][_PARAMETERS]['map']
        return found

    def with_landmarks(self, landmarks: Landmarks) -> 'MapFile':
        """Return the file with other landmarks. It is not written.

        MapError: the file has fields that cannot be rewritten.
        """
        old = self._map['landmarks']
        # undo adds a deleted landmark at the end; in the file it keeps its position
        order = [*(key for key in old if key in landmarks),
                 *(key for key in landmarks if key not in old)]
        new = {key: landmarks[key].fields for key in order}
        tree = {**self.tree, self.node: {**self.tree[self.node], _PARAMETERS: {
            **self.tree[self.node][_PARAMETERS], 'map': {**self._map, 'landmarks': new}}}}
        texts = []
        if self.text:
            with suppress(LookupError, ValueError, yaml.YAMLError):
                texts.append(patched(self.text, self.tree, tree))
        texts.append(''.join(f'{line}\n' for line in _emit(tree, 0)))
        for text in texts:
            with suppress(MapError):
                if _normalized(parameter_file.parse_parameters(text, 'map')) == _normalized(tree):
                    return replace(self, text=text, tree=tree, looks={
                        key: landmark.look for key, landmark in landmarks.items()
                        if landmark.look is not None})
        raise MapError(f'{self.path}: has fields that cannot be rewritten; the file was not '
                       'changed')

    def write(self, before: 'MapFile') -> None:
        """Write the file in place of the one before atomically, and the looks if they changed.

        The map is written last: its new content marks a complete save. CliplocError: a file
        cannot be written. The map is then unchanged.
        """
        is_same = self.looks.keys() == before.looks.keys() and all(
            self.looks[key] is before.looks[key] for key in self.looks)
        if self.encoder_key and not is_same:
            ids = list(self._map['landmarks'])
            size = next(iter((*before.looks.values(), *self.looks.values()))).means.shape[1]
            nothing = LandmarkEmbeddings(self.encoder_key, ('',), np.zeros((1, size), np.float16),
                                         np.empty((0, size), np.float16), np.zeros(2, np.int64))
            save_landmark_embeddings(embeddings_path(self.path), replace(concatenated(
                [self.looks.get(key, nothing) for key in ids], ids),
                set_digest=before.map_set.digest))
        write_file(self.path, lambda partial: partial.write_bytes(self.text.encode()))


def text_on_disk(path: Path) -> str:
    """Return the text of a map file, '' if it does not exist; MapError: it cannot be read."""
    return parameter_file.read_text(path) if os.path.exists(path) else ''  # noqa: PTH110 - never raises


def read_map_file(path: Path) -> MapFile:
    """Read a map file and the looks next to it; return an empty map if it does not exist.

    MapError: the file is not a map, or a landmark is invalid. Unknown fields of landmarks and
    invalid looks are noted.
    """
    path = path.resolve()
    if not (text := text_on_disk(path)):
        return _with_looks(MapFile(path, '', '/**', {'/**': {_PARAMETERS: {'map': {
            'frame_id': 'map', 'landmarks': {}}}}}))
    finish_set(path, parameter_file.set_of(text).digest)
    tree = parameter_file.parse_parameters(text, path)
    node = find_map_node(tree, path)
    found = tree[node][_PARAMETERS]['map']
    if not isinstance(found, Mapping) or not isinstance(found.get('landmarks'), Mapping):
        raise MapError(f'{path}: map: expected the fields frame_id, landmarks')
    for landmark_id, fields in found['landmarks'].items():
        if not isinstance(fields, Mapping):
            raise MapError(f"{path}: landmark '{landmark_id}': expected fields, not {fields!r}"
                           [:200])
    file = MapFile(path, text, node, tree)
    map_of(file.landmarks, found.get('frame_id') or '', str(path))
    unknown = {name: key for key, fields in found['landmarks'].items()
               for name in fields if name not in KNOWN_FIELDS}
    return _with_looks(replace(file, notes=tuple(
        f"field '{name}' (landmark '{key}') is kept, but the relocalizer refuses a map with "
        'unknown fields' for name, key in list(unknown.items())[:5])))


def _with_looks(file: MapFile) -> MapFile:
    """Return a map file with the image embeddings next to it, or with a note on their fault."""
    path = embeddings_path(file.path)
    if not os.path.exists(path):  # noqa: PTH110 - never raises
        return file
    try:
        found = load_landmark_embeddings(path)
        parameter_file.check_set(found.set_digest, file.map_set.digest)
    except (MapError, ValueError) as error:
        text = str(error).removeprefix(f'{path}: ')
        return replace(file, notes=(
            f'{path}: {text}. The studio does not change this file', *file.notes))
    offsets = found.medoid_offsets
    return replace(file, encoder_key=found.encoder_key, looks={key: LandmarkEmbeddings(
        found.encoder_key, (key,), found.means[row:row + 1],
        found.medoids[offsets[row]:offsets[row + 1]], offsets[row:row + 2] - offsets[row])
        for row, key in enumerate(found.landmark_ids) if found.is_known[row]})


def _normalized(tree: Any) -> Any:
    """Normalize a tree for comparison: lists for tuples, floats for integers, text for NaN."""
    return json.loads(json.dumps(tree), parse_int=float, parse_constant=str)


# ---- the text -----------------------------------------------------------------------------------

def patched(text: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return the text with the lines that differ between two trees replaced.

    LookupError, ValueError or YAMLError: it is not the text of the tree `old`.
    """
    pieces, done = [], 0
    patches = _patches(text, yaml.compose(text, Loader=parameter_file.LOADER), old, new)
    for start, end, piece in sorted(patches, key=lambda patch: patch[:2]):
        pieces += [text[done:start], piece]
        done = end
    return ''.join([*pieces, text[done:]])


def _patches(text: str, node: yaml.Node, old: Mapping[str, Any], new: Mapping[str, Any]
             ) -> Iterator[tuple[int, int, str]]:
    """Yield start and end of each change below a mapping, and the new text."""
    entries = {key.value: (key, value) for key, value in node.value}
    newline = '\r\n' if '\r\n' in text else '\n'
    for name, value in old.items():
        key, written = entries[name]
        if name not in new:
            start = text.rfind('\n', 0, key.start_mark.index) + 1
            above = text.rfind('\n', 0, start - 1) + 1
            # comments directly above belong to the deleted entry
            while start and text.startswith(' ' * key.start_mark.column + '#', above):
                start, above = above, text.rfind('\n', 0, above - 1) + 1
            yield start, _line_end(text, _end(written)), ''
        elif new[name] is value or new[name] == value:
            continue
        elif isinstance(new[name], Mapping) and not written.flow_style:
            yield from _patches(text, written, value, new[name])
        else:
            end = _end(written)
            line_end = newline if text[end - 1] == '\n' else ''  # the old value is a block text
            yield (text.index(':', key.end_mark.index) + 1, end,
                   f' {_flow(name, new[name])}{line_end}')
    if added := {name: value for name, value in new.items() if name not in old}:
        # added entries begin on a new line
        end = _line_end(text, _end(node))
        lines = [f'{line}{newline}' for line in _emit(added, node.value[0][0].start_mark.column)]
        yield end, end, ('' if text[end - 1] == '\n' else newline) + ''.join(lines)


def _end(node: yaml.Node) -> int:
    """Return the end of a value; a mapping or list in block style ends with its last value."""
    if isinstance(node, yaml.ScalarNode) or node.flow_style:
        return int(node.end_mark.index)
    return _end(node.value[-1][1] if isinstance(node, yaml.MappingNode) else node.value[-1])


def _line_end(text: str, index: int) -> int:
    """Return the index of the next start of a line, or the index itself if a line starts there."""
    if index > 0 and text[index - 1] == '\n':
        return index
    found = text.find('\n', index)
    return len(text) if found < 0 else found + 1


def _emit(tree: Mapping[str, Any], column: int) -> Iterator[str]:
    """Yield the lines of a tree in block style, with lists and values of fields on one line.

    Names of fields are plain, ids and classes are quoted, as in write_map.
    """
    for key, value in tree.items():
        name = key if key in _PLAIN else quoted(key)
        if isinstance(value, Mapping) and value:
            yield f'{" " * column}{name}:'
            yield from _emit(value, column + 2)
        else:
            yield f'{" " * column}{name}: {_flow(key, value)}'


def _flow(name: str, value: Any) -> str:
    """Return the value of a field on one line; geometric values are always floats."""
    if isinstance(value, Mapping):
        inner = ', '.join(f'{quoted(key)}: {_flow(key, item)}' for key, item in value.items())
        return f'{{{inner}}}'
    if isinstance(value, list | tuple):
        return f'[{", ".join(_flow(name, item) for item in value)}]'
    if isinstance(value, str):
        return quoted(value)
    if name in _GEOMETRY or (isinstance(value, float) and math.isfinite(value)):
        return np.format_float_positional(value, trim='0')
    return str(yaml.safe_dump(value)).partition('\n')[0]
