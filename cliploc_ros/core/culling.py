# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks can a pose see at all? Trees of spheres, so that large maps cost little more.

A landmark overlaps a box by more than the threshold only if it reaches into the pyramid through
the boxes that may show it, and only if it is near enough to appear large enough. Nothing else is
left out, so no result changes. The trees, one for each class, belong to the map and are made
once; what a frame adds to them is a pyramid and a reach for each class that it shows.
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


class Forest(NamedTuple):
    """A map's landmarks in trees of spheres, one for each class: L landmarks, m nodes, C classes.

    160 bytes a landmark, of any number.

    Parameters
    ----------
    landmarks : ndarray (L, 10)
        Centre, shape and squared radius of each, classes and then neighbours together.
    numbers : ndarray (L,)
        Which of the map's landmarks they are.
    spheres : ndarray (m, 5)
        Centre and radius that hold the centres of a node's landmarks [m]; the radius of its
        largest landmark. Depth first.
    rows : ndarray (m, 3)
        First landmark, the one behind the last, and the node that follows when this one is
        passed over; leaves are followed by the next node.
    leaves : ndarray (m,) of bool
    roots : ndarray (C + 1,)
        Where each class's nodes begin.
    """

    landmarks: NDArray[np.float64]
    numbers: NDArray[np.int64]
    spheres: NDArray[np.float64]
    rows: NDArray[np.int64]
    leaves: NDArray[np.bool_]
    roots: NDArray[np.int64]


class Groups(NamedTuple):
    """The classes that a frame shows: g of them, each with all landmarks of its tree.

    Parameters
    ----------
    nodes : ndarray (g, 2)
        First node in the forest, and the one behind the last.
    sizes : ndarray (g,)
        How many landmarks.
    starts : ndarray (g + 1,)
        Where each group's detections begin in detections.
    detections : ndarray (v,)
        The detections that may show any of its landmarks.
    reaches : ndarray (g,)
        From how many of its radii on a landmark appears too small to count.
    frusta : ndarray (g, 4, 2)
        Unit normals of the sides of the pyramid through the group's boxes: x and z of left and
        right, y and z of upper and lower, inwards.
    """

    nodes: NDArray[np.int64]
    sizes: NDArray[np.int64]
    starts: NDArray[np.int64]
    detections: NDArray[np.int64]
    reaches: NDArray[np.float64]
    frusta: NDArray[np.float64]


