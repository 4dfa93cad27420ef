# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read untrusted ROS 2 parameter files without ROS.

The tree is built from the parser's events, without recursion and without instantiating objects.
Size and depth are limited, so a hostile file causes an error and not a crash.
"""

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import read_file

_MAX_DEPTH = 16
# Maximum number of values, keys and collections; PyYAML takes 3 us for each. A landmark has about
# 30.
_MAX_EVENTS = 2_000_000
# Maximum number of collections in a list, such as the labels of a landmark as mappings, and of
# plain values in a list or mapping, which end a hostile file early.
_MOST_IN_LIST, _MOST_VALUES = 1000, 10_000
# Words that YAML 1.1, and therefore ROS, reads as booleans.
_TRUE = frozenset({'y', 'yes', 'true', 'on'})
_FALSE = frozenset({'n', 'no', 'false', 'off'})
_QUOTED_STYLES = ('"', "'", '|', '>')
# Longer text is not a measured number; 300 digits would overflow a float.
_MAX_NUMBER_LENGTH = 40
#: The loader of libyaml, where PyYAML has it: seven times as fast.
LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_SET = re.compile(r'(?:#.*\n)*?# set ([0-9a-f]{12}) ([0-9a-f]{12})\n')


def read_parameter_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a YAML file as a tree of dicts, lists, str, int, float, bool and None.

    Raises MapError if the file is unreadable, not a regular file, too large, not a YAML mapping,
    nested too deeply, or has an alias or a repeated key. The message names the file and the line.
    """
    return parse_parameters(read_text(path), path)


def read_text(path: str | os.PathLike[str]) -> str:
    """Read the text of a regular file in UTF-8, up to the maximum size of read_file.

    Raises MapError with the file and its fault.
    """
    path = Path(path)
    try:
        return read_file(path).decode('utf-8')
    except OSError as error:
        raise MapError(f'{path.absolute()}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise MapError(f'{path}: not a text file in UTF-8 (byte {error.start})') from error


def parse_parameters(text: str, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Parse a YAML text into a tree, see read_parameter_file; messages name the path."""
    try:
        tree = _build_tree(text)
    except yaml.YAMLError as error:
        fault = ' '.join(str(error).replace(' in "<unicode string>",', ' at').split())
        raise MapError(f'{path}: not valid YAML: {fault}') from error
    except _TreeError as error:
        raise MapError(f'{path}: {error}') from error
    if not isinstance(tree, dict):
        raise MapError(f'{path}: not a YAML mapping')
    return tree


class _TreeError(Exception):
    """A construct that YAML allows but a parameter file must not contain."""


def _build_tree(text: str) -> Any:
    """Build the tree of a YAML text with a single document, from its events."""
    root: list[Any] = []
    # the open collections, innermost last, each with the key that has no value yet
    stack: list[tuple[Any, list[str]]] = [(root, [])]
    for number, event in enumerate(yaml.parse(text, Loader=LOADER)):
        line = event.start_mark.line + 1
        if number > _MAX_EVENTS:
            raise _TreeError(f'line {line}: more than {_MAX_EVENTS} values; divide the map into '
                             'several maps')
        if isinstance(event, yaml.AliasEvent):
            raise _TreeError(f'line {line}: an alias (*{event.anchor}) is not supported; repeat '
                             'the value')
        if isinstance(event, yaml.ScalarEvent):
            outer, pending = stack[-1]
            if len(outer) > _MOST_VALUES and (pending or isinstance(outer, list)):
                raise _TreeError(f'line {line}: more than {_MOST_VALUES} values side by side')
            _add(stack[-1], _scalar(event), line)
        elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            if len(stack) > _MAX_DEPTH:
                raise _TreeError(f'line {line}: nested deeper than {_MAX_DEPTH} levels')
            outer = stack[-1][0]
            if isinstance(outer, list) and len(outer) > _MOST_IN_LIST:
                raise _TreeError(f'line {line}: a list of more than {_MOST_IN_LIST} collections')
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
    """Convert a scalar to the type that ROS gives it; quoted text stays text."""
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


class MapSet(NamedTuple):
    """Identity of a map and the files next to it, from the head of the map; '' if unknown."""

    family: str = ''  #: Digest of the original map; updates keep it, and its keyframes stay valid
    digest: str = ''  #: Digest of this map


#: The set of a map whose head names none.
NO_SET = MapSet()


def check_set(digest: str, of_map: str) -> None:
    """Raise ValueError if a file and its map belong to different known sets."""
    if digest and of_map and digest != of_map:
        raise ValueError(f'is of the set {digest[:12]}, but its map is of the set {of_map}')


def set_of(text: str) -> MapSet:
    """Read the set of a map file from its text, or from the beginning of its text."""
    found = _SET.match(text)
    return MapSet(found[1], found[2]) if found else NO_SET
