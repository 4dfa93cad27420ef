# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects of the recording that no old landmark explains."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaln, expit

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.mapping.association import find_overlaps, normalized_distance, seen_apart
from cliploc_ros.mapping.building import LeftOut, NothingFoundError, build_map
from cliploc_ros.mapping.evidence import gather_evidence
from cliploc_ros.mapping.landmarks import (
    Landmarks,
    group_boxes,
    join_landmarks,
    landmarks_of_map,
    no_landmarks,
)
from cliploc_ros.mapping.options import MappingOptions, UpdateOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.updating.alignment import Known, Refits, find_known, has_moved, refit
from cliploc_ros.mapping.updating.sight import Sight, look_for
from cliploc_ros.mapping.views import Views, map_from_cameras

# A recording in which objects are seen more rarely or more often than before changes all ratios.
_FACTOR_RANGE = (0.3, 2.0)
_RATIO_RANGE = (0.02, 0.95)
# Landmarks and viewpoints of each from which the scatter of the ratio is learned, and the least
# that a usual ratio is worth [views]. Guesses.
_MEDIAN_SQUARE = 0.455  # of a standard normal variable
_FEW_LANDMARKS, _FEW_VIEWS, _LEAST_VIEWS = 5, 3, 0.5
# Overlaps with which a box is near a landmark, and on it whatever its class. Guesses.
_NEAR_IOU, _SAME_IOU = 0.02, 0.5


class Finds(NamedTuple):
    """New landmarks: m of them."""

    landmarks: Landmarks
    details: tuple[LandmarkDetails, ...]
    #: (n,): the new landmark that each box of the recording shows, -1 for none
    shown: NDArray[np.int64]
    left_out: tuple[LeftOut, ...]  #: What is not good enough for a map

    def select(self, rows: NDArray[np.int64]) -> 'Finds':
        """Return some of the new landmarks."""
        numbers = np.full(len(self.details) + 1, -1, dtype=np.int64)
        numbers[rows] = np.arange(len(rows))
        return Finds(self.landmarks.select(rows), tuple(self.details[row] for row in rows),
                     numbers[self.shown], self.left_out)


def find_new(detections: PosedDetections, views: Views, is_free: NDArray[np.bool_],
             options: MappingOptions) -> Finds:
    """Return the landmarks that the free boxes show.

    Parameters
    ----------
    views : Views
        With the poses to map with.
    is_free : ndarray (n,) of bool
        Boxes that no old landmark explains.
    options : MappingOptions
        Poses are not refined again.
    """
    shown = np.full(len(is_free), -1, dtype=np.int64)
    nothing = Finds(no_landmarks(), (), shown, ())
    if not is_free.any():
        return nothing
    posed = detections.with_poses(map_from_cameras(views)).select_boxes(is_free)
    try:
        built = build_map(posed, replace(options, pose_errors=None, estimate_pose_errors=False,
                                         refine_mount=False))
    except NothingFoundError:
        return nothing
    shown[is_free] = built.shown
    return Finds(landmarks_of_map(built.landmark_map, detections.class_names),
                 built.landmark_map.details, shown, built.report.left_out)


def without_copies(views: Views, finds: Finds, old: Landmarks, old_shown: NDArray[np.int64],
                   majority: float, options: UpdateOptions) -> Finds:
    """Return the new landmarks without those that are an old one in its place.

    Of two landmarks that lie in one another, the boxes are those of one object: parts of it, or
    another name for it. If they only touch, frames that show both tell them apart.

    Parameters
    ----------
    old : Landmarks
        Those with boxes are in their place.
    old_shown : ndarray (n,) of int
        The old landmark that each box shows, -1 for none.
    majority : float
        An old landmark is in its place if it has a box, and so many for each of the new one's.
    """
    rows_of_old = group_boxes(old_shown, len(old.centers))
    rows_of_new = group_boxes(finds.shown, len(finds.details))
    copies = set()
    for new, row, distance in close_pairs(finds.landmarks, old, options.mapping.merge_distance):
        is_one_class = old.classes[row] == finds.landmarks.classes[new]
        if len(rows_of_old[row]) >= max(1.0, majority * len(rows_of_new[new])) and (
                (is_one_class and distance < options.least_move_shapes)
                or seen_apart(views, rows_of_old[row], rows_of_new[new])
                <= options.mapping.max_seen_apart):
            copies.add(new)
    return finds.select(np.array([new for new in range(len(finds.details)) if new not in copies],
                                 dtype=np.int64))


def is_taken(finds: Finds, old: Landmarks, old_shown: NDArray[np.int64], max_distance: float
             ) -> NDArray[np.bool_]:
    """Tell which old landmarks (L,) have a new one with more boxes in their place."""
    rows_of_old = group_boxes(old_shown, len(old.centers))
    rows_of_new = group_boxes(finds.shown, len(finds.details))
    taken = np.zeros(len(old.centers), dtype=np.bool_)
    for new, row, _ in close_pairs(finds.landmarks, old, max_distance):
        taken[row] |= len(rows_of_new[new]) > len(rows_of_old[row])
    return taken


