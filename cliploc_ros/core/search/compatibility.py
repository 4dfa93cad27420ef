# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which two candidates can be right at once; others never form a sample.

The size of a box gives the distance of its landmark, roughly. So two boxes and the angle between
them bound the distance between their landmarks, which the map knows.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.search.scene import Scene

# Limits of a landmark's distance, divided by the distance that the size of its box gives. Of 1375
# boxes of the recorded TUM frames, to which the map was fitted, 99.8 % lie between .67 and 2.5:
# boxes are larger than the ellipsoid, or cut by the border.
NEAREST, FARTHEST = 0.55, 2.5


def compatible_pairs(scene: Scene) -> NDArray[np.bool_]:
    """Return which pairs of candidates (c, c) may form a sample; symmetric.

    Detections and landmarks must differ, and the landmarks' distance in the map must be within
    the range that their boxes allow.
    """
    depths = _depths(scene)
    compatible = np.zeros((len(scene.pairs), len(scene.pairs)), dtype=np.bool_)
    _compare_near(scene, depths, np.argsort(scene.centers[scene.pairs[:, 1], 0]), compatible)
    return compatible


def _depths(scene: Scene) -> NDArray[np.float64]:
    """Return the distance (c,) [m] at which each candidate's landmark is as large as its box."""
    xx, xy, xz, yy, yz, zz = scene.shapes[scene.pairs[:, 1]].T
    # the determinant of a shape matrix is the product of the squared semi-axes
    determinant = (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    radius = np.cbrt(np.sqrt(np.maximum(determinant, 0.0)))
    half = scene.box_ellipses[scene.pairs[:, 0], 2:]
    # boxes are on the plane z = 1, whose points are farther away off the axis
    middle = scene.box_ellipses[scene.pairs[:, 0], :2]
    return np.asarray(radius / np.sqrt(half.prod(axis=1))
                      * np.sqrt(1.0 + (middle * middle).sum(axis=1)))


@compiled
def _compare_near(scene, depths, along_x, compatible):
    """Compare each candidate with those before it along the x axis, as far as it may reach.

    In a large map, and in several maps side by side, most are beyond.
    """
    pairs, deepest = scene.pairs, 0.0
    for depth in depths:
        deepest = max(deepest, depth)
    for number in range(pairs.shape[0]):
        i = along_x[number]
        reach = FARTHEST * (depths[i] + deepest)
        for before in range(number - 1, -1, -1):
            j = along_x[before]
            if scene.centers[pairs[i, 1], 0] - scene.centers[pairs[j, 1], 0] > reach:
                break
            if pairs[i, 0] == pairs[j, 0] or pairs[i, 1] == pairs[j, 1]:
                continue
            p, q = scene.centers[pairs[i, 1]], scene.centers[pairs[j, 1]]
            apart = sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
            # most pairs of a large map are farther apart than any camera between them allows
            if apart > FARTHEST * (depths[i] + depths[j]):
                continue
            a, b = scene.bearings[pairs[i, 0]], scene.bearings[pairs[j, 0]]
            cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
            low, high = _distance_range(depths[i], depths[j], cosine)
            if low <= apart <= high:
                compatible[i, j] = compatible[j, i] = True


@compiled
def _distance_range(depth_a, depth_b, cosine):
    """Return the least and greatest distance of two points whose depths are about these."""
    near_a, far_a = NEAREST * depth_a, FARTHEST * depth_a
    near_b, far_b = NEAREST * depth_b, FARTHEST * depth_b
    # The squared distance is convex in both depths: greatest at a corner, least on an edge.
    high = max(_square(near_a, near_b, cosine), _square(near_a, far_b, cosine),
               _square(far_a, near_b, cosine), _square(far_a, far_b, cosine))
    low = min(_square(near_a, min(max(near_a * cosine, near_b), far_b), cosine),
              _square(far_a, min(max(far_a * cosine, near_b), far_b), cosine),
              _square(min(max(near_b * cosine, near_a), far_a), near_b, cosine),
              _square(min(max(far_b * cosine, near_a), far_a), far_b, cosine))
    return sqrt(max(0.0, low)), sqrt(high)


@compiled
def _square(depth_a, depth_b, cosine):
    return depth_a * depth_a + depth_b * depth_b - 2.0 * depth_a * depth_b * cosine
