# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decide whether two landmarks are the same object.

Building, refitting, updating and checking share this criterion. Overlapping landmarks are the same
object, whatever their classes, unless the images show two objects. A detector may give one object
several names, in different images or in the same one, and detect parts of it. Therefore boxes
that overlap well show the same object, and so does a box within another one, unless it is small
and usually present, like that of a cup on a table.
"""

from collections.abc import Iterable, Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.geometry.ellipsoid import STANDS_IN, normalized_lengths
from cliploc_ros.offline.mapping.association import ious_with
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, REACH, is_expected
from cliploc_ros.offline.mapping.fitting import fit_ellipsoid
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.offline.mapping.views import Views

# Two boxes of one image show the same object if their IoU is above the first number. A box is
# within another one if more than the second share of its area is. Below the third share of the
# other's area, it is a part or a separate object on it; below the fourth, it is a separate object.
_ONE_BOX_IOU, _WITHIN_SHARE, _PART_SHARE, _THING_SHARE = 0.5, 0.8, 0.3, 1 / 16
# Two classes of one object are hardly ever detected in the same image. Two objects are: in at
# least the first share of the number of images that independent detections predict, or in at least
# the second share of the images that show the less frequent of the two.
_LEAST_LIFT, _LEAST_SHARE = 1 / 3, 0.15
# A part sometimes has a separate box; an object on another one has one in at least this share of
# the images of both. All values are guesses that separate the doubles from the neighbours of four
# rooms and TUM fr3.
_LEAST_STEADY = 0.3
# Two boxes of one image are apart if they share less than the first share of the smaller one. Two
# objects are apart from at least this number of viewpoints, and in at least the next share of the
# images that show the less frequent of the two, even if they hide each other in all other images.
# Chosen: on TUM fr3, two landmarks of one object are apart from at most one viewpoint.
_APART_SHARE, _LEAST_APART, _LEAST_APART_SHARE = 0.5, 5.0, 0.05
# Landmarks of one object are fitted together, unless the mean IoU of their boxes drops by more.
_MERGE_LOSS = 0.1


def close_pairs(landmarks: Landmarks) -> list[tuple[int, int, float]]:
    """Return the pairs of overlapping landmarks and their normalized distances, nearest first."""
    if len(landmarks.centers) < 2:
        return []
    reach = np.linalg.norm(landmarks.bases, axis=(1, 2))
    # the smaller of two touching landmarks lies within the reach of the larger one
    near = cKDTree(landmarks.centers).query_ball_point(landmarks.centers, 2.0 * STANDS_IN * reach)
    pairs = np.array(sorted({
        (min(first, second), max(first, second)) for first, others in enumerate(near)
        for second in others if second != first}), dtype=np.int64).reshape(-1, 2)
    shapes = landmarks.bases @ landmarks.bases.transpose(0, 2, 1)
    distances = normalized_lengths(np.diff(landmarks.centers[pairs], axis=1)[:, 0],
                                   shapes[pairs].sum(axis=1))
    order = np.argsort(distances, kind='stable')[:np.count_nonzero(distances < STANDS_IN)]
    return [(*pair, distance) for pair, distance in zip(
        pairs[order].tolist(), distances[order].tolist(), strict=True)]


class Relation(Enum):
    """Evidence of the images on two overlapping landmarks."""

    TWO = 'two things at once'
    PART = 'boxes of different extent, seldom at once: one is a part of the other'
    SAME = 'one box, or one at a time'


def relation(views: Views, landmarks: Landmarks, rows_of: Sequence[NDArray[np.int64]],
             pair: tuple[int, int]) -> Relation:
    """Return the evidence of the images on two landmarks, by the boxes of each."""
    first, second = (rows_of[number] for number in pair)
    common, *places = np.intersect1d(views.frames[first], views.frames[second],
                                     return_indices=True)
    if len(common) == 0:
        return Relation.SAME
    boxes = views.edges[np.stack([first[places[0]], second[places[1]]])]
    low, high = boxes[..., :2].max(axis=0), boxes[..., 2:].min(axis=0)
    shared = np.maximum(high - low, 0.0).prod(axis=1)
    small, large = np.sort((boxes[..., 2:] - boxes[..., :2]).prod(axis=2), axis=0)
    is_one = shared > _ONE_BOX_IOU * (small + large - shared)
    is_within = ~is_one & (shared > _WITHIN_SHARE * small) & (small > _THING_SHARE * large)
    # the errors of frames of one viewpoint are correlated
    together = views.weights[common]
    one, within, beside, apart = (together @ mask for mask in (
        is_one, is_within, ~is_one & ~is_within, shared < _APART_SHARE * small))
    small_within = together @ (is_within & (small < _PART_SHARE * large))
    rates, total = _rates_in_view(views, landmarks, rows_of, pair)
    if (apart >= max(_LEAST_APART, _LEAST_APART_SHARE * rates.min())
            or (beside > one and beside * total > _LEAST_LIFT * rates.prod())
            or (beside > one + within and beside > _LEAST_SHARE * rates.min())
            or beside + small_within > _LEAST_STEADY * total):
        return Relation.TWO
    return Relation.PART if beside + within > max(one, _LEAST_SHARE * rates.min()) else (
        Relation.SAME)


def _rates_in_view(views: Views, landmarks: Landmarks, rows_of: Sequence[NDArray[np.int64]],
                   pair: tuple[int, int]) -> tuple[NDArray[np.float64], float]:
    """Return the weight of the frames with a box of each of two landmarks (2,), and of all.

    Only frames with both places in view count. A place is in view if it has a box, or should have
    one, given the distances at which it was detected.
    """
    cameras = views.centers
    seen, in_view = np.zeros((2, len(cameras)), dtype=np.bool_), []
    for number, is_seen in zip(pair, seen, strict=True):
        center, frames = landmarks.centers[number], views.frames[rows_of[number]]
        is_seen[frames] = True
        farthest = np.linalg.norm(cameras[frames] - center, axis=1).max()
        in_view.append(is_seen | is_expected(views, cameras, center, landmarks.bases[number],
                                             REACH * farthest))
    both = in_view[0] & in_view[1]
    return (seen & both) @ views.weights, float(views.weights @ both)


def find_doubles(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]
                 ) -> list[tuple[int, int]]:
    """Return the pairs of landmarks that are the same object, nearest first.

    Pairs without any box are left out, as the images contain no evidence on them.
    """
    rows_of = group_boxes(shown, len(landmarks.centers))
    return [(first, second) for first, second, _ in close_pairs(landmarks)
            if len(rows_of[first]) + len(rows_of[second])
            and relation(views, landmarks, rows_of, (first, second)) is not Relation.TWO]


def resolve_doubles(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                    chosen: NDArray[np.bool_] | None = None
                    ) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return all landmarks, and the landmark (L,) that each of the chosen is merged into.

    Landmarks whose boxes fit one ellipsoid are fitted together. Of any other pair, the landmark
    with more boxes, weighted by their IoU, is kept unchanged: the other one is a part of it, or a
    false landmark.
    """
    def doubles(shown: NDArray[np.int64]) -> list[tuple[int, int]]:
        return [pair for pair in find_doubles(views, landmarks, shown)
                if chosen is None or chosen[list(pair)].all()]

    landmarks, into = merge_doubles(views, landmarks, shown, doubles(shown))
    shown = np.where(shown < 0, -1, into[shown])
    fits = [ious_with(views, rows, center, basis).sum() for rows, center, basis in zip(
        group_boxes(shown, len(into)), landmarks.centers, landmarks.bases, strict=True)]
    for pair in doubles(shown):
        if (into[list(pair)] == pair).all():
            keep, drop = pair if fits[pair[0]] >= fits[pair[1]] else pair[::-1]
            into[into == drop] = keep
    return landmarks, into


