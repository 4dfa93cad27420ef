# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Optional fields of a landmark in the map file."""

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from cliploc_ros.errors import MapError

#: A class with a smaller share of its boxes makes no candidate of a landmark. A guess.
LEAST_CLASS_SHARE = 0.1
#: Labels that describe one landmark, with their weights.
WeightedLabels = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class LandmarkDetails:
    """Optional fields of a landmark. A field that the map lacks is None."""

    labels: WeightedLabels | None = None  #: Phrases with their weights, all above 0
    #: Detector classes with their share of the landmark's boxes, all above 0
    class_weights: tuple[tuple[str, float], ...] | None = None
    position_sigma: float | None = None  #: Standard deviation of the centre on each axis [m]
    #: In addition, the landmark and its neighbours are displaced together, and turned together
    #: about the cameras near them: standard deviations on each axis [m] [deg]
    shared_sigma: float | None = None
    shared_sigma_deg: float | None = None
    support: int | None = None  #: Frames that the landmark was fitted to
    #: Share of the frames which show the landmark's place in which it was detected, 0 to 1
    seen_ratio: float | None = None
    #: Greatest angle between two directions from which it was seen [deg]
    baseline_deg: float | None = None
    last_seen: float | None = None  #: Time of the last frame that showed it [s]
    source: str | None = None  #: Where it comes from

    def labels_with(self, label: str) -> WeightedLabels:
        """Return the labels; one that they lack, such as an edited one, counts like the best."""
        if self.labels is None:
            return ((label, 1.0),)
        if any(text == label for text, _ in self.labels):
            return self.labels
        return ((label, max(weight for _, weight in self.labels)), *self.labels)

    def likely_classes(self) -> tuple[str, ...]:
        """Return the classes whose share is great enough for a correspondence candidate."""
        weights = dict(self.class_weights or ())
        least = LEAST_CLASS_SHARE * sum(weights.values())
        return tuple(name for name, weight in weights.items() if weight >= least)

    def class_shares(self) -> tuple[tuple[str, float], ...]:
        """Return the likely classes, each with its weight over the greatest one."""
        weights = dict(self.class_weights or ())
        most = max(weights.values(), default=1.0)
        return tuple((name, weights[name] / most) for name in self.likely_classes())


def join_details(parts: Sequence[tuple[str, str, LandmarkDetails]]) -> LandmarkDetails:
    """Return the details of one thing that is several landmarks: label, class and details of each.

    It has the labels and classes of all, weighted by the frames that show each, and else what the
    first one has.
    """
    first = parts[0][2]
    labels = _shares([(one.labels_with(label), one.support or 1) for label, _, one in parts])
    classes = _shares([(one.class_weights or ((name, 1.0),), one.support or 1)
                       for _, name, one in parts])
    return replace(first, labels=labels if len(labels) > 1 else first.labels,
                   class_weights=classes if len(classes) > 1 else first.class_weights)


def _shares(parts: Sequence[tuple[WeightedLabels, int]]) -> WeightedLabels:
    """Return the shares of names in weighted parts, the greatest first."""
    shares = defaultdict[str, float](float)
    for names, weight in parts:
        for name, share in names:
            shares[name] += share * weight / sum(one for _, one in names)
    total = sum(shares.values())
    return tuple((name, shares[name] / total) for name in sorted(
        shares, key=lambda name: -shares[name]))


OPTIONAL_FIELDS = tuple(field.name for field in fields(LandmarkDetails))
_NUMBERS = ('position_sigma', 'shared_sigma', 'shared_sigma_deg', 'support', 'seen_ratio',
            'baseline_deg', 'last_seen')


def read_details(tree: Mapping[str, Any], where: str) -> LandmarkDetails:
    """Return the optional fields among a landmark's fields.

    Labels are two lists of equal length, ``{text: [...], weight: [...]}``, since a ROS parameter
    holds no list of mappings; such a list, ``[{text: ..., weight: ...}, ...]``, is read as well.

    MapError: names the landmark and the field to correct.
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
            values[name] = _text(value, here)
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
        raise MapError(f'{where}: is empty; leave the field out')
    pairs = tuple((_text(text, where), _number(weight, where)) for text, weight in rows)
    if any(weight <= 0.0 for _, weight in pairs):
        raise MapError(f'{where}: weights must be above 0')
    return pairs


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise MapError(f'{where}: must be text that is not empty, not {value!r}')
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MapError(f'{where}: must be a number, not {value!r}')
    if not 0.0 <= value <= sys.float_info.max:  # an int may be larger than any float
        raise MapError(f'{where}: {value} must be finite and not negative')
    return float(value)
