# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of objects by class: evidence on landmarks, and on the scale of a map."""

from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.views import NO_SIZE
from cliploc_ros.offline.vocabulary.vocabulary import common_name

# Least number of classes to estimate the scale of a map, and the least factor that is reported:
# ellipsoids enclose objects loosely, or only parts of them. Chosen.
_LEAST_CLASSES, _OFF = 3, 1.8


class Size(NamedTuple):
    """The longest extent of objects of a class [m], and the factor within which it lies."""

    extent_m: float
    factor: float

    @property
    def most_m(self) -> float:
        """Return the extent that almost no object exceeds [m]."""
        return self.extent_m * self.factor


def size_of_class(name: str) -> Size | None:
    """Return the size of objects of a class, ignoring the case of its name; None if unknown."""
    return _sizes().get(common_name(name))


def log_sizes(names: Iterable[str]) -> NDArray[np.float64]:
    """Return the sizes of objects of the classes (C, 2), in the form of Views.sizes.

    The factor that covers almost all objects counts as two standard deviations.
    """
    sizes = [size_of_class(name) for name in names]
    return np.array([NO_SIZE if size is None else
                     (np.log(0.5 * size.extent_m), 2.0 / np.log(size.factor)) for size in sizes])


@cache
def _sizes() -> dict[str, Size]:
    """Return the sizes of sizes.yaml by their classes."""
    text = (files('cliploc_ros.offline.vocabulary') / 'sizes.yaml').read_text(encoding='utf-8')
    return {name: Size(*values) for name, values in yaml.safe_load(text).items()}


def scale_by_sizes(landmark_map: LandmarkMap) -> float | None:
    """Estimate from the sizes of its objects by what factor a map is too large.

    The estimate is the median over classes of the median over their landmarks. Landmarks that were
    seen from one side only are ignored: they are longer towards the camera than their objects.
    None: too few classes have a size, or the sizes fit.
    """
    ratios: dict[str, list[float]] = {}
    sides = [detail.baseline_deg for detail in landmark_map.details] or [None] * len(landmark_map)
    for name, semi_axes, seen_deg in zip(landmark_map.class_ids, landmark_map.semi_axes, sides,
                                         strict=True):
        size = size_of_class(name)
        if size is not None and (seen_deg is None or seen_deg >= MappingOptions.min_baseline_deg):
            ratios.setdefault(name, []).append(2.0 * semi_axes.max() / size.extent_m)
    if len(ratios) < _LEAST_CLASSES:
        return None
    scale = float(np.median([np.median(of_class) for of_class in ratios.values()]))
    return scale if not 1.0 / _OFF <= scale <= _OFF else None
