# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Merge landmarks that are one object.

Two landmarks that lie in one another are one object, unless frames show both of them apart. A
detector may call one object by two names, in different frames or in one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.mapping.evidence import ious_with
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.projection import box_iou
from cliploc_ros.mapping.views import Views

# Two boxes of one frame that overlap more than this are one object. A guess.
_ONE_BOX_IOU = 0.6


class Merged(NamedTuple):
    """Landmarks after merging: K of L are left."""

    landmarks: Landmarks  #: The K that are left, in their order
    #: (n,): the landmark, of those that are left, that each box shows, -1 for none
    shown: NDArray[np.int64]
    #: (L,): the landmark, of those before merging, that each one is part of now
    into: NDArray[np.int64]


def merge_duplicates(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                     options: MappingOptions) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return the landmarks with duplicates merged, and which of them each box shows.

    Parameters
    ----------
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    """
    merged = merge_pairs(views, landmarks, shown,
                         pairs_of_one_class(landmarks, options.merge_distance), options)
    return merged.landmarks, merged.shown


def merge_classes(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                  options: MappingOptions) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return the landmarks with those merged that are one object under two classes.

    The class that the more boxes have stays. Parameters as in merge_duplicates.
    """
    pairs = [pair for pair in _close_pairs(landmarks, options.class_merge_distance)
             if landmarks.classes[pair[0]] != landmarks.classes[pair[1]]]
    merged = merge_pairs(views, landmarks, shown, pairs, options)
    return merged.landmarks, merged.shown


def pairs_of_one_class(landmarks: Landmarks, max_distance: float) -> list[tuple[int, int]]:
    """Return the pairs of one class nearer than a normalized distance, the nearest first."""
    return [pair for pair in _close_pairs(landmarks, max_distance)
            if landmarks.classes[pair[0]] == landmarks.classes[pair[1]]]


def merge_pairs(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                pairs: list[tuple[int, int]], options: MappingOptions) -> Merged:
    """Merge those of the pairs that are one object, in the order given."""
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    rows_of = group_boxes(shown, len(centers))
    into = np.arange(len(centers))
    for first, second in pairs:
        if into[first] != first or into[second] != second:
            continue
        keep, drop = ((first, second) if len(rows_of[first]) >= len(rows_of[second])
                      else (second, first))
        if seen_apart(views, rows_of[keep], rows_of[drop]) > options.max_seen_apart:
            continue
        rows = np.sort(np.concatenate([rows_of[keep], rows_of[drop]]))
        fit = fit_ellipsoid(views, rows, centers[keep], bases[keep])
        before = np.concatenate([ious_with(views, rows_of[number], centers[number], bases[number])
                                 for number in (keep, drop)])
        after = ious_with(views, rows, fit.center, fit.basis)
        if len(rows) and after.mean() < before.mean() - options.merge_loss:
            continue
        centers[keep], bases[keep], rows_of[keep] = fit.center, fit.basis, rows
        into[into == drop] = keep
    is_kept = into == np.arange(len(into))
    numbers = np.cumsum(is_kept) - 1
    merged = np.full(len(shown), -1, dtype=np.int64)
    for number in np.nonzero(is_kept)[0]:
        merged[rows_of[number]] = numbers[number]
    return Merged(Landmarks(centers, bases, landmarks.classes).select(is_kept), merged, into)


def _close_pairs(landmarks: Landmarks, max_distance: float) -> list[tuple[int, int]]:
    """Return the pairs nearer than a normalized distance, the nearest first."""
    if len(landmarks.centers) < 2:
        return []
    reach = np.linalg.norm(landmarks.bases, axis=(1, 2))
    # the smaller of two touching landmarks lies within the reach of the larger one
    tree = cKDTree(landmarks.centers)
    pairs = {(min(first, second), max(first, second)) for first in range(len(reach))
             for second in tree.query_ball_point(landmarks.centers[first],
                                                 2.0 * max_distance * reach[first])
             if second != first}
    close = [(normalized_distance(landmarks, *pair), pair) for pair in sorted(pairs)]
    return [pair for distance, pair in sorted(close) if distance < max_distance]


def normalized_distance(landmarks: Landmarks, first: int, second: int) -> float:
    """Return the distance of two centres in units of the summed shapes, about 1 if they touch."""
    shape = (landmarks.bases[first] @ landmarks.bases[first].T
             + landmarks.bases[second] @ landmarks.bases[second].T)
    offset = landmarks.centers[first] - landmarks.centers[second]
    return float(np.sqrt(offset @ np.linalg.solve(shape, offset)))


def seen_apart(views: Views, rows: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """Return in which share of the frames of the landmark with fewer both have a box of their own.

    Two boxes that overlap well are one object under two classes.
    """
    _, first, second = np.intersect1d(views.frames[rows], views.frames[others],
                                      return_indices=True)
    apart = sum(box_iou(views.edges[row], views.edges[other], views.bounds) < _ONE_BOX_IOU
                for row, other in zip(rows[first], others[second], strict=True))
    return float(apart) / max(1, min(len(rows), len(others)))
