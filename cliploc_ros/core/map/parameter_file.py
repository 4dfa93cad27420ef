# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reading untrusted ROS 2 parameter files without ROS.

The tree is built from the parser's events, without recursion and without instantiating objects.
Size and depth are limited, so a hostile file ends in an error and not in a crash.

PyYAML makes an object of each mark of the file: 100,000 landmarks take it 10 to 30 s. Files of
build_map, import_map and the studio have lines of one kind, so a regular expression turns them
into JSON, which is read several times faster. It accepts a small part of YAML only, in which it
agrees with the parser. Any other file, a hand-written or invalid one among them, gives None, and
the parser reads it and names what is wrong.
"""

import json
import os
import re
from pathlib import Path
from stat import S_ISREG
from typing import Any

import yaml

from cliploc_ros.core.map.landmark_details import OPTIONAL_FIELDS
from cliploc_ros.errors import MapError

MAX_FILE_BYTES = 256 * 1024 * 1024
_MAX_DEPTH = 16
# Words that YAML 1.1, and so ROS, reads as booleans.
_TRUE = frozenset({'y', 'yes', 'true', 'on'})
_FALSE = frozenset({'n', 'no', 'false', 'off'})
_QUOTED_STYLES = ('"', "'", '|', '>')
# Longer text is no measured number; 300 digits would overflow a float.
_MAX_NUMBER_LENGTH = 40
_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
# A line of what write_map writes: a key, and text, a number, or a list of these, in the part of
# YAML that is JSON. Halves of a pair of code units are not in it; a key of YAML has at most 1024
# characters.
_ESCAPE = r'\\(?:["\\nrtbf]|u(?!d[89a-f])[0-9a-f]{4})'
_TEXT = rf'"(?:[ !#-\[\]-~]|{_ESCAPE})*+"'
_VALUE = rf'(?:{_TEXT}|-?(?:0|[1-9]\d{{0,14}})(?:\.\d{{1,9}})?(?=[\n,\]]))'
_LINE = re.compile(
    rf'((?:  ){{0,8}}+)("(?:[ !#-\[\]-~]|{_ESCAPE}){{1,150}}+"|/\*\*|ros__parameters|map|frame_id'
    r'|landmarks|label|class_id|center|semi_axes|orientation|text|weight'
    rf'|{"|".join(OPTIONAL_FIELDS)}):'
    rf'(?: ({_VALUE}|\[{_VALUE}(?:, {_VALUE})*+\]))?\n')
_COMMENTS = re.compile(r'(?:#[ -~\u00a0-\ud7ff]*\n)*+')


def read_parameter_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the tree of a YAML file: dicts, lists, str, int, float, bool and None.

    MapError: the file is unreadable, not a regular file, too large, no YAML mapping, nested too
    deeply, or has an alias or a repeated key. The message names file and line.
    """
    return parse_parameters(read_text(path), path)


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a regular file in UTF-8 that is not too large.

    MapError: names the file and what is wrong with it.
    """
    path = Path(path)
    try:
        if not S_ISREG(path.stat().st_mode):
            # a parameter may name a device or a pipe, which never end
            raise MapError(f'{path}: not a regular file')
        with path.open('rb') as file:
            content = file.read(MAX_FILE_BYTES + 1)
        if len(content) > MAX_FILE_BYTES:
            raise MapError(f'{path}: larger than {MAX_FILE_BYTES // 2**20} MiB')
        return content.decode('utf-8')
    except OSError as error:
        raise MapError(f'{path.absolute()}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise MapError(f'{path}: not a text file in UTF-8 (byte {error.start})') from error


def parse_parameters(text: str, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the tree of a YAML text as read_parameter_file does; messages name the path."""
    try:
        tree = _build_tree(text)
    except yaml.YAMLError as error:
        said = ' '.join(str(error).replace(' in "<unicode string>",', ' at').split())
        raise MapError(f'{path}: not valid YAML: {said}') from error
    except _TreeError as error:
        raise MapError(f'{path}: {error}') from error
    if not isinstance(tree, dict):
        raise MapError(f'{path}: holds no YAML mapping')
    return tree


class _TreeError(Exception):
    """A construct that YAML allows and a parameter file must not have."""


def _build_tree(text: str) -> Any:
    """Return the one document of a YAML text, from its events."""
    root: list[Any] = []
    # the open collections, innermost last, each with the key that waits for its value
    stack: list[tuple[Any, list[str]]] = [(root, [])]
    for event in yaml.parse(text, Loader=_LOADER):
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise _TreeError(f'line {line}: an alias (*{event.anchor}); write the value out')
        if isinstance(event, yaml.ScalarEvent):
            _add(stack[-1], _scalar(event), line)
        elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            if len(stack) > _MAX_DEPTH:
                raise _TreeError(f'line {line}: nested deeper than {_MAX_DEPTH} levels')
            collection: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
            _add(stack[-1], collection, line)
            stack.append((collection, []))
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            stack.pop()
    if len(root) > 1:
        raise _TreeError('more than one YAML document')
    return root[0] if root else None


def _add(open_collection: tuple[Any, list[str]], value: Any, line: int) -> None:
    """Add a value to a collection, as an item, a key, or the value of the pending key."""
    collection, pending_key = open_collection
    if isinstance(collection, list):
        collection.append(value)
    elif pending_key:
        collection[pending_key.pop()] = value
    elif isinstance(value, dict | list):
        raise _TreeError(f'line {line}: a key must be a name')
    else:
        key = str(value)
        if key in collection:
            raise _TreeError(f"line {line}: '{key}' is repeated")
        pending_key.append(key)


def _scalar(event: yaml.ScalarEvent) -> Any:
    """Return a scalar with the type that ROS gives it; quoted text stays text."""
    text = event.value
    if event.style in _QUOTED_STYLES or event.tag == 'tag:yaml.org,2002:str':
        return text
    if text in ('', '~', 'null', 'Null', 'NULL'):
        return None
    if text.lower() in _TRUE | _FALSE:
        return text.lower() in _TRUE
    for number in (int, float) if len(text) <= _MAX_NUMBER_LENGTH else ():
        try:
            return number(text)
        except ValueError:
            pass
    return {'.nan': float('nan'), '.inf': float('inf'), '-.inf': -float('inf')}.get(
        text.lower(), text)


def parse_written(text: str) -> dict[str, Any] | None:
    """Return the tree of a file's text; None if it has another layout than write_map's."""
    comments = _COMMENTS.match(text)
    assert comments is not None
    parts, depth, is_open, end = list[str](), -1, True, comments.end()
    for found in _LINE.finditer(text, end):
        indent, key, value = found.groups()
        steps = len(indent) // 2 - depth
        if found.start() != end or steps > 1 or (steps == 1) != is_open:
            return None
        parts += ['{' if is_open else '}' * -steps + ',',
                  key if key[0] == '"' else f'"{key}"', ':', value or '']
        depth, is_open, end = depth + steps, value is None, found.end()
    if end != len(text) or is_open:
        return None
    try:
        return dict(json.loads(''.join(parts) + '}' * (depth + 1), object_pairs_hook=_unique))
    except ValueError:
        return None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mapping; ValueError: a key is repeated."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError('a key is repeated')
    return found
