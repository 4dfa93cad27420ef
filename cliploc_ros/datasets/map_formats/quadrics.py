# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dual quadrics: the form in which OA-SLAM and GOReloc store ellipsoids.

An ellipsoid with centre c and shape matrix S = R diag(a^2) R^T has, up to a factor, the dual
quadric [[S - c c^T, -c], [-c^T, -1]].
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

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
