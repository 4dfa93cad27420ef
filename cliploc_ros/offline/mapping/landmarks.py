# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks while a map is built: ellipsoids, their boxes in images, and derivatives of these.

An ellipsoid is its centre c and a basis B (3, 3) whose columns are its semi-axes, so that its
shape matrix is S = B B^T. In the camera, p = R c + t and G = R B, N = G G^T. Its outline's
bounding box on the plane z = 1 is, with d = z^2 - N_zz,

    u +- sqrt(u^2 + (N_xx - x^2) / d),   u = (x z - N_xz) / d,

and the same in y. Shapes change by S' = B exp(D) B^T with a symmetric D: six numbers without
the singularities of angles (a sphere has no orientation). The diagonal of D is twice the change of
the logarithms of the semi-axes.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.landmark_map import LandmarkMap

#: Numbers of a landmark: centre, then the upper triangle of D, row by row.
LANDMARK_SIZE = 9
#: Numbers of a pose: translation, then rotation, both in the camera's coordinate frame.
POSE_SIZE = 6
# Row and column of each number of D.
_ROWS = np.array([0, 0, 0, 1, 1, 2])
_COLUMNS = np.array([0, 1, 2, 1, 2, 2])


@compiled
def project_box(rotation, translation, center, basis, box):
    """Write the box of an ellipsoid on the plane z = 1; return whether it is entirely in front.

    Rotation and translation are those of camera_from_map. The box (4,) is left, top, right,
    bottom; it is not written if the ellipsoid is not entirely in front.
    """
    r = rotation
    x = r[0, 0] * center[0] + r[0, 1] * center[1] + r[0, 2] * center[2] + translation[0]
    y = r[1, 0] * center[0] + r[1, 1] * center[1] + r[1, 2] * center[2] + translation[1]
    z = r[2, 0] * center[0] + r[2, 1] * center[1] + r[2, 2] * center[2] + translation[2]
    if not z > 0.0:
        return False
    nxx = nyy = nzz = nxz = nyz = 0.0
    for k in range(3):
        gx = r[0, 0] * basis[0, k] + r[0, 1] * basis[1, k] + r[0, 2] * basis[2, k]
        gy = r[1, 0] * basis[0, k] + r[1, 1] * basis[1, k] + r[1, 2] * basis[2, k]
        gz = r[2, 0] * basis[0, k] + r[2, 1] * basis[1, k] + r[2, 2] * basis[2, k]
        nxx += gx * gx
        nyy += gy * gy
        nzz += gz * gz
        nxz += gx * gz
        nyz += gy * gz
    depth = z * z - nzz
    if not depth > 1e-12 * z * z:
        return False
    u, v = (x * z - nxz) / depth, (y * z - nyz) / depth
    uu, vv = u * u + (nxx - x * x) / depth, v * v + (nyy - y * y) / depth
    if not (uu > 0.0 and vv > 0.0):
        return False
    half_u, half_v = sqrt(uu), sqrt(vv)
    box[0], box[1], box[2], box[3] = u - half_u, v - half_v, u + half_u, v + half_v
    return True


@compiled
def linearize_box(rotation, translation, center, basis, box, by_landmark, by_pose):
    """Write the box of an ellipsoid and its derivatives; return whether it is entirely in front.

    The derivatives of the edges are by_landmark (4, 9) by the centre in the map and by D, and
    by_pose (4, 6) by a small motion of the map in the camera: p' = p + v + w x p.
    """
    if not project_box(rotation, translation, center, basis, box):
        return False
    p = rotation @ center + translation
    g = rotation @ basis
    z = p[2]
    depth = z * z - (g[2, 0] * g[2, 0] + g[2, 1] * g[2, 1] + g[2, 2] * g[2, 2])
    by_p = np.zeros(3)
    by_n = np.zeros(3)  # of this axis with itself, with z, of z with itself
    for axis in range(2):
        a = p[axis]
        naa = g[axis, 0] * g[axis, 0] + g[axis, 1] * g[axis, 1] + g[axis, 2] * g[axis, 2]
        u = 0.5 * (box[axis] + box[axis + 2])
        half = 0.5 * (box[axis + 2] - box[axis])
        q = (naa - a * a) / depth
        for side in range(2):
            sign = -1.0 if side == 0 else 1.0
            edge = axis + 2 * side
            by_u = 1.0 + sign * u / half
            by_q = sign * 0.5 / half
            by_p[0] = by_p[1] = 0.0
            by_p[axis] = (by_u * z - by_q * 2.0 * a) / depth
            by_p[2] = (by_u * (a - 2.0 * u * z) - by_q * 2.0 * q * z) / depth
            by_n[0] = by_q / depth
            by_n[1] = -by_u / depth
            by_n[2] = (by_u * u + by_q * q) / depth
            _chain(rotation, p, g, axis, by_p, by_n, by_landmark[edge], by_pose[edge])
    return True


