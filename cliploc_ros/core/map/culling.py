# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frustum culling with a tree of bounding spheres: only landmarks in view are compared.

A landmark can overlap a box by more than the threshold only if it extends into the frustum
through the boxes of its class, and if it is near enough to appear large enough. Culling drops
all other landmarks, so it changes no result. The map is sorted along a Morton curve once. For each
frame, a tree is built over the landmarks of the detected classes; it also bounds their depth.
"""

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import project
from cliploc_ros.core.kernels.compiled import compiled

#: Up to this number of landmarks, a comparison with all landmarks is faster than culling.
FEW = 64
# Children of each sphere of the tree.
_BRANCHES = 8
# Bits for each axis: the maximum for three axes in 64 bits, because joined maps are far apart.
_MORTON_BITS = 21
# Landmarks that appear larger than this half angle are never culled by depth.
_NEAR_ANGLE = np.radians(10.0)


class SortedLandmarks(NamedTuple):
    """All landmarks of a map in m rows along a Morton curve: neighbours have nearby rows.

    A landmark has a row for each of its classes.
    """

    landmarks: NDArray[np.float64]  #: (m, 9): centre and shape
    radii: NDArray[np.float64]  #: (m,): greatest semi-axis [m]
    numbers: NDArray[np.int64]  #: (m,): row in the map
    classes: NDArray[np.int32]  #: (m,): class number


#: An empty table.
NO_LANDMARKS = SortedLandmarks(np.empty((0, 9)), np.empty(0), np.empty(0, dtype=np.int64),
                               np.empty(0, dtype=np.int32))


class Groups(NamedTuple):
    """The landmarks of the detected classes: g classes, w landmarks, m spheres.

    A group is a class: its detections may show any of its landmarks, the members.
    """

    starts: NDArray[np.int64]  #: (g + 1,): index in `detections` of the first of each group
    detections: NDArray[np.int64]  #: (v,)
    #: (g + 1, 4, 2): inward unit normals of the sides of the frustum through the boxes of each
    #: group: x and z of left and right, y and z of top and bottom. The last row is the frustum
    #: through all boxes.
    frusta: NDArray[np.float64]
    #: (w, 2): row among the sorted landmarks, ascending, and group
    members: NDArray[np.int32]
    #: (d + 1,): index in `spheres` of the first sphere of each level of the tree. The first level
    #: has a sphere for each member, the next level one for each eight spheres, up to the root.
    levels: NDArray[np.int64]
    #: (m, 5): centre and radius of a sphere around all its members, and the depth of the centre
    #: beyond which all of them appear too small [m]
    spheres: NDArray[np.float64]


def sort_landmarks(centers: NDArray[np.float64], shapes: NDArray[np.float64],
                   members: NDArray[np.int64]) -> SortedLandmarks:
    """Sort the landmarks of a map along a Morton curve.

    Parameters
    ----------
    centers, shapes : ndarray (L, 3), (L, 6)
        See cliploc_ros.core.geometry.ellipsoid.
    members : ndarray (m, 2) of int
        Landmarks and class numbers, see ClassIndex.members.
    """
    members = members[np.argsort(morton_codes(centers[members[:, 0]]), kind='stable')]
    numbers, classes = members.T
    centers, shapes = centers[numbers], shapes[numbers]
    # the greatest eigenvalue of a shape matrix is the square of the greatest semi-axis
    squares = np.linalg.eigvalsh(shapes[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))[:, 2]
    squares *= 1.0 + 1e-9
    return SortedLandmarks(np.column_stack([centers, shapes]), np.sqrt(squares),
                           np.ascontiguousarray(numbers), classes.astype(np.int32))


def make_groups(sorted_landmarks: SortedLandmarks, classes: NDArray[np.int64],
                boxes: NDArray[np.float64], iou_threshold: float) -> Groups:
    """Group the landmarks of a frame by detected class.

    Parameters
    ----------
    classes : ndarray (n,) of int
        Class of each detection, as numbered in sorted_landmarks; negative: no class of the map.
    boxes : ndarray (n, 4)
        Box ellipses, see Scene.
    iou_threshold : float
        Landmarks that cannot overlap a box by more than this are culled.
    """
    shown = np.unique(classes[classes >= 0])
    rows = [np.nonzero(classes == class_number)[0] for class_number in shown]
    frusta = np.array([_frustum(boxes[of_group]) for of_group in (*rows, classes >= 0)])
    # tangents of the greatest angle between the optical axis and a corner of each box
    tangents = np.linalg.norm(np.abs(boxes[:, :2]) + boxes[:, 2:], axis=1)
    reaches = np.array([_reach(iou_threshold * float(boxes[of_group, 2:].prod(axis=1).min()),
                               float(np.arctan(tangents[of_group].max()))) for of_group in rows],
                       dtype=np.float64)
    # row and group of each landmark whose class is among the shown classes
    most = int(np.append(sorted_landmarks.classes, shown).max(initial=0))
    groups = np.full(1 + most, -1, dtype=np.int32)
    groups[shown] = np.arange(len(shown))
    groups = groups[sorted_landmarks.classes]
    numbers = np.nonzero(groups >= 0)[0]
    members = np.column_stack([numbers, groups[numbers]]).astype(np.int32)
    # the tree over the members
    radii = sorted_landmarks.radii[members[:, 0]]
    depths = radii * reaches[members[:, 1]]
    low = high = centers = sorted_landmarks.landmarks[members[:, 0], :3]
    spheres = [np.c_[centers, radii, depths]]
    while len(low) > 1:
        cuts = np.arange(0, len(low), _BRANCHES)
        low, high = np.minimum.reduceat(low, cuts), np.maximum.reduceat(high, cuts)
        radii, depths = np.maximum.reduceat(radii, cuts), np.maximum.reduceat(depths, cuts)
        around = np.linalg.norm(high - low, axis=1) / 2
        spheres.append(np.c_[(low + high) / 2, around + radii, around + depths])
    return Groups(np.cumsum([0, *map(len, rows)]).astype(np.int64),
                  np.concatenate([*rows, np.empty(0, dtype=np.int64)]).astype(np.int64),
                  frusta, members, np.cumsum([0, *map(len, spheres)]).astype(np.int64),
                  np.concatenate(spheres))


def morton_codes(centers: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the Morton codes (u,) of points (u, 3) in their bounding cube."""
    offsets = centers - centers.min(axis=0, initial=np.inf)
    extent = max(offsets.max(initial=0.0), 1e-9)
    cells = (offsets / extent * (2**_MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(centers), dtype=np.uint64)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in ((32, 0x1f00000000ffff), (16, 0x1f0000ff0000ff),
                            (8, 0x100f00f00f00f00f), (4, 0x10c30c30c30c30c3),
                            (2, 0x1249249249249249)):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def _frustum(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sides (4, 2) of the frustum through boxes, see Groups."""
    if not len(boxes):
        return np.zeros((4, 2))
    low = (boxes[:, :2] - boxes[:, 2:]).min(axis=0)
    high = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    sides = np.array([[1.0, -low[0]], [-1.0, high[0]], [1.0, -low[1]], [-1.0, high[1]]])
    return sides / np.linalg.norm(sides, axis=1, keepdims=True)


def _reach(least_axes: float, angle: float) -> float:
    """Return the depth, in radii of a landmark, beyond which its outline is too small.

    A sphere of radius r at a depth z and a distance d has an outline on the plane z = 1 whose
    semi-axes have the product ``r^2 sqrt(d^2 - r^2) / (z^2 - r^2)^(3/2)``.
    """
    widest = angle + _NEAR_ANGLE
    nearness = (np.sin(_NEAR_ANGLE) / np.cos(widest))**2 if widest < np.pi / 2 else 1.0
    if nearness >= 1.0:
        return inf
    square = max(least_axes, 1e-24) * np.cos(widest) * (1.0 - nearness)**1.5
    return float(max(1.0 / np.sin(_NEAR_ANGLE), 1.0 / np.sqrt(square)))


@compiled
def visible_members(groups, poses, which, seen):
    """Write the members that may be visible at a pose into seen[0]; return their number.

    The inner loop has no branches, because they would be hard to predict.

    Parameters
    ----------
    seen : ndarray (2, w) of int
        Output; the second row is a buffer for their parents in the tree.
    """
    rotations, translations = poses.rotations, poses.translations
    frusta, members, levels, spheres = groups.frusta, groups.members, groups.levels, groups.spheres
    r00, r01, r02 = rotations[which, 0, 0], rotations[which, 0, 1], rotations[which, 0, 2]
    r10, r11, r12 = rotations[which, 1, 0], rotations[which, 1, 1], rotations[which, 1, 2]
    r20, r21, r22 = rotations[which, 2, 0], rotations[which, 2, 1], rotations[which, 2, 2]
    t0, t1, t2 = translations[which, 0], translations[which, 1], translations[which, 2]
    if members.shape[0] == 0:
        return 0
    top, frustum = levels.shape[0] - 2, frusta.shape[0] - 1
    seen[(top + 1) % 2, 0], count = 0, 1
    for level in range(top, -1, -1):
        first, size = levels[level], levels[level + 1] - levels[level]
        above, here = (level + 1) % 2, level % 2
        found = 0
        for parent in range(count):
            begin = _BRANCHES * seen[above, parent]
            for number in range(begin, min(begin + _BRANCHES, size)):
                sphere = first + number
                if level == 0:
                    frustum = members[number, 1]
                px, py, pz = spheres[sphere, 0], spheres[sphere, 1], spheres[sphere, 2]
                behind = -spheres[sphere, 3]
                x = r00 * px + r01 * py + r02 * pz + t0
                y = r10 * px + r11 * py + r12 * pz + t1
                z = r20 * px + r21 * py + r22 * pz + t2
                seen[here, found] = number
                found += ((z >= behind) & (z <= spheres[sphere, 4])
                          & (x * frusta[frustum, 0, 0] + z * frusta[frustum, 0, 1] >= behind)
                          & (x * frusta[frustum, 1, 0] + z * frusta[frustum, 1, 1] >= behind)
                          & (y * frusta[frustum, 2, 0] + z * frusta[frustum, 2, 1] >= behind)
                          & (y * frusta[frustum, 3, 0] + z * frusta[frustum, 3, 1] >= behind))
        count = found
    return count


@compiled
def project_visible(landmarks, groups, poses, which, seen, outlines, owners, out):
    """Project the members that may be visible at a pose; return the row after their outlines.

    Parameters
    ----------
    landmarks : ndarray (L, 9)
        See SortedLandmarks.
    outlines, owners : ndarray (o, 6), (o,)
        Output: visible outlines and the group of each, from row `out`.
    """
    members = groups.members
    for place in range(visible_members(groups, poses, which, seen)):
        row, group = np.int64(members[seen[0, place], 0]), members[seen[0, place], 1]
        project(landmarks, row, row + 1, poses, which, outlines, out)
        if outlines[out, 2] > 0.0:
            owners[out] = group
            out += 1
    return out
