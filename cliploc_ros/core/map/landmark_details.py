# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Optional fields of a landmark in the map file."""

import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from cliploc_ros.errors import MapError, did_you_mean

#: Minimum share of a landmark's boxes for a class to yield candidates. Chosen.
LEAST_CLASS_SHARE = 0.1
_MAX_TEXT_LENGTH = 1000
_MAX_COORDINATE_M = 1e7
_MAX_QUATERNION_NORM_ERROR = 0.01
#: Labels that describe one landmark, with their weights.
WeightedLabels = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class LandmarkDetails:
    """Optional fields of a landmark. A field that is missing in the map is None."""

    labels: WeightedLabels | None = None  #: Phrases with their weights, all above 0
    #: Detector classes with their shares of the landmark's boxes, all above 0
    class_weights: tuple[tuple[str, float], ...] | None = None
    position_sigma: float | None = None  #: Standard deviation of the centre on each axis [m]
    #: Additional error that the landmark shares with its neighbours, a common shift and a common
    #: rotation about nearby cameras: standard deviations on each axis [m] [deg]
    shared_sigma: float | None = None
    shared_sigma_deg: float | None = None
    support: int | None = None  #: Number of frames that the landmark was fitted to
    #: Share of the frames showing the landmark's place in which it was detected, 0 to 1
    seen_ratio: float | None = None
    #: Maximum angle between two directions from which it was seen [deg]
    baseline_deg: float | None = None
    last_seen: float | None = None  #: Time of the last frame that showed it [s]
    source: str | None = None  #: Origin of the landmark

    def labels_with(self, label: str) -> WeightedLabels:
        """Return the labels including `label`; if it is new (edited), it gets the top weight."""
        if self.labels is None:
            return ((label, 1.0),)
        if any(text == label for text, _ in self.labels):
            return self.labels
        return ((label, max(weight for _, weight in self.labels)), *self.labels)

    def class_shares(self) -> tuple[tuple[str, float], ...]:
        """Return the classes of at least LEAST_CLASS_SHARE, weighted as in ClassIndex."""
        weights = dict(self.class_weights or ())
        least, most = LEAST_CLASS_SHARE * sum(weights.values()), max(weights.values(), default=1.0)
        return tuple((name, weight / most) for name, weight in weights.items() if weight >= least)


def join_details(parts: Sequence[tuple[str, str, LandmarkDetails]]) -> LandmarkDetails:
    """Join the details of landmarks that are one object, given as (label, class, details).

    The result has the labels and classes of all parts, weighted by their numbers of frames, and
    the other fields of the first part.
    """
    first = parts[0][2]
    labels = _shares([(details.labels_with(label), details.support or 1)
                      for label, _, details in parts])
    classes = _shares([(details.class_weights or ((name, 1.0),), details.support or 1)
                       for _, name, details in parts])
    return replace(first, labels=labels if len(labels) > 1 else first.labels,
                   class_weights=classes if len(classes) > 1 else first.class_weights)


def _shares(parts: Sequence[tuple[WeightedLabels, int]]) -> WeightedLabels:
    """Return the shares of names in weighted parts, in decreasing order."""
    shares = defaultdict[str, float](float)
    for names, weight in parts:
        for name, share in names:
            shares[name] += share * weight / sum(other for _, other in names)
    total = sum(shares.values())
    return tuple((name, shares[name] / total) for name in sorted(
        shares, key=lambda name: -shares[name]))


OPTIONAL_FIELDS = tuple(field.name for field in fields(LandmarkDetails))
_NUMBERS = ('position_sigma', 'shared_sigma', 'shared_sigma_deg', 'support', 'seen_ratio',
            'baseline_deg', 'last_seen')


def read_details(tree: Mapping[str, Any], where: str) -> LandmarkDetails:
    """Read the optional fields among a landmark's fields.

    Labels are two lists of equal length, ``{text: [...], weight: [...]}``, because a ROS parameter
    cannot be a list of mappings. A list of mappings, ``[{text: ..., weight: ...}, ...]``, is
    accepted, too.

    Raises MapError if a field is invalid; the message names the landmark and the field.
    """
    values: dict[str, Any] = {}
    for name in OPTIONAL_FIELDS:
        if tree.get(name) is None:
            continue
        value, here = tree[name], f'{where}: {name}'
        if name in _NUMBERS:
            values[name] = _number(value, here)
        elif name == 'labels':
            values[name] = _weighted(_label_rows(value, here), here)
        elif name == 'class_weights':
            if not isinstance(value, Mapping):
                raise MapError(f'{here}: must map class names to weights, not {value!r}')
            values[name] = _weighted(list(value.items()), here)
        else:
            values[name] = checked_text(value, here)
    if 'support' in values:
        values['support'] = int(values['support'])
    return LandmarkDetails(**values)


