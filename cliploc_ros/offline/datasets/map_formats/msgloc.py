# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of MSG-Loc: JSON with a list of nodes.

| field of a node | content |
|---|---|
| id | a symbol of GTSAM: the letter q in the highest byte, and a number |
| translation, radii | centre and semi-axes; signs of radii have no meaning |
| orientation | quaternion w, x, y, z |
| baseline_label | class to [share of the detections by score, ...] |
| msgloc_label | class to [likelihood]: how often the class was among those the detector proposed |
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.map_formats.given_map import (
    GivenLandmark,
    GivenMap,
    Skipped,
    class_name,
    make_id,
    read_bytes,
    shares,
)

_NUMBER_OF_SYMBOL = (1 << 56) - 1
# Where a file has likelihoods alone, classes below this share of the greatest one are left out.
# A guess.
_LEAST_LIKELIHOOD = 0.5


class _NodeError(Exception):
    """What is wrong with a node."""


def read_msgloc(path: Path, class_names: Sequence[str]) -> GivenMap:
    """Read a map of MSG-Loc.

    Class weights are the shares of the detections. Likelihoods serve where a node lacks them: they
    sum to more than 1, and say which classes the detector confuses. DatasetError: the message
    names the file and what is wrong with it.

    Parameters
    ----------
    path : Path
        A JSON file.
    class_names : sequence of str
        Of the class indices; a file may also name classes.
    """
    try:
        tree = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f'{path}: is no JSON: {error}') from error
    nodes = tree.get('nodes') if isinstance(tree, Mapping) else None
    if not isinstance(nodes, list):
        raise DatasetError(f"{path}: has no list 'nodes', as a map of MSG-Loc has")
    given = GivenMap([], [], [])
    negative = 0
    for place, node in enumerate(nodes):
        try:
            given.landmarks.append(_landmark(node, place, class_names))
            negative += any(radius < 0.0 for radius in node['radii'])
        except _NodeError as error:
            given.left_out.append(Skipped(f'node {place}', str(error)))
    if negative:
        given.notes.append(f'{negative} landmarks have negative radii; their signs are ignored')
    return given


def _landmark(node: Any, place: int, class_names: Sequence[str]) -> GivenLandmark:
    if not isinstance(node, Mapping):
        raise _NodeError('it has no fields')
    center, radii = _numbers(node, 'translation', 3), _numbers(node, 'radii', 3)
    w, x, y, z = _numbers(node, 'orientation', 4)
    weights = _class_weights(node, class_names)
    number = node.get('id', place)
    if not isinstance(number, int):
        raise _NodeError(f"its 'id' is {str(number)[:40]!r}, not an integer")
    name = weights[0][0]
    return GivenLandmark(
        make_id(name, number & _NUMBER_OF_SYMBOL), name, name, center,
        [abs(radius) for radius in radii], (x, y, z, w),
        LandmarkDetails(class_weights=weights if len(weights) > 1 else None))


def _numbers(node: Mapping[str, Any], name: str, count: int) -> list[float]:
    values = node.get(name)
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise _NodeError(f"its '{name}' is not {count} numbers")
    return [float(value) for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _class_weights(node: Mapping[str, Any], class_names: Sequence[str]
                   ) -> tuple[tuple[str, float], ...]:
    """Return the classes of a node with their shares, the greatest first."""
    weights = shares(_labels(node, 'baseline_label', class_names))
    if not weights:
        likely = _labels(node, 'msgloc_label', class_names)
        least = _LEAST_LIKELIHOOD * max(likely.values(), default=0.0)
        weights = shares({name: value for name, value in likely.items() if value >= least})
    if not weights:
        raise _NodeError("it has no class: neither 'baseline_label' nor 'msgloc_label'")
    return weights


def _labels(node: Mapping[str, Any], field: str, class_names: Sequence[str]) -> dict[str, float]:
    """Return the first number of each class of a field."""
    labels = node.get(field, {})
    if not isinstance(labels, Mapping):
        raise _NodeError(f"its '{field}' does not map classes to numbers")
    found: dict[str, float] = {}
    for key, values in labels.items():
        if not (isinstance(values, list) and values and _is_number(values[0])
                and values[0] >= 0.0):
            raise _NodeError(f"its '{field}' of class {key[:40]!r} is not a list that begins with "
                             'a number from 0')
        name = _name_of(key, class_names)
        found[name] = found.get(name, 0.0) + float(values[0])
    return found


def _name_of(key: str, class_names: Sequence[str]) -> str:
    """Return the class of a key: an index, written as a float, or a name."""
    try:
        index = float(key)
    except ValueError:
        if not key.strip() or len(key) > 1000:
            raise _NodeError('a class has no name') from None
        return key
    if not index.is_integer():
        raise _NodeError(f'class {key} is no index')
    return class_name(class_names, int(index))
