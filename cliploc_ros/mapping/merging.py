# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Merge landmarks that are one object.

Two landmarks of one class that lie in one another are one object, unless frames show both at
once: a detector draws one box around one object.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.mapping.evidence import group_boxes, ious_with
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.views import Views


def merge_duplicates(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                     options: MappingOptions) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return the landmarks with duplicates merged, and which of them each box shows.

    Parameters
    ----------
    views : Views
    landmarks : Landmarks
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    options : MappingOptions
    """
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    rows_of = group_boxes(shown, len(centers))
    is_kept = np.ones(len(centers), dtype=np.bool_)
    for first, second in _close_pairs(landmarks, options.merge_distance):
        if not (is_kept[first] and is_kept[second]):
            continue
        keep, drop = ((first, second) if len(rows_of[first]) >= len(rows_of[second])
                      else (second, first))
        if _seen_together(views, rows_of[keep], rows_of[drop]) > options.max_shared_views:
            continue
        rows = np.sort(np.concatenate([rows_of[keep], rows_of[drop]]))
        fit = fit_ellipsoid(views, rows, centers[keep], bases[keep])
        before = np.concatenate([ious_with(views, rows_of[number], centers[number], bases[number])
                                 for number in (keep, drop)])
        after = ious_with(views, rows, fit.center, fit.basis)
        if len(rows) and after.mean() < before.mean() - options.merge_loss:
            continue
        centers[keep], bases[keep], rows_of[keep] = fit.center, fit.basis, rows
        is_kept[drop] = False
    numbers = np.cumsum(is_kept) - 1
    merged = np.full(len(shown), -1, dtype=np.int64)
    for number in np.nonzero(is_kept)[0]:
        merged[rows_of[number]] = numbers[number]
    return Landmarks(centers, bases, landmarks.classes).select(is_kept), merged


def _close_pairs(landmarks: Landmarks, max_distance: float) -> list[tuple[int, int]]:
    """Return the pairs of equal class nearer than a normalized distance, the nearest first."""
    if len(landmarks.centers) < 2:
        return []
    reach = np.linalg.norm(landmarks.bases, axis=(1, 2))
    tree = cKDTree(landmarks.centers)
    pairs = [(first, second) for first in range(len(reach))
             for second in tree.query_ball_point(landmarks.centers[first],
                                                 2.0 * max_distance * reach[first])
             if second != first and landmarks.classes[first] == landmarks.classes[second]]
    unique = sorted({(min(pair), max(pair)) for pair in pairs})
    close = [(normalized_distance(landmarks, *pair), pair) for pair in unique]
    return [pair for distance, pair in sorted(close) if distance < max_distance]


def normalized_distance(landmarks: Landmarks, first: int, second: int) -> float:
    """Return the distance of two centres in units of the summed shapes, about 1 if they touch."""
    shape = (landmarks.bases[first] @ landmarks.bases[first].T
             + landmarks.bases[second] @ landmarks.bases[second].T)
    offset = landmarks.centers[first] - landmarks.centers[second]
    return float(np.sqrt(offset @ np.linalg.solve(shape, offset)))


def _seen_together(views: Views, rows: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """Return in which share of the frames of the rarer of two landmarks the other shows, too."""
    shared = np.intersect1d(views.frames[rows], views.frames[others])
    return len(shared) / max(1, min(len(rows), len(others)))