def _label_rows(value: Any, where: str) -> list[tuple[Any, Any]]:
    if isinstance(value, Mapping) and set(value) == {'text', 'weight'}:
        texts, weights = list(value['text']), list(value['weight'])
        if len(texts) == len(weights):
            return list(zip(texts, weights, strict=True))
    elif isinstance(value, list | tuple) and all(
            isinstance(row, Mapping) and set(row) == {'text', 'weight'} for row in value):
        return [(row['text'], row['weight']) for row in value]
    raise MapError(f'{where}: expected text and weight, two lists of equal length')


def _weighted(rows: list[tuple[Any, Any]], where: str) -> tuple[tuple[str, float], ...]:
    if not rows:
        raise MapError(f'{where}: is empty; omit the field')
    pairs = tuple((checked_text(text, where), _number(weight, where)) for text, weight in rows)
    if any(weight <= 0.0 for _, weight in pairs):
        raise MapError(f'{where}: weights must be above 0')
    return pairs


def checked_text(value: Any, where: str) -> str:
    """Return a text; MapError: it is something else, empty, or too long."""
    if not isinstance(value, str) or not value.strip():
        raise MapError(f'{where}: must be non-empty text (quote numbers and yes/no), '
                       f'not {value!r}')
    if len(value) > _MAX_TEXT_LENGTH:
        raise MapError(f'{where}: longer than {_MAX_TEXT_LENGTH} characters')
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MapError(f'{where}: must be a number, not {value!r}')
    if not 0.0 <= value <= sys.float_info.max:  # an int may be larger than any float
        raise MapError(f'{where}: {value} must be finite and not negative')
    return float(value)


def check_id(name: Any, where: str) -> None:
    """Raise MapError unless a landmark or tag has a name; a dot would split a ROS parameter."""
    if not isinstance(name, str) or not name or '.' in name:
        raise MapError(f'{where}: the id must be text without dots')


def checked_place(fields: Mapping[str, Any], where: str) -> tuple[tuple[float, ...], ...]:
    """Return center and orientation among the fields; MapError: one is invalid."""
    center = checked_numbers(fields['center'], 3, f'{where}: center')
    if max(map(abs, center)) > _MAX_COORDINATE_M:
        raise MapError(f'{where}: center: {center} is beyond {_MAX_COORDINATE_M:g} m')
    quat_xyzw = checked_numbers(fields['orientation'], 4, f'{where}: orientation')
    if abs(math.hypot(*quat_xyzw) - 1.0) > _MAX_QUATERNION_NORM_ERROR:
        raise MapError(f'{where}: orientation: the quaternion {quat_xyzw} has norm '
                       f'{math.hypot(*quat_xyzw):.3g}, expected 1')
    return center, quat_xyzw


def check_keys(tree: Any, expected: tuple[str, ...], where: str,
               optional: tuple[str, ...] = ()) -> None:
    """Raise MapError if fields are missing, unknown, or no mapping."""
    if not isinstance(tree, Mapping):
        raise MapError(f'{where}: expected the fields {", ".join(expected)}')
    known = tuple(dict.fromkeys(expected + optional))
    unknown = [str(key) for key in tree if key not in known]
    if unknown:
        named = ', '.join(f'{key}{did_you_mean(key, known)}' for key in unknown[:5])
        raise MapError(f'{where}: unknown field: {named} (known: {", ".join(known)})')
    missing = [key for key in expected if key not in tree]
    if missing:
        raise MapError(f'{where}: missing field: {", ".join(missing)}')


def checked_numbers(value: Any, count: int, where: str) -> tuple[float, ...]:
    """Return a number of finite numbers; MapError: the value is something else."""
    values = tuple(value) if isinstance(value, list | tuple) or hasattr(value, 'tolist') else ()
    numeric = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if len(values) != count or not numeric:
        raise MapError(f'{where}: must be {count} numbers, not {value!r:.60}')
    if not all(abs(v) <= sys.float_info.max for v in values):  # ints may be larger
        raise MapError(f'{where}: {value!r:.60} has values that are not finite')
    return tuple(map(float, values))
