# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks are one thing: the one criterion of building, refitting, updating and checking.

Landmarks that stand in one another are one thing, whatever their classes, unless the images show
two. A detector calls one thing by several names, in different images or in one, and finds parts of
it: boxes that lie on one another show one thing, and so does a box within another one, unless it
is small and there most of the time, as that of a cup on a table.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.geometry.ellipsoid import STANDS_IN, normalized_lengths
from cliploc_ros.mapping.association import ious_with
from cliploc_ros.mapping.evidence import REACH, is_expected
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.views import Views, camera_centers

# Two boxes of one image show one thing if their IoU is greater. A box is within another one if it
# shares more than the second number of its area, and small if its area is below the third number.
_ONE_BOX_IOU, _WITHIN_SHARE, _SMALL_SHARE = 0.5, 0.8, 0.25
# Two things are shown side by side about as often as chance brings their boxes together: in the
# product of their rates. Names of one thing exclude each other. Between the two.
_LEAST_LIFT = 1 / 3
# Share of the images of both in which a small box within the other one is there.
_MOST_OF_THE_TIME = 0.5


def close_pairs(landmarks: Landmarks, max_distance: float = STANDS_IN
                ) -> list[tuple[int, int, float]]:
    """Return the pairs nearer than a normalized distance, with it, the nearest first."""
    if len(landmarks.centers) < 2:
        return []
    reach = np.linalg.norm(landmarks.bases, axis=(1, 2))
    # the smaller of two touching landmarks lies within the reach of the larger one
    tree = cKDTree(landmarks.centers)
    pairs = np.array(sorted({
        (min(first, second), max(first, second)) for first in range(len(reach))
        for second in tree.query_ball_point(landmarks.centers[first],
                                            2.0 * max_distance * reach[first])
        if second != first}), dtype=np.int64).reshape(-1, 2)
    shapes = landmarks.bases @ landmarks.bases.transpose(0, 2, 1)
    distances = normalized_lengths(np.diff(landmarks.centers[pairs], axis=1)[:, 0],
                                   shapes[pairs].sum(axis=1))
    order = np.argsort(distances, kind='stable')[:np.count_nonzero(distances < max_distance)]
    return [(*pair, distance) for pair, distance in zip(
        pairs[order].tolist(), distances[order].tolist(), strict=True)]


def pairs_of_one_class(landmarks: Landmarks) -> list[tuple[int, int]]:
    """Return the pairs of one class that stand in one another, the nearest first."""
    return [(first, second) for first, second, _ in close_pairs(landmarks)
            if landmarks.classes[first] == landmarks.classes[second]]


def show_two(views: Views, pair: Landmarks, rows: NDArray[np.int64], others: NDArray[np.int64]
             ) -> bool:
    """Tell whether the images show two things at once, by the boxes of each of two landmarks."""
    _, first, second = np.intersect1d(views.frames[rows], views.frames[others],
                                      return_indices=True)
    if len(first) == 0:
        return False
    boxes = np.stack([views.edges[rows[first]], views.edges[others[second]]])
    low, high = boxes[..., :2].max(axis=0), boxes[..., 2:].min(axis=0)
    shared = np.maximum(high - low, 0.0).prod(axis=1)
    areas = np.maximum(boxes[..., 2:] - boxes[..., :2], 1e-12).prod(axis=2)
    small, large = areas.min(axis=0), areas.max(axis=0)
    is_within = shared > _WITHIN_SHARE * small
    beside = (shared <= _ONE_BOX_IOU * (small + large - shared)) & ~is_within
    within = is_within & (small < _SMALL_SHARE * large)
    # frames of one viewpoint err alike
    weights = views.weights
    seen, in_view = np.zeros((2, len(weights)), dtype=np.bool_), []
    for number, own in enumerate((rows, others)):
        seen[number, views.frames[own]] = True
        in_view.append(seen[number] | _expected(views, pair, number, views.frames[own]))
    both = in_view[0] & in_view[1]
    rates = (seen & both) @ weights
    together = weights[views.frames[rows[first]]]
    total = weights[both].sum()
    return bool(together[beside].sum() * total > _LEAST_LIFT * rates.prod()
                or together[beside | within].sum() > _MOST_OF_THE_TIME * total)


def _expected(views: Views, pair: Landmarks, number: int, frames: NDArray[np.int64]
              ) -> NDArray[np.bool_]:
    """Return the frames (F,) that should show one of two landmarks, by those that show it."""
    cameras, center = camera_centers(views), pair.centers[number]
    farthest = np.linalg.norm(cameras[frames] - center, axis=1).max(initial=0.0)
    return np.asarray(is_expected(views, cameras, center, pair.bases[number], REACH * farthest))


def find_doubles(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]
                 ) -> list[tuple[int, int]]:
    """Return the pairs that are one thing, the nearest first."""
    rows_of = group_boxes(shown, len(landmarks.centers))
    return [(first, second) for first, second, _ in close_pairs(landmarks)
            if not show_two(views, landmarks.select(np.array([first, second])),
                            rows_of[first], rows_of[second])]


def merge_doubles(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                  pairs: Iterable[tuple[int, int]], options: MappingOptions
                  ) -> tuple[Landmarks, NDArray[np.int64]]:
    """Fit those of the pairs that are one thing together, in the order given.

    They stay two where their boxes fit no one ellipsoid. Of two landmarks the one with more boxes
    stays, with the classes of both. Returns all landmarks, and the one (L,) that each is part of.
    """
    centers, bases = landmarks.centers.copy(), landmarks.bases.copy()
    rows_of = group_boxes(shown, len(centers))
    into = np.arange(len(centers))
    for first, second in pairs:
        if into[first] != first or into[second] != second:
            continue
        keep, drop = ((first, second) if len(rows_of[first]) >= len(rows_of[second])
                      else (second, first))
        now = Landmarks(centers, bases, landmarks.classes)
        if show_two(views, now.select(np.array([keep, drop])), rows_of[keep], rows_of[drop]):
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
    return Landmarks(centers, bases, landmarks.classes, _joined_names(landmarks, into)), into


def _joined_names(landmarks: Landmarks, into: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the classes besides its own of each landmark, with those of its parts."""
    names = landmarks.names
    names = np.unique(np.stack([into[names[:, 0]], names[:, 1]], axis=1), axis=0)
    return names[names[:, 1] != landmarks.classes[names[:, 0]]]


def leave_one(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]
              ) -> NDArray[np.int64]:
    """Return the landmark (L,) that each gives way to, as one thing; else its own row.

    Of two that are one thing, and whose boxes fit no one ellipsoid, that with more boxes stays:
    the other one is a part of it, or a wrong find.
    """
    into, counts = np.arange(len(landmarks.centers)), np.bincount(
        shown[shown >= 0], minlength=len(landmarks.centers))
    for first, second in find_doubles(views, landmarks, shown):
        if into[first] == first and into[second] == second:
            keep, drop = (first, second) if counts[first] >= counts[second] else (second, first)
            into[into == drop] = keep
    return into
