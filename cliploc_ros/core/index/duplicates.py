# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that are the same object: a map may have an object twice."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def objects_of(centers: NDArray[np.float64], shapes: NDArray[np.float64],
               neighbours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of each landmark's object (L,): duplicates share one.

    Landmarks of one class are duplicates if the centre of one lies in the other, after both have
    got their mean shape. So books side by side are none.

    Parameters
    ----------
    centers, shapes : ndarray (L, 3), (L, 6)
        See cliploc_ros.core.geometry.ellipsoid.
    neighbours : ndarray (p, 2) of int
        Landmarks of one class that are near each other.
    """
    first, second = neighbours.T
    offsets = centers[second] - centers[first]
    means = (0.5 * (shapes[first] + shapes[second]))[:, _UPPER]
    inside = np.einsum('ni,nij,nj->n', offsets, np.linalg.inv(means), offsets) < 1.0
    links = coo_matrix((np.ones(int(inside.sum())), (first[inside], second[inside])),
                       (len(centers), len(centers)))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
