# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge each place of a map by a recording: its object is there, gone, or neither is certain.

Boxes that no old landmark explains show new objects, which may hide old places.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.presence import STAYS, WORTH, probability_there
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.building import LeftOut, NothingFoundError, build_map, rounded
from cliploc_ros.offline.mapping.doubles import Relation, close_pairs, relation
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, Sight, gather_evidence, look_for
from cliploc_ros.offline.mapping.joint import left_by_poses
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update import alignment
from cliploc_ros.offline.mapping.views import Views

# Range of the factor by which a recording changes all ratios, if its objects are detected more or
# less often than before.
_FACTOR_RANGE = (0.3, 2.0)
_RATIO_RANGE = (0.02, 0.95)
# Share of the views in which an object is detected, if neither map nor recording give it; share of
# the views with a false detection in an empty place. Chosen, like all values below.
_SEEN_RATIO, _CHANCE_RATIO = 0.9, 0.03
# An object is gone, or there, if its probability of being there is below or above these numbers.
_GONE_BELOW, _THERE_ABOVE = 0.05, 0.95
# An object is also gone if it was never seen, and usually would have been seen from this number of
# viewpoints: how often an object is seen differs more between recordings than the map's seen_ratio
# predicts. Measured with studies.updates.
_USUALLY_SEEN = 4.0
#: Its place must be in view from this number of viewpoints before an object can be missing.
LEAST_VIEWS = 5
# Least detection rate of a new landmark, and of an old landmark in its place, relative to the
# usual rate of old landmarks. The second number was chosen on blocks of TUM fr3, between landmarks
# that were displaced in the map (at most 0.17) and those that were not (at least 0.2, except for 3
# of 47).
_MIN_NEW_SHARE, _MIN_SHARE_IN_PLACE = 0.4, 0.15
# Least baseline of a find that may be a moved landmark, however rarely it was detected. Chosen.
_MIN_MOVED_BASELINE_DEG = 10.0


class Find(NamedTuple):
    """An object that no old landmark explains in its place."""

    class_id: str
    details: LandmarkDetails
    weak: str = ''  #: Why it may be a moved landmark, but not a new one; '' if it may be a new one


class Finds(NamedTuple):
    """The m finds."""

    landmarks: Landmarks
    each: tuple[Find, ...] = ()
    left_out: tuple[LeftOut, ...] = ()  #: Objects not good enough for a map, or old landmarks

    def without(self, reasons: Sequence[str | None], sight: Sight) -> 'Finds':
        """Return the finds without those that have a reason (m,), which are left out.

        The last entries of sight are those of the finds.
        """
        kept = [row for row, reason in enumerate(reasons) if reason is None]
        own = sight.select(slice(len(sight.seen) - len(reasons), None))
        return Finds(
            self.landmarks.select(np.array(kept, dtype=np.int64)),
            tuple(self.each[row] for row in kept), self.left_out + tuple(
                LeftOut(self.each[row].class_id, rounded(self.landmarks.centers[row]),
                        int(own.seen_frames[row]), int(own.seen[row]), reason)
                for row, reason in enumerate(reasons) if reason is not None))


class Judgement(NamedTuple):
    """The evidence from a recording with n boxes for L old landmarks and m finds.

    They are the objects of the recording, in this order.
    """

    #: (n,): the object that each box shows in its place, -1 for none
    shown: NDArray[np.int64]
    refits: alignment.Refits  #: Of the objects
    sight: Sight  #: Of the objects
    finds: Finds
    is_gone: NDArray[np.bool_]  #: (L,)
    is_there: NDArray[np.bool_]  #: (L,): if neither, the recording is inconclusive
    #: (L,): not proven to be gone, although boxes place it elsewhere, or hardly any show it
    is_doubtful: NDArray[np.bool_]
    #: Pairs of a find and an old landmark that it may be although it is slightly off its place
    near: frozenset[tuple[int, int]]

    @property
    def landmarks(self) -> Landmarks:
        """Return the objects as landmarks."""
        return self.refits.landmarks