def close_pairs(new: Landmarks, old: Landmarks, max_distance: float
                ) -> list[tuple[int, int, float]]:
    """Return pairs of a new and an old landmark nearer than a normalized distance, with it."""
    if len(new.centers) == 0 or len(old.centers) == 0:
        return []
    both = join_landmarks(new, old)
    reach = np.linalg.norm(both.bases, axis=(1, 2))
    tree, first_old = cKDTree(old.centers), len(new.centers)
    found = []
    for row in range(first_old):
        largest = max_distance * (reach[row] + float(reach[first_old:].max()))
        for other in tree.query_ball_point(new.centers[row], largest):
            distance = normalized_distance(both, row, first_old + other)
            if distance < max_distance:
                found.append((row, int(other), distance))
    return found


def probability_there(sight: Sight, ratios: NDArray[np.float64], options: UpdateOptions
                      ) -> NDArray[np.float64]:
    """Return for each place (L,) the probability that its object is there.

    Parameters
    ----------
    ratios : ndarray (L,)
        Share of the views in which each object is usually detected.
    """
    there = _log_evidence(sight, ratios, _certainty(sight, ratios, options))
    away = _log_evidence(sight, np.full(len(ratios), options.chance_ratio), options.prior_views)
    return np.asarray(expit(np.log(options.stays / (1.0 - options.stays)) + there - away))


def _log_evidence(sight: Sight, ratios: NDArray[np.float64], views: float) -> NDArray[np.float64]:
    """Return the logarithm of the beta-binomial probability, without the binomial coefficient."""
    a, b = views * ratios, views * (1.0 - ratios)
    return np.asarray(betaln(a + sight.seen, b + sight.expected - sight.seen) - betaln(a, b))


def _certainty(sight: Sight, ratios: NDArray[np.float64], options: UpdateOptions) -> float:
    """Return how many views the usual ratios are worth: few if this recording scatters about them.

    A beta variable of mean r and n views has the variance r (1 - r) / (n + 1).
    """
    rows = (sight.seen > 0) & (sight.expected >= _FEW_VIEWS)
    if np.count_nonzero(rows) < _FEW_LANDMARKS:
        return options.prior_views
    shares, usual = sight.seen[rows] / sight.expected[rows], ratios[rows]
    # the median, since objects that are gone are no scatter
    scatter = np.median(np.square(shares - usual) / (usual * (1.0 - usual))) / _MEDIAN_SQUARE
    return float(np.clip(1.0 / max(float(scatter), 1e-3) - 1.0, _LEAST_VIEWS, options.prior_views))


def usual_ratios(known: Known, sight: Sight, options: UpdateOptions) -> NDArray[np.float64]:
    """Return the share of views (L,) in which this recording should show each old landmark.

    It is the share of the old recording, times how much more often the new one shows all objects;
    without an old one, the share of the landmarks seen in this recording.
    """
    seen = sight.seen > 0
    share = float(sight.seen[seen].sum()) / max(1.0, float(sight.expected[seen].sum()))
    overall = min(options.seen_ratio, share)
    given = np.array([np.nan if one.seen_ratio is None else one.seen_ratio
                      for one in known.details])
    ratios = np.where(np.isnan(given), overall, given)
    told = seen & ~np.isnan(given)
    if told.any():
        expected = float((given[told] * sight.expected[told]).sum())
        factor = np.clip(sight.seen[told].sum() / max(expected, 1e-9), *_FACTOR_RANGE)
        ratios = np.where(np.isnan(given), ratios, factor * ratios)
    return np.clip(ratios, *_RATIO_RANGE)


class Judged(NamedTuple):
    """What the recording says: L old landmarks, m finds, n boxes."""

    #: (n,): the old landmark that each box shows in its place, L + the find, or -1 for none
    shown: NDArray[np.int64]
    refits: Refits  #: The old landmarks where the recording puts them
    finds: Finds
    sight: Sight  #: Of the old places, then of the finds
    is_gone: NDArray[np.bool_]  #: (L,)
    is_there: NDArray[np.bool_]  #: (L,): Neither: the recording does not tell


