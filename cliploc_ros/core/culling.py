# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks can a pose see at all? A tree of spheres, so that large maps cost little more.

A landmark overlaps a box by more than the threshold only if it reaches into the pyramid through
all boxes, and only if it is near enough to appear large enough. Nothing else is left out, so no
result changes.
"""

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.compiled import compiled

# Children of a node, and landmarks of a leaf.
_BRANCHES = 8
_MORTON_BITS = 16
# So few landmarks are looked at faster than sorted.
_FEW = 64
# Landmarks that appear larger than this half angle are never too far.
_NEAR_ANGLE = np.radians(10.0)


class Tree(NamedTuple):
    """Spheres around landmarks that lie together, depth first: m nodes.

    Parameters
    ----------
    spheres : ndarray (m, 6)
        Centre and radius that hold the centres of a node's landmarks [m]; the radius of its
        largest landmark; the farthest at which one of them matters.
    rows : ndarray (m, 3)
        First landmark, the one behind the last, and the node that follows when this one is
        passed over; leaves are followed by the next node.
    leaves : ndarray (m,) of bool
    frustum : ndarray (4, 2)
        Unit normals of the sides of the pyramid through all boxes: x and z of left and right,
        y and z of upper and lower, inwards.
    """

    spheres: NDArray[np.float64]
    rows: NDArray[np.int64]
    leaves: NDArray[np.bool_]
    frustum: NDArray[np.float64]


def morton_order(centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return an order (u,) of points (u, 3) in which neighbours stand together."""
    if len(centers) <= _FEW:
        return np.arange(len(centers))
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
    return np.argsort(code, kind='stable')


def make_tree(landmarks: NDArray[np.float64], least_box_axes: NDArray[np.float64],
              boxes: NDArray[np.float64], iou_threshold: float
              ) -> tuple[Tree, NDArray[np.float64]]:
    """Return the tree of some landmarks, and the farthest at which each matters (u,) [m].

    Parameters
    ----------
    landmarks : ndarray (u, 9)
        Centre and shape of each, neighbours together.
    least_box_axes : ndarray (u,)
        The least product of semi-axes, of the boxes that may show each.
    boxes : ndarray (n, 4)
        Box ellipses.
    iou_threshold : float
        Less overlap does not count.
    """
    if len(landmarks) <= _FEW:
        everywhere = np.array([[0.0, 0.0, 0.0, inf, 0.0, inf]])
        return Tree(everywhere, np.array([[0, len(landmarks), 1]]), np.ones(1, dtype=np.bool_),
                    np.zeros((4, 2))), np.full(len(landmarks), inf)
    centers = landmarks[:, :3]
    # The trace of a shape matrix is the sum of the squared semi-axes, no less than the greatest.
    radii = np.sqrt(landmarks[:, 3] + landmarks[:, 6] + landmarks[:, 8])
    frustum, angle = _frustum(boxes)
    reaches = _reaches(radii, iou_threshold * least_box_axes, angle)
    firsts, lasts, spheres, leaves = [], [], [], []
    size = _BRANCHES
    while True:
        first = np.arange(0, len(centers), size)
        low = np.minimum.reduceat(centers, first)
        high = np.maximum.reduceat(centers, first)
        spheres.append(np.c_[(low + high) / 2, np.linalg.norm(high - low, axis=1) / 2,
                             np.maximum.reduceat(radii, first),
                             np.maximum.reduceat(reaches, first)])
        firsts.append(first)
        lasts.append(np.minimum(first + size, len(centers)))
        leaves.append(np.full(len(first), size == _BRANCHES))
        if len(first) == 1:
            break
        size *= _BRANCHES
    begin, end = np.concatenate(firsts), np.concatenate(lasts)
    order = np.lexsort((begin - end, begin))  # depth first: of equal begin the larger one
    begin, end = begin[order], end[order]
    leaf = np.concatenate(leaves)[order]
    follows = np.where(leaf, np.arange(1, len(order) + 1), np.searchsorted(begin, end))
    return Tree(np.concatenate(spheres)[order], np.stack([begin, end, follows], axis=1), leaf,
                frustum), reaches


def _frustum(boxes: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the sides of the pyramid through all boxes, and its greatest angle off the axis."""
    low = (boxes[:, :2] - boxes[:, 2:]).min(axis=0)
    high = (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
    sides = np.array([[1.0, -low[0]], [-1.0, high[0]], [1.0, -low[1]], [-1.0, high[1]]])
    corner = np.maximum(np.abs(low), np.abs(high))
    return (sides / np.linalg.norm(sides, axis=1, keepdims=True),
            float(np.arctan(np.linalg.norm(corner))))


def _reaches(radii: NDArray[np.float64], least_axes: NDArray[np.float64], angle: float
             ) -> NDArray[np.float64]:
    """Return from how far on landmarks appear smaller than what still counts.

    A sphere of the half angle a at an angle b off the axis has an outline on the plane z = 1
    whose semi-axes have the product ``sin^2 a cos a / (cos^2 b - sin^2 a)^(3/2)``.
    """
    widest = angle + _NEAR_ANGLE
    spread = np.cos(widest)**2 - np.sin(_NEAR_ANGLE)**2 if widest < np.pi / 2 else 0.0
    if spread <= 0.0:
        return np.full(len(radii), inf)
    sines = np.sqrt(np.maximum(least_axes, 0.0) * spread**1.5)
    return np.asarray(radii / np.maximum(np.minimum(sines, np.sin(_NEAR_ANGLE)), 1e-12))


@compiled
def visible_ranges(spheres, rows, leaves, frustum, rotations, translations, which, ranges):
    """Write the first and last landmark of each run that a pose may see; return how many runs."""
    r00, r01, r02 = rotations[which, 0, 0], rotations[which, 0, 1], rotations[which, 0, 2]
    r10, r11, r12 = rotations[which, 1, 0], rotations[which, 1, 1], rotations[which, 1, 2]
    r20, r21, r22 = rotations[which, 2, 0], rotations[which, 2, 1], rotations[which, 2, 2]
    t0, t1, t2 = translations[which, 0], translations[which, 1], translations[which, 2]
    node, count = 0, 0
    while node < spheres.shape[0]:
        px, py, pz = spheres[node, 0], spheres[node, 1], spheres[node, 2]
        around = spheres[node, 3]
        reach = spheres[node, 5] + around
        margin = -(spheres[node, 4] + around)
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        if (z < margin or x * x + y * y + z * z > reach * reach
                or x * frustum[0, 0] + z * frustum[0, 1] < margin
                or x * frustum[1, 0] + z * frustum[1, 1] < margin
                or y * frustum[2, 0] + z * frustum[2, 1] < margin
                or y * frustum[3, 0] + z * frustum[3, 1] < margin):
            node = rows[node, 2]
            continue
        if leaves[node]:
            ranges[count, 0], ranges[count, 1] = rows[node, 0], rows[node, 1]
            count += 1
        node += 1
    return count
