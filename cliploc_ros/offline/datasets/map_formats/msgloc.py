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

from collections.abc import Mapping, Sequence
from pathlib import Path

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.offline.datasets.map_formats.given_map import (
    GivenLandmark,
    GivenMap,
    Skipped,
    class_name,
    make_id,
    read_bytes,
    shares,
)
from cliploc_ros.offline.datasets.parsing import FieldError, Fields

_NUMBER_OF_SYMBOL = (1 << 56) - 1
# Where a file has likelihoods alone, classes below this share of the greatest one are left out.
# A guess.
_LEAST_LIKELIHOOD = 0.5
_MOST_SHARE = 1e300  # sums of more are infinite


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
    given = GivenMap([], [], [])
    negative = 0
    for place, values in enumerate(Fields.of_file(path, read_bytes).entries('nodes')):
        try:
            node = Fields(values, f'node {place}')
            given.landmarks.append(_landmark(node, place, class_names))
            negative += any(radius < 0.0 for radius in node.values['radii'])
        except FieldError as error:
            given.left_out.append(Skipped(f'node {place}', str(error)))
    if negative:
        given.notes.append(f'{negative} landmarks have negative radii; their signs are ignored')
    return given


def _landmark(node: Fields, place: int, class_names: Sequence[str]) -> GivenLandmark:
    center, radii = (node.numbers(name, (3,)).tolist() for name in ('translation', 'radii'))
    w, x, y, z = node.numbers('orientation', (4,)).tolist()
    weights = _class_weights(node, class_names)
    number = node.values.get('id', place)
    if not isinstance(number, int):
        raise FieldError(f"{node.where}: 'id' is {str(number)[:40]!r}, not an integer")
    name = weights[0][0]
    return GivenLandmark(
        make_id(name, number & _NUMBER_OF_SYMBOL), name, name, center,
        [abs(radius) for radius in radii], (x, y, z, w),
        LandmarkDetails(class_weights=weights if len(weights) > 1 else None))


def _class_weights(node: Fields, class_names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Return the classes of a node with their shares, the greatest first."""
    weights = shares(_labels(node, 'baseline_label', class_names))
    if not weights:
        likely = _labels(node, 'msgloc_label', class_names)
        least = _LEAST_LIKELIHOOD * max(likely.values(), default=0.0)
        weights = shares({name: value for name, value in likely.items() if value >= least})
    if not weights:
        raise FieldError(f"{node.where}: has no class: neither 'baseline_label' nor "
                         "'msgloc_label'")
    return weights


def _labels(node: Fields, field: str, class_names: Sequence[str]) -> Mapping[str, float]:
    """Return the first number of each class of a field."""
    found: dict[str, float] = {}
    for key, values in node.mapping(field).items():
        where = f"{node.where}: '{field}' of class {key[:40]!r}"
        first = Fields({'share': values[0] if isinstance(values, list) and values else None},
                       where).number('share')
        if not 0.0 <= first < _MOST_SHARE:
            raise FieldError(f'{where} is {first:g}, not a number from 0')
        name = _name_of(key, class_names, where)
        found[name] = found.get(name, 0.0) + first
    return found


def _name_of(key: str, class_names: Sequence[str], where: str) -> str:
    """Return the class of a key: an index, written as a float, or a name."""
    try:
        index = float(key)
    except ValueError:
        if not key.strip() or len(key) > 1000:
            raise FieldError(f'{where}: the class has no name') from None
        return key
    if not index.is_integer():
        raise FieldError(f'{where}: the class is no index')
    return class_name(class_names, int(index))