@compiled
def _chain(rotation, p, g, axis, by_p, by_n, by_landmark, by_pose):
    """Write one edge's derivatives by landmark (9,) and pose (6,) from those by p and N."""
    for k in range(3):
        by_landmark[k] = (by_p[0] * rotation[0, k] + by_p[1] * rotation[1, k]
                          + by_p[2] * rotation[2, k])
        by_pose[k] = by_p[k]
    for number in range(6):
        i, j = _ROWS[number], _COLUMNS[number]
        twice = 1.0 if i == j else 2.0
        by_landmark[3 + number] = twice * (
            by_n[0] * g[axis, i] * g[axis, j]
            + 0.5 * by_n[1] * (g[axis, i] * g[2, j] + g[2, i] * g[axis, j])
            + by_n[2] * g[2, i] * g[2, j])
    # d p = w x p, d G = [w] G: N's derivative is [w] N - N [w]
    naa = nzz = naz = nbz = nab = 0.0
    other = 1 - axis
    for k in range(3):
        naa += g[axis, k] * g[axis, k]
        nzz += g[2, k] * g[2, k]
        naz += g[axis, k] * g[2, k]
        nbz += g[other, k] * g[2, k]
        nab += g[axis, k] * g[other, k]
    # rows of [w]: d g_x = w_y g_z - w_z g_y, d g_y = w_z g_x - w_x g_z, d g_z = w_x g_y - w_y g_x
    turn = 1.0 if axis == 0 else -1.0
    by_pose[3] = by_p[2] * p[1] - by_p[1] * p[2]
    by_pose[4] = by_p[0] * p[2] - by_p[2] * p[0]
    by_pose[5] = by_p[1] * p[0] - by_p[0] * p[1]
    # across: the rotation about the other image axis, which turns this axis to z
    across, own = 4 - axis, 3 + axis
    by_pose[across] += turn * (2.0 * by_n[0] * naz + by_n[1] * (nzz - naa) - 2.0 * by_n[2] * naz)
    by_pose[own] += turn * (by_n[1] * nab + 2.0 * by_n[2] * nbz)
    by_pose[5] += turn * (-2.0 * by_n[0] * nab - by_n[1] * nbz)


@compiled
def box_iou(first, second, bounds):
    """Return the intersection over union of two boxes (4,), the first one clipped to bounds."""
    left, top = max(first[0], bounds[0]), max(first[1], bounds[1])
    right, bottom = min(first[2], bounds[2]), min(first[3], bounds[3])
    if not (right > left and bottom > top):
        return 0.0
    width = min(right, second[2]) - max(left, second[0])
    height = min(bottom, second[3]) - max(top, second[1])
    if not (width > 0.0 and height > 0.0):
        return 0.0
    shared = width * height
    return shared / ((right - left) * (bottom - top)
                     + (second[2] - second[0]) * (second[3] - second[1]) - shared)


@compiled
def move_ellipsoid(center, basis, step, new_center, new_basis):
    """Write an ellipsoid moved by a step (9,) of its numbers.

    exp(D) is computed as the square of exp(D / 2) to second order, so that shapes stay positive
    definite. The new basis is orthogonal: its columns are the semi-axes.
    """
    half = np.empty((3, 3))
    for number in range(6):
        i, j = _ROWS[number], _COLUMNS[number]
        half[i, j] = half[j, i] = 0.5 * step[3 + number]
    root = np.eye(3) + half + 0.5 * (half @ half)
    stretched = basis @ root
    squares, directions = np.linalg.eigh(stretched @ stretched.T)
    new_center[:] = center + step[:3]
    new_basis[:] = directions * np.sqrt(np.maximum(squares, 1e-8))