def judge(detections: PosedDetections, aligned: alignment.Aligned, known: alignment.OldMap,
          options: MappingOptions) -> Judgement:
    """Judge each place of the map by the recording, and find the other objects that it shows."""
    count, views = len(known.landmarks.centers), aligned.views
    # boxes that no old landmark fits well may show new objects
    finds = _find_new(detections, views, associate(views, known.landmarks, MIN_MEDIAN_IOU) < 0,
                      options)
    # weak finds beside an old landmark would take its boxes
    _, sight = _look(views, known, finds, np.zeros(count, dtype=np.bool_))
    beside = {new for new, _, _ in _pairs_between(finds.landmarks, known.landmarks)}
    finds = finds.without([find.weak if find.weak and new in beside else None
                           for new, find in enumerate(finds.each)], sight)
    # old landmarks and finds compete for the boxes: an old one may have boxes of a neighbour
    shown, _ = _look(views, known, finds, np.zeros(count, dtype=np.bool_))
    refits = alignment.refit(views, known.landmarks, np.where(shown < count, shown, -1),
                             options.min_viewpoints)
    displaced = alignment.has_moved(known.landmarks, known.sigmas, refits)
    _, sight = _look(views, known, finds, displaced)
    # objects that are gone hide nothing; new objects hide old places
    is_gone = displaced | _is_absent(known, sight.select(slice(count)), _GONE_BELOW)
    shown, sight = _look(views, known, finds, is_gone)
    finds = _without_copies(views, finds, refits.landmarks, known, shown, sight)
    shown, sight = _look(views, known, finds, is_gone)
    own = sight.select(slice(count))
    is_gone |= _is_absent(known, own, _GONE_BELOW)
    shown[np.isin(shown, np.nonzero(is_gone)[0])] = -1
    # finds should be seen about as often as the old landmarks
    ratios = own.seen_ratio[own.seen > 0]
    usual = float(np.median(ratios)) if len(ratios) else 1.0
    least = _MIN_NEW_SHARE * usual
    finds = finds._replace(each=tuple(
        find if find.weak or ratio >= least else find._replace(
            weak=f'seen in {100 * ratio:.1f} % of the frames that show its place, less than '
            f'{100 * least:.1f} %, {_MIN_NEW_SHARE:g} of the usual rate')
        for find, ratio in zip(finds.each, sight.seen_ratio[count:], strict=True)))
    landmarks = Landmarks.joined(known.landmarks, finds.landmarks)
    refits = alignment.refit(views, landmarks, shown, options.min_viewpoints)
    left_m = left_by_poses(views, np.square(aligned.changes), shown, len(landmarks.centers))
    refits = refits._replace(
        covariances=refits.covariances + np.square(left_m)[:, None, None] * np.eye(3))
    fits = gather_evidence(views, refits.landmarks, shown).median_iou[:count]
    is_rare = ((own.seen_ratio < _MIN_SHARE_IN_PLACE * usual) & (own.expected >= LEAST_VIEWS))
    is_there = (~is_gone & ~is_rare & (fits >= MIN_MEDIAN_IOU) & (
        refits.is_known[:count] | (_probability_there(known, own) > _THERE_ABOVE)))
    # boxes place it elsewhere, but may not suffice for a find there: then it may not be gone
    is_doubtful = (is_gone & ~_is_absent(known, own, _GONE_BELOW)) | (
        ~is_there & ~is_gone & (is_rare | _is_absent(known, own, STAYS))
        & (known.landmarks.classes >= 0))
    shown[np.isin(shown, np.nonzero(~is_there)[0])] = -1
    near = frozenset(
        (count + new, row) for new, row, _ in _pairs_between(finds.landmarks, known.landmarks)
        if not is_there[row] and (row, int(finds.landmarks.classes[new])) in known.names)
    return Judgement(shown, refits, sight, finds, is_gone, is_there, is_doubtful, near)


def _is_absent(known: alignment.OldMap, sight: Sight, limit: float) -> NDArray[np.bool_]:
    """Return a mask of the objects (L,) whose probability of being in place is below a limit.

    Classes without a box are excluded: the detector may not know them, or not at these sizes.
    """
    is_told = (known.landmarks.classes >= 0) & (sight.expected >= LEAST_VIEWS)
    seen = sight.seen > 0
    usual = np.median(sight.seen[seen] / sight.expected[seen]) if seen.any() else 0.0
    is_never_seen = ~seen & (usual * sight.expected >= _USUALLY_SEEN)
    return np.asarray(is_told & (is_never_seen | (_probability_there(known, sight) < limit)))


