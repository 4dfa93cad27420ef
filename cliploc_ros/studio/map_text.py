# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The text of a map file, and that text with other landmarks: all that did not change stays.

Only the lines of edited fields are replaced, so that comments, order and style survive. The
patched text is read again before it is used. Where it does not say what it should, as in files
whose landmarks are written in braces, the whole file is written anew, without its comments.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import yaml

from cliploc_ros.studio.landmark import DECIMALS

_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_GEOMETRY = ('center', 'semi_axes', 'orientation')


class Span(NamedTuple):
    """Characters from start up to end, end excluded."""

    start: int
    end: int


@dataclass
class Place:
    """Where a key and its value are in the text.

    Parameters
    ----------
    key : Span
    column : int
        Of the key.
    end : int
        Of the last character of the value.
    inner : dict of str to Place
        The keys of the value, if it is a mapping.
    """

    key: Span
    column: int
    end: int
    inner: 'dict[str, Place]' = field(default_factory=dict)


def find_places(text: str) -> dict[str, Place]:
    """Return where the keys of a YAML text are."""
    root = Place(Span(0, 0), -1, 0)
    # open collections, innermost last: the place they are the value of, None for lists
    stack: list[tuple[Place | None, list[str]]] = [(root, [])]
    waiting: list[Place] = []
    for event in yaml.parse(text, Loader=_LOADER):
        start, end = event.start_mark.index, event.end_mark.index
        holder, pending = stack[-1]
        if isinstance(event, yaml.ScalarEvent):
            if holder is None or len(stack) == 1:
                _extend(waiting, end)
            elif pending:
                _extend([*waiting, holder.inner[pending.pop()]], end)
            else:
                holder.inner[event.value] = Place(Span(start, end), event.start_mark.column, end)
                pending.append(event.value)
        elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
            place = holder.inner[pending.pop()] if holder is not None and pending else None
            if len(stack) == 1:
                place = root
            waiting.append(place or Place(Span(start, end), 0, end))
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            stack.append((waiting[-1] if is_mapping else None, []))
            _extend(waiting, end)
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            if text[start:end] in ('}', ']'):  # a block's end has no characters of its own
                _extend(waiting, end)
            stack.pop()
            waiting.pop()
    return root.inner


def _extend(places: list[Place], end: int) -> None:
    for place in places:
        place.end = max(place.end, end)


class Patch(NamedTuple):
    """Replace a span by a text."""

    span: Span
    text: str


def patch_landmarks(text: str, path: tuple[str, ...], old: Mapping[str, Mapping[str, Any]],
                    new: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a map's text with other landmarks.

    Parameters
    ----------
    text : str
        Of the file.
    path : tuple of str
        The keys that lead to the landmarks.
    old, new : mapping of str to mapping
        The fields of each landmark, as the text has them and as it shall have them.

    Raises
    ------
    LookupError
        The text does not have these landmarks where they are expected.
    """
    place = Place(Span(0, 0), -1, 0, find_places(text))
    for key in path:
        place = place.inner[key]
    newline = '\r\n' if '\r\n' in text else '\n'
    patches = []
    for landmark_id, fields in old.items():
        here = place.inner[landmark_id]
        if landmark_id not in new:
            patches.append(Patch(_with_comments(text, here), ''))
        elif new[landmark_id] is not fields and new[landmark_id] != fields:
            patches += _patch_fields(text, here, fields, new[landmark_id], newline)
    added = {key: fields for key, fields in new.items() if key not in old}
    if added:
        column = next(iter(place.inner.values())).column
        lines = [f'{line}{newline}' for line in _emit(added, column)]
        end = _line_end(text, place.end)
        break_before = '' if end == 0 or text[end - 1] == '\n' else newline
        patches.append(Patch(Span(end, end), break_before + ''.join(lines)))
    for patch in sorted(patches, key=lambda one: one.span, reverse=True):
        text = text[:patch.span.start] + patch.text + text[patch.span.end:]
    return text


def _patch_fields(text: str, here: Place, old: Mapping[str, Any], new: Mapping[str, Any],
                  newline: str) -> Iterator[Patch]:
    for name, value in old.items():
        place = here.inner[name]
        if name not in new:
            yield Patch(_lines_of(text, place), '')
        elif new[name] != value:
            colon = text.index(':', place.key.end) + 1
            is_text_block = text[place.end - 1] == '\n'
            yield Patch(Span(colon, place.end),
                        f' {flow(name, new[name])}{newline if is_text_block else ""}')
    added = {name: value for name, value in new.items() if name not in old}
    if added:
        column = next(iter(here.inner.values())).column
        lines = [f'{line}{newline}' for line in _emit(added, column)]
        end = _line_end(text, here.end)
        break_before = '' if text[end - 1] == '\n' else newline
        yield Patch(Span(end, end), break_before + ''.join(lines))


def _line_start(text: str, index: int) -> int:
    return text.rfind('\n', 0, index) + 1


def _line_end(text: str, index: int) -> int:
    """Return where the line after the last character before an index begins."""
    if index > 0 and text[index - 1] == '\n':
        return index
    found = text.find('\n', index)
    return len(text) if found < 0 else found + 1


def _lines_of(text: str, place: Place) -> Span:
    return Span(_line_start(text, place.key.start), _line_end(text, place.end))


def _with_comments(text: str, place: Place) -> Span:
    """Return a landmark's lines with the comments directly above it, which are about it."""
    span = _lines_of(text, place)
    start = span.start
    while start > 0:
        above = _line_start(text, start - 1)
        line = text[above:start]
        if not line.startswith(' ' * place.column + '#'):
            break
        start = above
    return Span(start, span.end)


def write_tree(tree: Mapping[str, Any]) -> str:
    """Return a parameter file of a tree."""
    return ''.join(f'{line}\n' for line in _emit(tree, 0))


def _emit(tree: Mapping[str, Any], column: int) -> Iterator[str]:
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield f'{" " * column}{_key(key)}:'
            yield from _emit(value, column + 2)
        else:
            yield f'{" " * column}{_key(key)}: {flow(key, value)}'


def _key(key: str) -> str:
    is_plain = key.isascii() and key.replace('_', 'a').isalnum() and not key[0].isdigit()
    # YAML 1.1 reads words such as yes and no as booleans
    is_word = key.lower() in ('y', 'yes', 'n', 'no', 'true', 'false', 'on', 'off', 'null')
    return key if is_plain and not is_word else json.dumps(key)


def flow(name: str, value: Any) -> str:
    """Return a value of a field on one line; a geometric one always as floats."""
    if isinstance(value, Mapping):
        inner = ', '.join(f'{json.dumps(key)}: {flow(key, one)}' for key, one in value.items())
        return f'{{{inner}}}'
    if isinstance(value, list | tuple):
        return f'[{", ".join(flow(name, one) for one in value)}]'
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, int) and name not in _GEOMETRY:
        return str(value)
    number = float(value)
    if not math.isfinite(number):
        return '.nan' if math.isnan(number) else '.inf' if number > 0 else '-.inf'
    fixed = f'{number:.{DECIMALS}f}'.rstrip('0')
    fixed += '0' if fixed.endswith('.') else ''
    # YAML 1.1 takes 1e-07 for text: a float needs its point
    mantissa, e, exponent = repr(number).partition('e')
    exact = f'{mantissa}{"" if "." in mantissa else ".0"}{e}{exponent}'
    return fixed if float(fixed) == number else exact