def judge(detections: PosedDetections, views: Views, known: Known, options: UpdateOptions
          ) -> Judged:
    """Return what the recording says of each place of the map, and what else it shows.

    Parameters
    ----------
    views : Views
        With poses in the coordinate frame of the map.
    """
    mapping, count = options.mapping, len(known.landmarks.centers)
    shown = find_known(views, known, mapping.association_iou)
    refits = refit(views, known.landmarks, shown, mapping.min_viewpoints)
    displaced = has_moved(known, refits, options)
    sight = look_for(views, known.landmarks, shown, np.ones(count, dtype=np.bool_), options)
    is_gone = displaced | _is_absent(known, sight, options.gone_below, options)
    finds = find_new(detections, views, _free(views, known, refits, shown, is_gone), mapping)
    finds = _with_displaced(finds, refits, shown, displaced, mapping.merge_distance)
    # a new object may be in the place of an old one of which a wrong box remains
    finds = without_copies(views, finds, refits.landmarks, _held(shown, is_gone), 1.0, options)
    _, sight = _look(views, known, finds, shown, is_gone, options)
    finds = finds.select(np.nonzero(_is_usual(sight, count, options))[0])
    # new objects hide old places
    _, sight = _look(views, known, finds, shown, is_gone, options)
    limits = np.where(is_taken(finds, known.landmarks, shown, mapping.merge_distance),
                      options.gone_below_if_taken, options.gone_below)
    is_gone = displaced | _is_absent(known, sight.select(slice(count)), limits, options)
    finds = without_copies(views, finds, refits.landmarks, _held(shown, is_gone), 0.0, options)
    # objects that are gone hide nothing
    both, sight = _look(views, known, finds, shown, is_gone, options)
    is_gone |= _is_absent(known, sight.select(slice(count)), limits, options)
    own_sight = sight.select(slice(count))
    there = probability_there(own_sight, usual_ratios(known, own_sight, options), options)
    fits = gather_evidence(views, refits.landmarks, _held(shown, is_gone)).median_iou
    is_there = (~is_gone & (fits >= mapping.min_median_iou)
                & (refits.is_known | (there > options.there_above)))
    return Judged(both, refits, finds, sight, is_gone, is_there)


def _is_usual(sight: Sight, count: int, options: UpdateOptions) -> NDArray[np.bool_]:
    """Tell which finds are seen about as often as the old landmarks, which come first."""
    usual = sight.seen_ratio[:count][sight.seen[:count] > 0]
    least = options.min_new_share * (float(np.median(usual)) if len(usual) else 1.0)
    return np.asarray(sight.seen_ratio[count:] >= least)


def _look(views: Views, known: Known, finds: Finds, shown: NDArray[np.int64],
          is_gone: NDArray[np.bool_], options: UpdateOptions) -> tuple[NDArray[np.int64], Sight]:
    """Return the landmark or find that each box shows, and the sight of all their places."""
    own = _held(shown, is_gone)
    both = np.where((own < 0) & (finds.shown >= 0), len(is_gone) + finds.shown, own)
    is_solid = np.concatenate([~is_gone, np.ones(len(finds.details), dtype=np.bool_)])
    return both, look_for(views, join_landmarks(known.landmarks, finds.landmarks), both, is_solid,
                          options)


def _free(views: Views, known: Known, refits: Refits, shown: NDArray[np.int64],
          is_gone: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which boxes (n,) may show new objects.

    A box near a landmark that has no better one is no proof of a new object; nor is a box on a
    landmark that has at least as many of its own: it may be another name for it.
    """
    own = _held(shown, is_gone)
    near = _held(find_known(views, known, _NEAR_IOU), is_gone)
    nameless = find_overlaps(
        views._replace(classes=np.zeros_like(views.classes)),
        refits.landmarks._replace(classes=np.zeros_like(refits.landmarks.classes)), _SAME_IOU)
    others = own[nameless.boxes] < 0
    on, count = nameless.landmarks[others], len(is_gone)
    is_named = np.bincount(own[own >= 0], minlength=count) >= np.bincount(on, minlength=count)
    free = (own < 0) & (near < 0)
    free[nameless.boxes[others][is_named[on]]] = False
    return free


def _held(shown: NDArray[np.int64], is_gone: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the landmark (n,) that each box shows, without those that are gone."""
    return np.where((shown >= 0) & ~is_gone[shown], shown, -1)


def _is_absent(known: Known, sight: Sight, limits: NDArray[np.float64] | float,
               options: UpdateOptions) -> NDArray[np.bool_]:
    """Tell which objects (L,) are in their place with less than some probabilities.

    A detector that never found a class in this recording may not know it, or not at these sizes.
    """
    is_told = (known.landmarks.classes >= 0) & (sight.expected >= options.least_views)
    there = probability_there(sight, usual_ratios(known, sight, options), options)
    return np.asarray(is_told & (there < limits))


def _with_displaced(finds: Finds, refits: Refits, shown: NDArray[np.int64],
                    displaced: NDArray[np.bool_], merge_distance: float) -> Finds:
    """Return the finds with the landmarks that stand a little off their place, if not found."""
    rows = np.nonzero(displaced)[0]
    moved = refits.landmarks.select(rows)
    found_again = {new for new, _, _ in close_pairs(moved, finds.landmarks, merge_distance)}
    rows = rows[[new not in found_again for new in range(len(rows))]]
    numbers = np.full(len(displaced) + 1, -1, dtype=np.int64)
    numbers[rows] = len(finds.details) + np.arange(len(rows))
    return Finds(join_landmarks(finds.landmarks, refits.landmarks.select(rows)),
                 finds.details + (LandmarkDetails(),) * len(rows),
                 np.where(finds.shown >= 0, finds.shown, numbers[shown]), finds.left_out)