def make_forest(centers: NDArray[np.float64], shapes: NDArray[np.float64],
                classes: NDArray[np.int64]) -> Forest:
    """Return the forest of a map.

    Parameters
    ----------
    centers, shapes : ndarray (L, 3), (L, 6)
        See cliploc_ros.core.ellipsoid.
    classes : ndarray (L,) of int
        0 to C - 1, each at least once.
    """
    numbers = np.lexsort((_morton_codes(centers), classes))
    centers, shapes = centers[numbers], shapes[numbers]
    # The trace of a shape matrix is the sum of the squared semi-axes, no less than the greatest.
    squares = shapes[:, 0] + shapes[:, 3] + shapes[:, 5]
    radii = np.sqrt(squares)
    counts = np.bincount(classes)
    firsts = np.cumsum(counts) - counts
    begins, ends, spheres, leaves = [], [], [], []
    size, growing = _BRANCHES, np.ones(len(counts), dtype=np.bool_)
    while growing.any():
        blocks = -(-counts // size)
        owner = np.repeat(np.arange(len(counts)), blocks)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
        begin = firsts[owner] + within * size
        low = np.minimum.reduceat(centers, begin)
        high = np.maximum.reduceat(centers, begin)
        nodes = np.c_[(low + high) / 2, np.linalg.norm(high - low, axis=1) / 2,
                      np.maximum.reduceat(radii, begin)]
        kept = growing[owner]
        begins.append(begin[kept])
        ends.append(np.minimum(begin + size, (firsts + counts)[owner])[kept])
        spheres.append(nodes[kept])
        leaves.append(np.full(int(kept.sum()), size == _BRANCHES))
        growing = blocks > 1
        size *= _BRANCHES
    first, last = np.concatenate(begins), np.concatenate(ends)
    order = np.lexsort((first - last, first))  # depth first: of equal first the larger one
    first, last, leaf = first[order], last[order], np.concatenate(leaves)[order]
    follows = np.where(leaf, np.arange(1, len(order) + 1), np.searchsorted(first, last))
    return Forest(np.column_stack([centers, shapes, squares]), numbers.astype(np.int64),
                  np.concatenate(spheres)[order], np.stack([first, last, follows], axis=1), leaf,
                  np.append(np.searchsorted(first, firsts), len(first)).astype(np.int64))


def no_forest() -> Forest:
    """Return a forest without landmarks."""
    return Forest(np.empty((0, 10)), np.empty(0, dtype=np.int64), np.empty((0, 5)),
                  np.empty((0, 3), dtype=np.int64), np.empty(0, dtype=np.bool_),
                  np.zeros(1, dtype=np.int64))


def make_groups(forest: Forest, classes: NDArray[np.int64], boxes: NDArray[np.float64],
                iou_threshold: float) -> Groups:
    """Return the groups of a frame.

    Parameters
    ----------
    forest : Forest
    classes : ndarray (n,) of int
        Of each detection; below 0 for none.
    boxes : ndarray (n, 4)
        Box ellipses, see Scene.
    iou_threshold : float
        Less overlap does not count.
    """
    shown = np.unique(classes[classes >= 0])
    rows = [np.nonzero(classes == one)[0] for one in shown]
    nodes = np.stack([forest.roots[shown], forest.roots[shown + 1]], axis=1)
    sizes = forest.rows[nodes[:, 1] - 1, 1] - forest.rows[nodes[:, 0], 0]
    pyramids = [_frustum(boxes[some]) for some in rows]
    reaches = [_reach(iou_threshold * float(boxes[some, 2:].prod(axis=1).min()), angle)
               for some, (_, angle) in zip(rows, pyramids, strict=True)]
    return Groups(nodes, sizes,
                  np.cumsum([0, *map(len, rows)]).astype(np.int64),
                  np.concatenate([*rows, np.empty(0, dtype=np.int64)]).astype(np.int64),
                  np.array(reaches, dtype=np.float64),
                  np.array([sides for sides, _ in pyramids]).reshape(-1, 4, 2))


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
    """Return from how many of its radii on a landmark appears smaller than what still counts.

    A sphere of the half angle a at an angle b off the axis has an outline on the plane z = 1
    whose semi-axes have the product ``sin^2 a cos a / (cos^2 b - sin^2 a)^(3/2)``.

    Parameters
    ----------
    least_axes : float
        The least such product that counts.
    angle : float
        How far off the axis landmarks are seen [rad].
    """
    widest = angle + _NEAR_ANGLE
    spread = np.cos(widest)**2 - np.sin(_NEAR_ANGLE)**2 if widest < np.pi / 2 else 0.0
    if spread <= 0.0:
        return inf
    sine = np.sqrt(max(least_axes, 0.0) * spread**1.5)
    return float(1.0 / max(min(sine, np.sin(_NEAR_ANGLE)), 1e-12))


@compiled
def visible_ranges(spheres, rows, leaves, nodes, reaches, frusta, group, rotations,
                   translations, which, ranges):
    """Write the first and last landmark of each run that a pose may see; return how many runs.

    Parameters
    ----------
    spheres, rows, leaves : ndarray
        See Forest.
    nodes, reaches, frusta : ndarray
        See Groups; group is one of them.
    rotations, translations : ndarray (p, 3, 3), (p, 3)
        Of camera_from_map; which is one of them.
    ranges : ndarray (l, 2)
        Room for every leaf of the group.
    """
    r00, r01, r02 = rotations[which, 0, 0], rotations[which, 0, 1], rotations[which, 0, 2]
    r10, r11, r12 = rotations[which, 1, 0], rotations[which, 1, 1], rotations[which, 1, 2]
    r20, r21, r22 = rotations[which, 2, 0], rotations[which, 2, 1], rotations[which, 2, 2]
    t0, t1, t2 = translations[which, 0], translations[which, 1], translations[which, 2]
    left_x, left_z = frusta[group, 0, 0], frusta[group, 0, 1]
    right_x, right_z = frusta[group, 1, 0], frusta[group, 1, 1]
    upper_y, upper_z = frusta[group, 2, 0], frusta[group, 2, 1]
    lower_y, lower_z = frusta[group, 3, 0], frusta[group, 3, 1]
    node, count = nodes[group, 0], 0
    while node < nodes[group, 1]:
        px, py, pz = spheres[node, 0], spheres[node, 1], spheres[node, 2]
        around, radius = spheres[node, 3], spheres[node, 4]
        reach = radius * reaches[group] + around
        margin = -(radius + around)
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        if (z < margin or x * x + y * y + z * z > reach * reach
                or x * left_x + z * left_z < margin or x * right_x + z * right_z < margin
                or y * upper_y + z * upper_z < margin or y * lower_y + z * lower_z < margin):
            node = rows[node, 2]
            continue
        if leaves[node]:
            ranges[count, 0], ranges[count, 1] = rows[node, 0], rows[node, 1]
            count += 1
        node += 1
    return count