_NO_NAMES = np.empty((0, 2), dtype=np.int64)


class Landmarks(NamedTuple):
    """L ellipsoids of known classes."""

    centers: NDArray[np.float64]  #: (L, 3): [m]
    #: (L, 3, 3): their columns are the semi-axes [m], see cliploc_ros.offline.mapping.landmarks
    bases: NDArray[np.float64]
    classes: NDArray[np.int64]  #: (L,): detector classes; -1: a class without boxes
    #: (k, 2): a landmark and a further class that a detector gives it, each pair once
    others: NDArray[np.int64] = _NO_NAMES

    @property
    def names(self) -> NDArray[np.int64]:
        """Return the pairs (m, 2) of a landmark and one of its classes, without class -1."""
        own = np.stack([np.arange(len(self.classes)), self.classes], axis=1)
        return np.concatenate([own[self.classes >= 0], self.others])

    @staticmethod
    def none() -> 'Landmarks':
        """Return no landmarks."""
        return Landmarks(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))

    @staticmethod
    def joined(*parts: 'Landmarks') -> 'Landmarks':
        """Return the landmarks of all parts."""
        starts = np.cumsum([0, *(len(part.classes) for part in parts)])
        shifted = [part._replace(others=part.others + np.array([start, 0]))
                   for part, start in zip(parts, starts[:-1].tolist(), strict=True)]
        columns = zip(Landmarks.none(), *shifted, strict=True)
        return Landmarks(*(np.concatenate(column) for column in columns))

    def axes_and_quats(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return semi-axes (L, 3) [m] and quaternions x, y, z, w (L, 4)."""
        semi_axes = np.linalg.norm(self.bases, axis=1)
        rotations = self.bases / semi_axes[:, None, :]
        rotations[np.linalg.det(rotations) < 0.0] *= -1.0
        return semi_axes, Rotation.from_matrix(rotations).as_quat()

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> 'Landmarks':
        """Return the landmarks in the given rows."""
        places = np.full(len(self.classes), -1, dtype=np.int64)
        places[rows] = np.arange(len(places[rows]))
        others = np.stack([places[self.others[:, 0]], self.others[:, 1]], axis=1)
        return Landmarks(self.centers[rows], self.bases[rows], self.classes[rows],
                         others[others[:, 0] >= 0])


def landmarks_of_map(landmark_map: LandmarkMap, class_names: Sequence[str]) -> Landmarks:
    """Return the landmarks of a map, each with those of its classes that are in class_names.

    A landmark without such a class gets -1.
    """
    numbers = {name: number for number, name in enumerate(class_names)}
    rotations = Rotation.from_quat(landmark_map.quats_xyzw).as_matrix()
    known = [[numbers[name] for name in classes_of(landmark_map, row) if name in numbers]
             for row in range(len(landmark_map))]
    others = [(row, number) for row, own in enumerate(known) for number in own[1:]]
    return Landmarks(landmark_map.centers, rotations * landmark_map.semi_axes[:, None, :],
                     np.array([own[0] if own else -1 for own in known], dtype=np.int64),
                     np.array(others, dtype=np.int64).reshape(-1, 2))


def classes_of(landmark_map: LandmarkMap, row: int) -> tuple[str, ...]:
    """Return all classes that a landmark was detected as."""
    weights = landmark_map.details[row].class_weights if landmark_map.details else None
    names = [landmark_map.class_ids[row], *(name for name, _ in weights or ())]
    return tuple(dict.fromkeys(names))


def group_boxes(shown: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the rows of the boxes of each landmark, in ascending order."""
    order = np.argsort(shown, kind='stable')
    bounds = np.searchsorted(shown[order], np.arange(count + 1))
    return [order[bounds[number]:bounds[number + 1]] for number in range(count)]


def unused_ids(class_names: Sequence[str], used: Iterable[str] = ()) -> tuple[str, ...]:
    """Return an unused id for each landmark, made of its class and a number."""
    taken, counts, ids = set(used), Counter[str](), list[str]()
    for name in class_names:
        word = ''.join(char if char.isalnum() else '_' for char in name)
        counts[word] += 1
        while f'{word}_{counts[word]}' in taken:
            counts[word] += 1
        ids.append(f'{word}_{counts[word]}')
        taken.add(ids[-1])
    return tuple(ids)
