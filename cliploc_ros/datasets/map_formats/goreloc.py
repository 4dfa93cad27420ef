# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of GOReloc: NAME.objects, protocol buffers.

| message | fields |
|---|---|
| file | repeated object = 1 |
| object | ellipsoid = 1, object_id = 2, cat_ids = 3, cat_counts = 4, mappoint_id = 5 |
| ellipsoid | 16 floats = 1: a dual quadric, row by row |
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.datasets.map_formats.given_map import (
    GivenLandmark,
    GivenMap,
    LeftOut,
    class_name,
    make_id,
    read_bytes,
    shares,
)
from cliploc_ros.datasets.map_formats.protobuf import WireError, read_fields
from cliploc_ros.errors import DatasetError

_MAX_ASYMMETRY = 1e-3
_LEAST_SCALE = 1e-9


class QuadricError(Exception):
    """Why a dual quadric is no ellipsoid."""


class Ellipsoid(NamedTuple):
    """Centre (3,), semi-axes (3,) and quaternion x, y, z, w (4,)."""

    center: list[float]
    semi_axes: list[float]
    quat_xyzw: list[float]


def decompose(numbers: list[float]) -> Ellipsoid:
    """Return the ellipsoid of a dual quadric, 16 numbers row by row.

    Raises
    ------
    QuadricError
        It is no ellipsoid.
    """
    if len(numbers) != 16:
        raise QuadricError(f'its dual quadric has {len(numbers)} numbers, not 16')
    quadric = np.array(numbers, dtype=np.float64).reshape(4, 4)
    size = np.abs(quadric).max()
    if not np.isfinite(size):
        raise QuadricError('it has numbers that are not finite')
    if np.abs(quadric - quadric.T).max() > _MAX_ASYMMETRY * size:
        raise QuadricError('its dual quadric is not symmetric')
    if abs(quadric[3, 3]) <= _LEAST_SCALE * size:
        raise QuadricError('its dual quadric has no finite centre')
    quadric = 0.5 * (quadric + quadric.T) / -quadric[3, 3]
    center = -quadric[:3, 3]
    squares, axes = np.linalg.eigh(quadric[:3, :3] + np.outer(center, center))
    if squares[0] <= 0.0:
        shown = ' '.join(f'{square:.3g}' for square in squares)
        raise QuadricError(f'its dual quadric is no ellipsoid: squared semi-axes {shown}')
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    return Ellipsoid(center.tolist(), np.sqrt(squares).tolist(),
                     Rotation.from_matrix(axes).as_quat().tolist())


class _Object(NamedTuple):
    number: int
    quadric: list[float]
    categories: list[int]
    counts: list[int]


def read_goreloc(path: Path, class_names: Sequence[str]) -> GivenMap:
    """Read the objects of a GOReloc map.

    Class weights are the counts of its categories. An object without a category, or that is no
    ellipsoid, is left out.

    Parameters
    ----------
    path : Path
        NAME.objects.
    class_names : sequence of str
        Of the category indices.

    Raises
    ------
    DatasetError
        Names the file and what is wrong with it.
    """
    given = GivenMap([], [], [])
    try:
        for field in read_fields(memoryview(read_bytes(path))):
            if field.number != 1:
                raise WireError(f'field {field.number} is unknown')
            item = _read_object(field.message())
            try:
                given.landmarks.append(_landmark(item, class_names))
            except QuadricError as error:
                given.left_out.append(LeftOut(f'object {item.number}', str(error)))
    except WireError as error:
        raise DatasetError(f'{path}: is no complete NAME.objects of GOReloc: {error}') from error
    return given


def _read_object(data: memoryview) -> _Object:
    number = 0  # a zero is not stored
    quadric: list[float] = []
    categories: list[int] = []
    counts: list[int] = []
    for field in read_fields(data):
        if field.number == 1:
            quadric += read_quadric(field.message())
        elif field.number == 2:
            number = field.integer()
        elif field.number == 3:
            categories += field.integers()
        elif field.number == 4:
            counts += field.integers()
    return _Object(number, quadric, categories, counts)


def read_quadric(data: memoryview) -> list[float]:
    """Return the numbers of the message ellipsoid."""
    return [value for field in read_fields(data) if field.number == 1
            for value in field.floats()]


def _landmark(item: _Object, class_names: Sequence[str]) -> GivenLandmark:
    if len(item.categories) != len(item.counts) or not sum(item.counts):
        raise QuadricError(f'it has {len(item.categories)} categories with the counts '
                           f'{item.counts[:5]}')
    ellipsoid = decompose(item.quadric)
    votes: Counter[str] = Counter()
    for category, count in zip(item.categories, item.counts, strict=True):
        votes[class_name(class_names, category)] += count
    weights = shares(votes)
    name = weights[0][0]
    return GivenLandmark(
        make_id(name, item.number), name, name, ellipsoid.center, ellipsoid.semi_axes,
        ellipsoid.quat_xyzw, LandmarkDetails(class_weights=weights if len(weights) > 1 else None))