def _probability_there(known: alignment.OldMap, sight: Sight) -> NDArray[np.float64]:
    """Return for each place (L,) the probability that its object is there.

    If it is, the recording shows it in a usual share of the views. It is the share of the old
    recording, times the factor by which the new one shows all objects more often. Without an old
    recording, it is the share of the landmarks that this recording shows.
    """
    seen = sight.seen > 0
    share = float(sight.seen[seen].sum()) / max(1.0, float(sight.expected[seen].sum()))
    given = np.array([np.nan if detail.seen_ratio is None else detail.seen_ratio
                      for detail in known.map.details])
    ratios = np.where(np.isnan(given), min(_SEEN_RATIO, share), given)
    told = seen & ~np.isnan(given)
    if told.any():
        expected = float((given[told] * sight.expected[told]).sum())
        factor = np.clip(sight.seen[told].sum() / max(expected, 1e-9), *_FACTOR_RANGE)
        ratios = np.where(np.isnan(given), ratios, factor * ratios)
    return probability_there(sight.seen, sight.expected, np.clip(ratios, *_RATIO_RANGE), WORTH,
                             _CHANCE_RATIO)


def _look(views: Views, known: alignment.OldMap, finds: Finds, is_gone: NDArray[np.bool_]
          ) -> tuple[NDArray[np.int64], Sight]:
    """Return the old landmark or new find that each box shows, and the sight of all places."""
    places = Landmarks.joined(known.landmarks, finds.landmarks)
    is_solid = np.concatenate([~is_gone, np.ones(len(finds.each), dtype=np.bool_)])
    shown = associate(views, places, among=is_solid)
    return shown, look_for(views, places, shown, is_solid)


def _find_new(detections: PosedDetections, views: Views, is_free: NDArray[np.bool_],
              options: MappingOptions) -> Finds:
    """Return the landmarks that the free boxes show, with the poses of the views."""
    if not is_free.any():
        return Finds(Landmarks.none())
    posed = detections.with_poses(views.poses).select_boxes(is_free)
    least = options.min_baseline_deg
    try:
        built = build_map(posed, replace(
            options, pose_errors=None, estimate_pose_errors=False, refine_mount=False,
            min_baseline_deg=min(least, _MIN_MOVED_BASELINE_DEG)))
    except NothingFoundError as error:
        return Finds(Landmarks.none(), left_out=error.left_out)
    found = built.landmark_map
    return Finds(landmarks_of_map(found, detections.class_names), tuple(
        Find(class_id, detail, '' if (detail.baseline_deg or 0.0) >= least else
             f'seen from one side only: {detail.baseline_deg:.1f} degrees, less than {least:g}')
        for class_id, detail in zip(found.class_ids, found.details, strict=True)),
        built.report.left_out)


def _without_copies(views: Views, finds: Finds, old: Landmarks, known: alignment.OldMap,
                    shown: NDArray[np.int64], sight: Sight) -> Finds:
    """Return the finds without those that are an old landmark in its place.

    An old landmark is in its place if it has a box. A find of its class that lies in it shows the
    same object. So does any other overlapping find, as a part or under another name, unless frames
    show two objects at once.
    """
    count = len(old.centers)
    boxes = group_boxes(shown, count + len(finds.each))
    reasons: list[str | None] = [None] * len(finds.each)
    every = Landmarks.joined(old, finds.landmarks)
    for new, row, distance in _pairs_between(finds.landmarks, old):
        is_one_class = old.classes[row] == finds.landmarks.classes[new]
        if len(boxes[row]) and ((is_one_class and distance < alignment.LEAST_MOVE_SHAPES)
                or relation(views, every, boxes, (row, count + new)) is not Relation.TWO):
            reasons[new] = f'it is {known.map.landmark_ids[row]} in its place'
    return finds.without(reasons, sight)


def _pairs_between(new: Landmarks, old: Landmarks) -> list[tuple[int, int, float]]:
    """Return pairs of a new and an old landmark that overlap, see close_pairs."""
    count = len(new.centers)
    return [(first, second - count, distance) for first, second, distance
            in close_pairs(Landmarks.joined(new, old)) if first < count <= second]
