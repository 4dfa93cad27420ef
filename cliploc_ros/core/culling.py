# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks can a pose see at all? A tree of spheres, so that large maps cost little more.

A landmark overlaps a box by more than the threshold only if it reaches into the pyramid through
all boxes, and only if it is near enough to appear large enough. Nothing else is left out, so no
result changes. The tree belongs to the map and is made once; what a frame adds to it is the
pyramid, and a reach for each class that it shows.
"""

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.compiled import compiled

#: So few landmarks are looked at faster than sorted.
FEW = 64
# Children of a node, and landmarks of a leaf.
_BRANCHES = 8
_MORTON_BITS = 16
# Landmarks that appear larger than this half angle are never too far.
_NEAR_ANGLE = np.radians(10.0)


class Tree(NamedTuple):
    """A map's landmarks in a tree of spheres: L landmarks, m nodes; 120 bytes a landmark.

    Parameters
    ----------
    landmarks : ndarray (L, 10)
        Centre, shape and squared radius of each, neighbours together.
    numbers, classes : ndarray (L,)
        Which of the map's landmarks they are, and their classes.
    spheres : ndarray (m, 5)
        Centre and radius that hold the centres of a node's landmarks [m]; the radius of its
        largest landmark. Depth first.
    rows : ndarray (m, 3)
        First landmark, the one behind the last, and the node that follows when this one is
        passed over; leaves are followed by the next node.
    leaves : ndarray (m,) of bool
    counts : ndarray (C,)
        How many landmarks each class has.
    """

    landmarks: NDArray[np.float64]
    numbers: NDArray[np.int64]
    classes: NDArray[np.int64]
    spheres: NDArray[np.float64]
    rows: NDArray[np.int64]
    leaves: NDArray[np.bool_]
    counts: NDArray[np.int64]


class Groups(NamedTuple):
    """The classes that a frame shows: g groups of detections that show any of a class.

    Parameters
    ----------
    of_classes : ndarray (C,)
        Each class's group; -1 for classes that the frame does not show.
    starts : ndarray (g + 1,)
        Where each group's detections begin in detections.
    detections : ndarray (v,)
    reaches : ndarray (g,)
        At a depth of how many of its radii a landmark appears too small to count.
    frustum : ndarray (4, 2)
        Unit normals of the sides of the pyramid through all boxes: x and z of left and right,
        y and z of upper and lower, inwards.
    """

    of_classes: NDArray[np.int64]
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]
    reaches: NDArray[np.float64]
    frustum: NDArray[np.float64]


def make_tree(centers: NDArray[np.float64], shapes: NDArray[np.float64],
              classes: NDArray[np.int64]) -> Tree:
    """Return the tree of a map.

    Parameters
    ----------
    centers, shapes : ndarray (L, 3), (L, 6)
        See cliploc_ros.core.ellipsoid.
    classes : ndarray (L,) of int
        From 0.
    """
    numbers = np.argsort(_morton_codes(centers), kind='stable')
    centers, shapes = centers[numbers], shapes[numbers]
    # the greatest eigenvalue of a shape matrix is the square of the greatest semi-axis
    squares = np.linalg.eigvalsh(shapes[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))[:, 2]
    squares *= 1.0 + 1e-9
    radii = np.sqrt(squares)
    begins, ends, spheres, leaves = [], [], [], []
    size = _BRANCHES
    while True:
        begin = np.arange(0, len(centers), size)
        low = np.minimum.reduceat(centers, begin)
        high = np.maximum.reduceat(centers, begin)
        spheres.append(np.c_[(low + high) / 2, np.linalg.norm(high - low, axis=1) / 2,
                             np.maximum.reduceat(radii, begin)])
        begins.append(begin)
        ends.append(np.minimum(begin + size, len(centers)))
        leaves.append(np.full(len(begin), size == _BRANCHES))
        if len(begin) == 1:
            break
        size *= _BRANCHES
    first, last = np.concatenate(begins), np.concatenate(ends)
    order = np.lexsort((first - last, first))  # depth first: of equal first the larger one
    first, last, leaf = first[order], last[order], np.concatenate(leaves)[order]
    follows = np.where(leaf, np.arange(1, len(order) + 1), np.searchsorted(first, last))
    return Tree(np.column_stack([centers, shapes, squares]), numbers.astype(np.int64),
                classes[numbers], np.concatenate(spheres)[order],
                np.stack([first, last, follows], axis=1), leaf,
                np.bincount(classes).astype(np.int64))


def no_tree() -> Tree:
    """Return a tree without landmarks."""
    nothing = np.empty(0, dtype=np.int64)
    return Tree(np.empty((0, 10)), nothing, nothing, np.empty((0, 5)), nothing.reshape(0, 3),
                np.empty(0, dtype=np.bool_), nothing)


def make_groups(class_count: int, classes: NDArray[np.int64], boxes: NDArray[np.float64],
                iou_threshold: float) -> Groups:
    """Return the groups of a frame.

    Parameters
    ----------
    class_count : int
        C.
    classes : ndarray (n,) of int
        Of each detection; below 0 for none.
    boxes : ndarray (n, 4)
        Box ellipses, see Scene.
    iou_threshold : float
        Less overlap does not count.
    """
    shown = np.unique(classes[classes >= 0])
    of_classes = np.full(class_count, -1, dtype=np.int64)
    of_classes[shown] = np.arange(len(shown))
    rows = [np.nonzero(classes == one)[0] for one in shown]
    frustum, angle = _frustum(boxes[classes >= 0]) if rows else (np.zeros((4, 2)), 0.0)
    reaches = [_reach(iou_threshold * float(boxes[some, 2:].prod(axis=1).min()), angle)
               for some in rows]
    return Groups(of_classes, np.cumsum([0, *map(len, rows)]).astype(np.int64),
                  np.concatenate([*rows, np.empty(0, dtype=np.int64)]).astype(np.int64),
                  np.array(reaches, dtype=np.float64), frustum)


def _morton_codes(centers: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return numbers (u,) of points (u, 3) by whose order neighbours stand together."""
    low, extent = centers.min(axis=0), np.ptp(centers, axis=0).max()
    cells = ((centers - low) / max(extent, 1e-9) * (2**_MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(centers), dtype=np.uint64)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in ((32, 0x1f00000000ffff), (16, 0x1f0000ff0000ff),
                            (8, 0x100f00f00f00f00f), (4, 0x10c30c30c30c30c3),
                            (2, 0x1249249249249249)):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def _frustum(boxes: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the sides of the pyramid through all boxes, and its greatest angle off the axis."""
    low = (boxes[:, :2] - boxes[:, 2:]).min(axis=0)
    high = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    sides = np.array([[1.0, -low[0]], [-1.0, high[0]], [1.0, -low[1]], [-1.0, high[1]]])
    corner = np.maximum(np.abs(low), np.abs(high))
    return (sides / np.linalg.norm(sides, axis=1, keepdims=True),
            float(np.arctan(np.linalg.norm(corner))))


def _reach(least_axes: float, angle: float) -> float:
    """Return at a depth of how many of its radii a landmark appears smaller than what counts.

    A sphere of radius r at a depth z and a distance d has an outline on the plane z = 1 whose
    semi-axes have the product ``r^2 sqrt(d^2 - r^2) / (z^2 - r^2)^(3/2)``.

    Parameters
    ----------
    least_axes : float
        The least such product that counts.
    angle : float
        How far off the axis landmarks are seen [rad].
    """
    widest = angle + _NEAR_ANGLE
    nearness = (np.sin(_NEAR_ANGLE) / np.cos(widest))**2 if widest < np.pi / 2 else 1.0
    if nearness >= 1.0:
        return inf
    square = max(least_axes, 1e-24) * np.cos(widest) * (1.0 - nearness)**1.5
    return float(max(1.0 / np.sin(_NEAR_ANGLE), 1.0 / np.sqrt(square)))


@compiled
def visible_ranges(spheres, rows, leaves, reaches, frustum, rotations, translations, which,
                   ranges):
    """Write the first and last landmark of each run that a pose may see; return how many runs.

    Parameters
    ----------
    spheres, rows, leaves : ndarray
        See Tree.
    reaches, frustum : ndarray
        See Groups.
    rotations, translations : ndarray (p, 3, 3), (p, 3)
        Of camera_from_map; which is one of them.
    ranges : ndarray (l, 2)
        Room for every leaf.
    """
    r00, r01, r02 = rotations[which, 0, 0], rotations[which, 0, 1], rotations[which, 0, 2]
    r10, r11, r12 = rotations[which, 1, 0], rotations[which, 1, 1], rotations[which, 1, 2]
    r20, r21, r22 = rotations[which, 2, 0], rotations[which, 2, 1], rotations[which, 2, 2]
    t0, t1, t2 = translations[which, 0], translations[which, 1], translations[which, 2]
    left_x, left_z, right_x, right_z = frustum[0, 0], frustum[0, 1], frustum[1, 0], frustum[1, 1]
    upper_y, upper_z, lower_y, lower_z = frustum[2, 0], frustum[2, 1], frustum[3, 0], frustum[3, 1]
    farthest = np.max(reaches)
    node, count = 0, 0
    while node < spheres.shape[0]:
        px, py, pz = spheres[node, 0], spheres[node, 1], spheres[node, 2]
        around, radius = spheres[node, 3], spheres[node, 4]
        reach = radius * farthest + around
        margin = -(radius + around)
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        if (z < margin or z > reach
                or x * left_x + z * left_z < margin or x * right_x + z * right_z < margin
                or y * upper_y + z * upper_z < margin or y * lower_y + z * lower_z < margin):
            node = rows[node, 2]
            continue
        if leaves[node]:
            ranges[count, 0], ranges[count, 1] = rows[node, 0], rows[node, 1]
            count += 1
        node += 1
    return count
