# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read a map file as write_map writes it, without a YAML parser.

PyYAML makes an object of each mark of the file: 100,000 landmarks take it 10 to 30 s. Files of
build_map, import_map and the studio repeat one layout, so a regular expression for one landmark
reads them ten times faster. It accepts a small part of YAML only, in which it agrees with the
parser. Any other file, a hand-written or invalid one among them, gives None, and the parser reads
it and names what is wrong (cliploc_ros.core.map.parameter_file).
"""

import json
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails

# Quoted text whose escapes mean the same in JSON and in YAML; halves of a pair of code units do
# not. A key of YAML has at most 1024 characters.
_ESCAPE = r'\\(?:["\\nrtbf]|u(?!d[89a-f])[0-9a-f]{4})'
_TEXT = rf'"(?:[ !#-\[\]-~]|{_ESCAPE})*+"'
_KEY = rf'"(?:[ !#-\[\]-~]|{_ESCAPE}){{1,150}}+"'
_FLOAT = r'(?:0|[1-9]\d{0,14})\.\d{1,9}'
_SIGNED = rf'-?{_FLOAT}'


def _row(count: int) -> str:
    return rf'\[({_SIGNED}{rf", {_SIGNED}" * (count - 1)})\]'


_HEAD = re.compile(
    r'(?:#[ -~\u00a0-\ud7ff]*\n)*+/\*\*:\n  ros__parameters:\n    map:\n'
    rf'      frame_id: ({_TEXT})\n'
    r'      landmarks:\n')
_INDENT = ' ' * 10
_LANDMARK = re.compile(''.join([
    rf'        ({_KEY}):\n', rf'{_INDENT}label: ({_TEXT})\n', rf'{_INDENT}class_id: ({_TEXT})\n',
    rf'{_INDENT}center: {_row(3)}\n', rf'{_INDENT}semi_axes: {_row(3)}\n',
    rf'{_INDENT}orientation: {_row(4)}\n',
    rf'(?:{_INDENT}labels:\n{_INDENT}  text: \[({_TEXT}(?:, {_TEXT})*+)\]\n',
    rf'{_INDENT}  weight: \[({_FLOAT}(?:, {_FLOAT})*+)\]\n)?+',
    rf'(?:{_INDENT}class_weights:\n((?:{_INDENT}  {_KEY}: {_FLOAT}\n)++))?+',
    rf'(?:{_INDENT}support: ((?:0|[1-9]\d{{0,14}}))\n)?+',
    *(rf'(?:{_INDENT}{name}: ({_FLOAT})\n)?+'
      for name in ('position_sigma', 'shared_sigma', 'shared_sigma_deg', 'seen_ratio',
                   'baseline_deg', 'last_seen')),
    rf'(?:{_INDENT}source: ({_TEXT})\n)?+']))
# Groups of _LANDMARK before those of the details.
_PLAIN = 6


class WrittenMap(NamedTuple):
    """The fields of LandmarkMap in their order, not yet validated."""

    frame_id: str
    landmark_ids: tuple[str, ...]
    labels: tuple[str, ...]
    class_ids: tuple[str, ...]
    centers: NDArray[np.float64]
    semi_axes: NDArray[np.float64]
    quats_xyzw: NDArray[np.float64]
    details: tuple[LandmarkDetails, ...]


def parse_written_map(text: str) -> WrittenMap | None:
    """Return the map of a file's text; None if it has another layout than write_map's.

    Ids are unique, numbers finite, weights above 0.
    """
    head = _HEAD.match(text)
    if head is None:
        return None
    rows, end = [], head.end()
    while (found := _LANDMARK.match(text, end)) is not None:
        rows.append(found.groups())
        end = found.end()
    if end != len(text) or not rows:
        return None
    columns = list(zip(*rows, strict=True))
    ids, labels, class_ids = (tuple(_values(column)) for column in columns[:3])
    details = _details(columns[_PLAIN:], len(rows))
    if len(set(ids)) < len(ids) or details is None:
        return None
    centers, semi_axes, quats_xyzw = (
        np.array(_values(column), dtype=np.float64).reshape(len(rows), -1)
        for column in columns[3:_PLAIN])
    return WrittenMap(json.loads(head[1]), ids, labels, class_ids, centers, semi_axes, quats_xyzw,
                      details)


def _values(texts: Iterable[str]) -> list[Any]:
    """Return the values of JSON texts, lists joined."""
    return list(json.loads(f'[{",".join(texts)}]'))


def _details(columns: list[tuple[Any, ...]], count: int) -> tuple[LandmarkDetails, ...] | None:
    """Return the optional fields of each landmark, empty if none has any; None for the parser."""
    if not any(map(any, columns)):
        return ()
    texts, weights, classes, *numbers, sources = columns
    phrases, heavy = _values(_lists(texts)), _values(_lists(weights))
    shares = _values('null' if one is None else f'{{{one[:-1]}}}'.replace('\n', ',')
                     for one in classes)
    names = _values(one or 'null' for one in sources)
    if (any(one and len(one) != len(its) for one, its in zip(phrases, heavy, strict=True))
            # a class that is repeated
            or any(one and len(its) < one.count('\n')
                   for one, its in zip(classes, shares, strict=True))):
        return None
    labels, likely = ([pairs and tuple(pairs) for pairs in column] for column in (
        [one and zip(one, its, strict=True) for one, its in zip(phrases, heavy, strict=True)],
        [one and one.items() for one in shares]))
    if not (all(text.strip() and weight > 0.0 for column in (labels, likely)
                for pairs in column if pairs for text, weight in pairs)
            and all(one is None or one.strip() for one in names)):
        return None
    support, *others = ([None if one is None else kind(one) for one in column]
                        for kind, column in zip((int, *[float] * 6), numbers, strict=True))
    return tuple(map(LandmarkDetails, labels, likely, *others[:3], support, *others[3:], names))


def _lists(texts: Iterable[str | None]) -> Iterable[str]:
    return ('null' if one is None else f'[{one}]' for one in texts)