def merge_doubles(views: Views, landmarks: Landmarks, shown: NDArray[np.int64],
                  pairs: Iterable[tuple[int, int]]) -> tuple[Landmarks, NDArray[np.int64]]:
    """Fit the two landmarks of each pair that is one object together, in the order given.

    They stay separate if the boxes of either do not fit the common ellipsoid. Otherwise, the
    landmark with more boxes is kept, with the classes of both. Returns all landmarks, and the
    landmark (L,) that each is merged into.
    """
    merged = landmarks._replace(centers=landmarks.centers.copy(), bases=landmarks.bases.copy())
    centers, bases, rows_of = merged.centers, merged.bases, group_boxes(shown, len(merged.centers))
    into = np.arange(len(centers))
    for first, second in pairs:
        if into[first] != first or into[second] != second:
            continue
        keep, drop = ((first, second) if len(rows_of[first]) >= len(rows_of[second])
                      else (second, first))
        if relation(views, merged, rows_of, (keep, drop)) is not Relation.SAME:
            continue
        rows = np.concatenate([rows_of[keep], rows_of[drop]])
        fit = fit_ellipsoid(views, np.sort(rows), centers[keep], bases[keep])
        before = [ious_with(views, rows_of[number], centers[number], bases[number])
                  for number in (keep, drop)]
        after = np.split(ious_with(views, rows, fit.center, fit.basis), [len(before[0])])
        if not (_fits(np.concatenate(before), np.concatenate(after), 1.0)
                and all(_fits(*ious, MIN_MEDIAN_IOU)
                        for ious in zip(before, after, strict=True))):
            continue
        centers[keep], bases[keep], rows_of[keep] = fit.center, fit.basis, np.sort(rows)
        into[into == drop] = keep
    names = np.unique(np.stack([into[merged.names[:, 0]], merged.names[:, 1]], axis=1), axis=0)
    return merged._replace(others=names[names[:, 1] != merged.classes[names[:, 0]]]), into


def _fits(before: NDArray[np.float64], after: NDArray[np.float64], enough: float) -> bool:
    """Tell whether the mean IoU of boxes is high enough after a fit, or hardly lower."""
    return len(before) == 0 or bool(after.mean() >= min(enough, before.mean() - _MERGE_LOSS))
