# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judge each place of a map by a recording, and decide the fate of each landmark.

A place's object is there, gone, or neither is certain. Boxes that no old landmark explains show
new objects, which may hide old places.

Objects of the recording are matched with landmarks of the old map. Every landmark gets at most one
object of its class, and every object at most one landmark, so that the sum of gains is the
greatest possible (Hungarian method). A gain is a log-likelihood ratio of appearance and size, plus
a bonus for an object in the place of the landmark. Pairs without a positive gain are not matched.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import expit

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings, concatenated
from cliploc_ros.core.map.visibility import log_evidence, log_odds_there
from cliploc_ros.offline.mapping.association import associate, find_overlaps
from cliploc_ros.offline.mapping.building import LeftOut, NothingFoundError, build_map, rounded
from cliploc_ros.offline.mapping.doubles import Relation, close_pairs, relation
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, Sight, gather_evidence, look_for
from cliploc_ros.offline.mapping.joint import left_by_poses
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update.alignment import (
    LEAST_MOVE_SHAPES,
    Aligned,
    OldMap,
    Refits,
    has_moved,
    refit,
)
from cliploc_ros.offline.mapping.views import Views

# Range of the factor by which a recording changes all ratios, if its objects are detected more or
# less often than before.
_FACTOR_RANGE = (0.3, 2.0)
_RATIO_RANGE = (0.02, 0.95)
# Least number of landmarks, and of viewpoints of each, to estimate the scatter of the ratios;
# least weight of a usual ratio [views]. Chosen.
_MEDIAN_SQUARE = 0.455  # median of the square of a standard normal variable
_FEW_LANDMARKS, _FEW_VIEWS, _LEAST_WORTH = 5, 3, 0.5
# Share of the objects that are usually still in their place; share of the views in which an object
# is detected, if neither map nor recording give it; share of the views with a false detection in
# an empty place. Chosen, like all values below.
_STAYS, _SEEN_RATIO, _CHANCE_RATIO = 0.9, 0.9, 0.03
# The seen ratio counts as this number of views at most: an object may be hard to see from one
# side.
_PRIOR_VIEWS = 4.0
# An object is gone if its probability of being there is below the first number, or the second one
# if another object was found in its place. It is there if the probability is above the third one.
_GONE_BELOW, _GONE_BELOW_IF_TAKEN, _THERE_ABOVE = 0.05, 0.5, 0.95
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
# Gains, in nats. Chosen: one dissimilar appearance does not outweigh an object in its place, but
# two exchanged ones do; appearance decides whether a new object is a missing one.
_IN_PLACE_GAIN, _NEAR_GAIN, _ELSEWHERE_GAIN = 8.0, 6.0, 4.0
_MAX_LOOK_GAIN = 5.0
# Among similar objects the nearest is chosen: the gain falls with log(1 + distance / length [m]).
_WAY_GAIN, _WAY_M = 1.2, 0.3
# A landmark that is only doubtful has not moved farther than this [m]. Chosen.
_MAX_DOUBTED_MOVE_M = 1.5
# A landmark that was seen in a greater share of the viewpoints has not moved: false detections
# appear in fewer viewpoints. Chosen.
_MOST_SEEN_IF_MOVED = 0.05
# A match is ambiguous if the gain of another landmark is lower by less than this.
_AMBIGUOUS_GAIN = 1.0
# Deviation of the logarithm of an object's size, and the greatest difference. Chosen.
_SIZE_SIGMA, _MAX_SIZE_CHANGE = 0.25, 0.8
# Least number of objects in their places from which to learn the similarity of embeddings.
_FEWEST_LOOKS = 8
# A landmark in its place is doubtful if its similarity is this many deviations below the usual.
_DOUBT = 1.0


class Finds(NamedTuple):
    """The m finds: objects that no old landmark explains in its place."""

    landmarks: Landmarks
    class_ids: tuple[str, ...]
    details: tuple[LandmarkDetails, ...]
    left_out: tuple[LeftOut, ...]  #: Objects not good enough for a map, or old landmarks
    #: Why each find may be a moved landmark, but not a new one; '' if it may be a new one
    weak: tuple[str, ...] = ()

    def without(self, reasons: Sequence[str | None], sight: Sight) -> 'Finds':
        """Return the finds without those that have a reason (m,), which are left out.

        The last entries of sight are those of the finds.
        """
        kept = [row for row, reason in enumerate(reasons) if reason is None]
        own = sight.select(slice(len(sight.seen) - len(reasons), None))
        return Finds(
            self.landmarks.select(np.array(kept, dtype=np.int64)),
            tuple(self.class_ids[row] for row in kept), tuple(self.details[row] for row in kept),
            weak=tuple(self.weak[row] for row in kept), left_out=self.left_out + tuple(
                LeftOut(self.class_ids[row], rounded(self.landmarks.centers[row]),
                        int(own.seen_frames[row]), int(own.seen[row]), reason)
                for row, reason in enumerate(reasons) if reason is not None))


class Judgement(NamedTuple):
    """The evidence from a recording with n boxes for L old landmarks and m finds."""

    #: (n,): the old landmark that each box shows in its place, L + the find, or -1 for none
    shown: NDArray[np.int64]
    finds: Finds
    sight: Sight  #: Of the old places, then of the finds
    is_gone: NDArray[np.bool_]  #: (L,)
    is_there: NDArray[np.bool_]  #: (L,): if neither, the recording is inconclusive
    #: (L,): not proven to be gone, although boxes place it elsewhere, or hardly any show it
    is_doubtful: NDArray[np.bool_]


def judge(detections: PosedDetections, views: Views, known: OldMap, options: MappingOptions
          ) -> Judgement:
    """Judge each place of the map by the recording, and find the other objects that it shows.

    The views have poses in the coordinate frame of the map.
    """
    count = len(known.landmarks.centers)
    finds = _find_new(detections, views, _free(views, known), options)
    # weak finds beside an old landmark would take its boxes
    _, sight = _look(views, known, finds, np.zeros(count, dtype=np.bool_))
    beside = {new for new, _, _ in _pairs_between(finds.landmarks, known.landmarks)}
    finds = finds.without([weak if weak and new in beside else None
                           for new, weak in enumerate(finds.weak)], sight)
    # old landmarks and finds compete for the boxes: an old one may have boxes of a neighbour
    shown, _ = _look(views, known, finds, np.zeros(count, dtype=np.bool_))
    refits = refit(views, known.landmarks, np.where(shown < count, shown, -1),
                   options.min_viewpoints)
    displaced = has_moved(known.landmarks, known.sigmas, refits)
    finds = _with_displaced(finds, refits, displaced, known.map.class_ids)
    shown, sight = _look(views, known, finds, displaced)
    is_gone = displaced | _is_absent(known, sight.select(slice(count)), _GONE_BELOW)
    # a new object may be in the place of an old landmark that still has a false detection
    finds = _without_copies(views, finds, refits.landmarks, known, shown, sight, 1.0)
    _, sight = _look(views, known, finds, is_gone)
    # finds should be seen about as often as the old landmarks, which come first in `sight`
    ratios = sight.seen_ratio[:count][sight.seen[:count] > 0]
    usual = float(np.median(ratios)) if len(ratios) else 1.0
    least = _MIN_NEW_SHARE * usual
    finds = finds._replace(weak=tuple(
        weak if weak or ratio >= least else f'seen in {100 * ratio:.1f} % of the frames that show '
        f'its place, less than {100 * least:.1f} %, {_MIN_NEW_SHARE:g} of the usual rate'
        for weak, ratio in zip(finds.weak, sight.seen_ratio[count:], strict=True)))
    # new objects hide old places
    shown, sight = _look(views, known, finds, is_gone)
    # an old landmark is probably gone if a find with more boxes is in its place
    boxes = np.bincount(shown[shown >= 0], minlength=count + len(finds.details))
    limits = np.full(count, _GONE_BELOW)
    for new, row, _ in _pairs_between(finds.landmarks, known.landmarks):
        if boxes[count + new] > boxes[row]:
            limits[row] = _GONE_BELOW_IF_TAKEN
    is_gone = displaced | _is_absent(known, sight.select(slice(count)), limits)
    shown, sight = _look(views, known, finds, is_gone)
    finds = _without_copies(views, finds, refits.landmarks, known, shown, sight, 0.0)
    # objects that are gone hide nothing
    shown, sight = _look(views, known, finds, is_gone)
    own = sight.select(slice(count))
    is_gone |= _is_absent(known, own, limits)
    shown[np.isin(shown, np.nonzero(is_gone)[0])] = -1
    of_landmarks = np.where(shown < count, shown, -1)
    refits = refit(views, known.landmarks, of_landmarks, options.min_viewpoints)
    fits = gather_evidence(views, refits.landmarks, of_landmarks).median_iou
    is_rare = ((own.seen_ratio < _MIN_SHARE_IN_PLACE * usual) & (own.expected >= LEAST_VIEWS))
    is_there = (~is_gone & ~is_rare & (fits >= MIN_MEDIAN_IOU)
                & (refits.is_known | (_probability_there(known, own) > _THERE_ABOVE)))
    # boxes place it elsewhere, but may not suffice for a find there: then it may not be gone
    is_doubtful = (is_gone & ~_is_absent(known, own, limits)) | (
        ~is_there & ~is_gone & (is_rare | _is_absent(known, own, _STAYS))
        & (known.landmarks.classes >= 0))
    return Judgement(shown, finds, sight, is_gone, is_there, is_doubtful)


def _is_absent(known: OldMap, sight: Sight, limits: NDArray[np.float64] | float
               ) -> NDArray[np.bool_]:
    """Return a mask of the objects (L,) whose probability of being in place is below the limits.

    Classes without a box are excluded: the detector may not know them, or not at these sizes.
    """
    is_told = (known.landmarks.classes >= 0) & (sight.expected >= LEAST_VIEWS)
    seen = sight.seen > 0
    usual = np.median(sight.seen[seen] / sight.expected[seen]) if seen.any() else 0.0
    is_never_seen = ~seen & (usual * sight.expected >= _USUALLY_SEEN)
    return np.asarray(is_told & (is_never_seen | (_probability_there(known, sight) < limits)))


def _probability_there(known: OldMap, sight: Sight) -> NDArray[np.float64]:
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
    ratios = np.clip(ratios, *_RATIO_RANGE)
    # the usual ratios count as few views if this recording scatters about them: a beta variable
    # of mean r and n views has the variance r (1 - r) / (n + 1)
    certainty, rows = _PRIOR_VIEWS, seen & (sight.expected >= _FEW_VIEWS)
    if np.count_nonzero(rows) >= _FEW_LANDMARKS:
        shares, usual = sight.seen[rows] / sight.expected[rows], ratios[rows]
        # the median excludes objects that are gone, which are not scatter
        scatter = np.median(np.square(shares - usual) / (usual * (1.0 - usual))) / _MEDIAN_SQUARE
        certainty = float(np.clip(1.0 / max(float(scatter), 1e-3) - 1.0, _LEAST_WORTH,
                                  _PRIOR_VIEWS))
    there, away = (log_evidence(views * share, views * (1.0 - share), sight.seen,
                                sight.expected - sight.seen)
                   for views, share in ((certainty, ratios), (_PRIOR_VIEWS, _CHANCE_RATIO)))
    return np.asarray(expit(log_odds_there(_STAYS, there, away)))


def _look(views: Views, known: OldMap, finds: Finds, is_gone: NDArray[np.bool_]
          ) -> tuple[NDArray[np.int64], Sight]:
    """Return the old landmark or new find that each box shows, and the sight of all places."""
    places = Landmarks.joined(known.landmarks, finds.landmarks)
    is_solid = np.concatenate([~is_gone, np.ones(len(finds.details), dtype=np.bool_)])
    shown = associate(views, places, among=is_solid)
    return shown, look_for(views, places, shown, is_solid)


def _free(views: Views, known: OldMap) -> NDArray[np.bool_]:
    """Return a mask of the boxes (n,) that may show new objects: no old landmark fits them well.

    Boxes of other classes on a landmark are excluded if it has at least as many boxes of its
    classes: they may be another name for it.
    """
    own = associate(views, known.landmarks, MIN_MEDIAN_IOU)
    nameless = find_overlaps(
        views._replace(classes=np.zeros_like(views.classes)),
        Landmarks(known.landmarks.centers, known.landmarks.bases,
                  np.zeros_like(known.landmarks.classes)), MIN_MEDIAN_IOU)
    others = own[nameless.boxes] < 0
    on, count = nameless.landmarks[others], len(known.sigmas)
    is_named = np.bincount(own[own >= 0], minlength=count) >= np.bincount(on, minlength=count)
    free = own < 0
    free[nameless.boxes[others][is_named[on]]] = False
    return free


def _find_new(detections: PosedDetections, views: Views, is_free: NDArray[np.bool_],
              options: MappingOptions) -> Finds:
    """Return the landmarks that the free boxes show, with the poses of the views."""
    no_finds = Finds(Landmarks.none(), (), (), ())
    if not is_free.any():
        return no_finds
    posed = detections.with_poses(views.poses).select_boxes(is_free)
    try:
        built = build_map(posed, replace(options, pose_errors=None, estimate_pose_errors=False,
                                         refine_mount=False, min_baseline_deg=min(
                                             options.min_baseline_deg, _MIN_MOVED_BASELINE_DEG)))
    except NothingFoundError as error:
        return no_finds._replace(left_out=error.left_out)
    return Finds(landmarks_of_map(built.landmark_map, detections.class_names),
                 built.landmark_map.class_ids, built.landmark_map.details, built.report.left_out,
                 tuple('' if (detail.baseline_deg or 0.0) >= options.min_baseline_deg else
                       f'seen from one side only: {detail.baseline_deg:.1f} degrees, less than '
                       f'{options.min_baseline_deg:g}' for detail in built.landmark_map.details))


def _with_displaced(finds: Finds, refits: Refits, displaced: NDArray[np.bool_],
                    class_ids: Sequence[str]) -> Finds:
    """Add old landmarks that are slightly displaced to the finds, unless they are among them."""
    rows = np.nonzero(displaced)[0]
    again = {moved for moved, _, _ in _pairs_between(refits.landmarks.select(rows),
                                                     finds.landmarks)}
    rows = rows[[moved not in again for moved in range(len(rows))]]
    return finds._replace(
        landmarks=Landmarks.joined(finds.landmarks, refits.landmarks.select(rows)),
        class_ids=finds.class_ids + tuple(class_ids[row] for row in rows.tolist()),
        details=finds.details + (LandmarkDetails(),) * len(rows),
        weak=finds.weak + ('',) * len(rows))


def _without_copies(views: Views, finds: Finds, old: Landmarks, known: OldMap,
                    shown: NDArray[np.int64], sight: Sight, majority: float) -> Finds:
    """Return the finds without those that are an old landmark in its place.

    An old landmark is in its place if it has a box, and at least `majority` boxes for each box of
    the find. A find of its class that lies in it shows the same object. So does any other
    overlapping find, as a part or under another name, unless frames show two objects at once.
    """
    count = len(old.centers)
    boxes = group_boxes(shown, count + len(finds.details))
    reasons: list[str | None] = [None] * len(finds.details)
    every = Landmarks.joined(old, finds.landmarks)
    for new, row, distance in _pairs_between(finds.landmarks, old):
        is_one_class = old.classes[row] == finds.landmarks.classes[new]
        if len(boxes[row]) >= max(1.0, majority * len(boxes[count + new])) and (
                (is_one_class and distance < LEAST_MOVE_SHAPES)
                or relation(views, every, boxes, (row, count + new)) is not Relation.TWO):
            reasons[new] = f'it is {known.map.landmark_ids[row]} in its place'
    return finds.without(reasons, sight)


def _pairs_between(new: Landmarks, old: Landmarks) -> list[tuple[int, int, float]]:
    """Return pairs of a new and an old landmark that overlap, see close_pairs."""
    count = len(new.centers)
    return [(first, second - count, distance) for first, second, distance
            in close_pairs(Landmarks.joined(new, old)) if first < count <= second]


class Shown(NamedTuple):
    """The m objects that the recording shows: old landmarks in their places, and finds."""

    refits: Refits  #: Where they are
    owners: NDArray[np.int64]  #: (m,): the old landmark in whose place it was seen, -1 for none
    #: For each object, the old landmarks that it may be although it is slightly off their place
    near: tuple[frozenset[int], ...]
    shown: NDArray[np.int64]  #: (n,): the object that each box shows, -1 for none
    sight: Sight
    given: tuple[LandmarkDetails, ...]  #: Classes and source of the finds
    weak: tuple[str, ...]  #: See Finds
    class_ids: tuple[str, ...]  #: Of the finds; '' of old landmarks

    @property
    def landmarks(self) -> Landmarks:
        """Return the objects as landmarks."""
        return self.refits.landmarks

    def left_out(self, chosen: NDArray[np.int64]) -> tuple[LeftOut, ...]:
        """Return the weak finds that are not among the chosen objects."""
        return tuple(LeftOut(self.class_ids[row], rounded(self.landmarks.centers[row]),
                             int(self.sight.seen_frames[row]), int(self.sight.seen[row]), weak)
                     for row, weak in enumerate(self.weak) if weak and row not in chosen)


def gather_objects(aligned: Aligned, known: OldMap, judged: Judgement, options: MappingOptions
                   ) -> Shown:
    """Return the objects that the recording shows."""
    views, count, finds = aligned.views, len(known.sigmas), judged.finds
    in_place = np.nonzero(judged.is_there)[0]
    places = np.concatenate([in_place, count + np.arange(len(finds.details))])
    numbers = np.full(count + len(finds.details) + 1, -1, dtype=np.int64)
    numbers[places] = np.arange(len(places))
    shown = numbers[judged.shown]
    landmarks = Landmarks.joined(known.landmarks.select(in_place), finds.landmarks)
    refits = refit(views, landmarks, shown, options.min_viewpoints)
    left_m = left_by_poses(views, np.square(aligned.changes), shown, len(places))
    refits = refits._replace(
        covariances=refits.covariances + np.square(left_m)[:, None, None] * np.eye(3))
    near: list[set[int]] = [set() for _ in places]
    names = known.names
    for new, row, _ in _pairs_between(finds.landmarks, known.landmarks):
        if not judged.is_there[row] and (row, int(finds.landmarks.classes[new])) in names:
            near[len(in_place) + new].add(row)
    return Shown(
        refits, np.concatenate([in_place, np.full(len(finds.details), -1, dtype=np.int64)]),
        tuple(map(frozenset, near)), shown, judged.sight.select(places),
        (LandmarkDetails(),) * len(in_place) + finds.details, ('',) * len(in_place) + finds.weak,
        ('',) * len(in_place) + finds.class_ids)


class Fates(NamedTuple):
    """Rows of L old landmarks, by their fate, and new objects."""

    #: Rows of old landmarks
    confirmed: NDArray[np.int64]
    moved: NDArray[np.int64]
    missing: NDArray[np.int64]
    not_observed: NDArray[np.int64]
    new: NDArray[np.int64]  #: Objects that are not an old landmark
    objects: NDArray[np.int64]  #: (L,): the object that each old landmark is, -1 for none
    rivals: dict[int, tuple[int, ...]]  #: Other old landmarks that an object could be


def decide_fates(known: OldMap, judged: Judgement, objects: Shown, looks: 'Likeness | None'
                 ) -> Fates:
    """Return the fate of each old landmark."""
    numbers, rivals = _identify(known, objects, judged, looks)
    found = numbers >= 0
    elsewhere = found.copy()
    rows = np.nonzero(found)[0]
    elsewhere[rows] = objects.owners[numbers[rows]] != rows
    # an object slightly off its place did not move: it was mapped inaccurately
    rows = np.nonzero(elsewhere)[0]
    elsewhere[rows] = has_moved(known.landmarks.select(rows), known.sigmas[rows],
                                objects.refits.select(numbers[rows]))
    missing = ~found & ((judged.is_gone & ~judged.is_doubtful) | judged.is_there)
    return Fates(
        np.nonzero(found & ~elsewhere)[0], np.nonzero(elsewhere)[0], np.nonzero(missing)[0],
        np.nonzero(~found & ~missing)[0],
        np.setdiff1d([number for number, weak in enumerate(objects.weak) if not weak],
                     numbers[found]), numbers, rivals)


class Likeness(NamedTuple):
    """Embeddings of landmarks and objects by one encoder: unit rows, zero if unknown."""

    landmarks: NDArray[np.float32]  #: (L, d): of the old map
    objects: NDArray[np.float32]  #: (m, d): of the recording

    def similarities(self, rows: NDArray[np.int64], objects: NDArray[np.int64]
                     ) -> NDArray[np.float64]:
        """Return cosines (k, j) of landmarks and objects; NaN if one is unknown."""
        first, second = self.landmarks[rows], self.objects[objects]
        cosines = (first @ second.T).astype(np.float64)
        cosines[~first.any(axis=1)] = np.nan
        cosines[:, ~second.any(axis=1)] = np.nan
        return cosines


def why_not_comparable(old: LandmarkEmbeddings | None, detections: PosedDetections) -> str:
    """Return why the embeddings of a map and a recording cannot be compared; '' if they can."""
    if old is None:
        return 'the map has no image embeddings'
    if detections.embeddings is None or not detections.encoder_key:
        return 'the recording has no embeddings that name their encoder; record it with CLIP'
    if old.encoder_key != detections.encoder_key:
        return f"the map's encoder is {old.encoder_key}, the recording's {detections.encoder_key}"
    if old.means.shape[1] != detections.embeddings.shape[1]:
        return 'the embeddings of map and recording differ in length'
    return ''


def compare_looks(old: LandmarkEmbeddings, landmark_ids: Sequence[str],
                  detections: PosedDetections, objects: Shown) -> Likeness:
    """Return the embeddings of the old landmarks, by their ids, and of the recording's objects."""
    of_objects = embed_landmarks([str(number) for number in range(len(objects.owners))],
                                 detections, objects.shown)
    return Likeness(old.in_order(landmark_ids).means.astype(np.float32),
                    of_objects.means.astype(np.float32))


def renew_embeddings(old: LandmarkEmbeddings | None, landmark_ids: Sequence[str],
                     detections: PosedDetections, shown: NDArray[np.int64]
                     ) -> LandmarkEmbeddings | None:
    """Return the embeddings of the new map: old ones if known, otherwise the recording's.

    The ids are those of the new map; shown (n,) is the row in it that each box shows, -1 for none.
    """
    kept = None if old is None else old.in_order(landmark_ids)
    if detections.embeddings is None or not detections.encoder_key:
        return kept
    seen = embed_landmarks(landmark_ids, detections, shown)
    if kept is None:
        return seen
    if why_not_comparable(kept, detections):
        return kept
    known = dict(zip(landmark_ids, kept.is_known.tolist(), strict=True))
    parts = [embeddings.in_order([name for name in landmark_ids if known[name] == is_known])
             for embeddings, is_known in ((kept, True), (seen, False))]
    return concatenated(parts, parts[0].landmark_ids + parts[1].landmark_ids).in_order(
        landmark_ids)


class _LookModel(NamedTuple):
    """Cosines of two embeddings of one object, and of two objects of one class."""

    own: float
    other: float
    sigma: float

    def gains(self, cosines: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = 0.5 * (self.own + self.other)
        gains = (self.own - self.other) * (cosines - middle) / self.sigma ** 2
        return np.nan_to_num(np.clip(gains, -_MAX_LOOK_GAIN, _MAX_LOOK_GAIN), nan=0.0)


def _identify(known: OldMap, objects: Shown, judged: Judgement, looks: Likeness | None
              ) -> tuple[NDArray[np.int64], dict[int, tuple[int, ...]]]:
    """Return the object (L,) that each old landmark is, -1 for none, and the rivals of objects.

    A landmark that is gone may be any new object, and a doubtful one may be a nearby object. Any
    other landmark can only be the object in its place or near it.
    """
    held = np.nonzero(objects.owners >= 0)[0]
    owners = objects.owners[held]
    result = np.full(len(known.sigmas), -1, dtype=np.int64)
    result[owners] = held
    groups = _class_groups(known, objects)
    model = None if looks is None else _learn_looks(objects, looks, groups)
    doubtful = np.zeros(len(held), dtype=np.bool_)
    if looks is not None and model is not None:
        pairs = looks.landmarks[owners], looks.objects[held]
        cosines = np.einsum('ld,ld->l', *pairs).astype(np.float64)
        doubtful = (pairs[0].any(axis=1) & pairs[1].any(axis=1)
                    & (cosines < model.own - _DOUBT * model.sigma))
    own = judged.sight.select(slice(len(known.sigmas)))
    searched = (judged.is_gone | judged.is_doubtful) & (
        own.seen <= _MOST_SEEN_IF_MOVED * own.expected)
    searched[[row for rows in objects.near for row in rows]] = True
    searched[owners] = doubtful
    offered = objects.owners < 0
    offered[held] = doubtful
    rivals: dict[int, tuple[int, ...]] = {}
    of_landmarks = np.where(known.landmarks.classes >= 0, groups[known.landmarks.classes], -1)
    of_objects = groups[objects.landmarks.classes]
    for group in np.unique(of_objects[offered]):
        rows = np.nonzero(searched & (of_landmarks == group))[0]
        columns = np.nonzero(offered & (of_objects == group))[0]
        if len(rows) and len(columns):
            gains = _gains(known, objects, judged, rows, columns)
            if looks is not None and model is not None:
                gains += model.gains(looks.similarities(rows, columns))
            result[rows], close = _assign(gains, rows, columns)
            rivals |= close
    return result, rivals


def _class_groups(known: OldMap, objects: Shown) -> NDArray[np.int64]:
    """Return a group for each class; all classes of a landmark are in one group."""
    count = 1 + max(int(landmarks.names[:, 1].max(initial=0))
                    for landmarks in (objects.landmarks, known.landmarks))
    rows, classes = known.landmarks.names.T
    main = known.landmarks.classes[rows]
    links = coo_matrix((np.ones(len(main)), (main, classes)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _learn_looks(objects: Shown, looks: Likeness, groups: NDArray[np.int64]) -> _LookModel | None:
    """Learn the cosines of embeddings from the landmarks in their place; None if too few."""
    held = np.nonzero(objects.owners >= 0)[0]
    own, other = [np.empty(0)], [np.empty(0)]
    classes = groups[objects.landmarks.classes[held]]
    for group in np.unique(classes):
        columns = held[classes == group]
        cosines = looks.similarities(objects.owners[columns], columns)
        is_own = np.eye(len(columns), dtype=np.bool_)
        own.append(cosines[is_own])
        other.append(cosines[~is_own])
    same, different = (values[np.isfinite(values)] for values in map(np.concatenate, (own, other)))
    if len(same) < _FEWEST_LOOKS or len(different) < _FEWEST_LOOKS:
        return None
    middle, elsewhere = float(np.median(same)), float(np.median(different))
    if middle <= elsewhere:
        return None  # embeddings cannot distinguish objects here
    spreads = [1.4826 * float(np.median(np.abs(values - center)))
               for values, center in ((same, middle), (different, elsewhere))]
    return _LookModel(middle, elsewhere, max(*spreads, 1e-3))


def _gains(known: OldMap, objects: Shown, judged: Judgement, rows: NDArray[np.int64],
           columns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the gains (k, j) by place, class, size and distance; -inf for impossible pairs."""
    sizes = [np.log(np.sort(np.linalg.norm(landmarks.bases, axis=1), axis=1)[:, 1:]).mean(axis=1)
             for landmarks in (known.landmarks.select(rows), objects.landmarks.select(columns))]
    change = np.abs(sizes[0][:, None] - sizes[1][None])
    ways_m = np.linalg.norm(known.landmarks.centers[rows][:, None]
                            - objects.landmarks.centers[columns][None], axis=2)
    gains = (_ELSEWHERE_GAIN - 0.5 * np.square(change / _SIZE_SIGMA)
             - _WAY_GAIN * np.log1p(ways_m / _WAY_M))
    names = known.names
    for place, row in enumerate(rows):
        for column, number in enumerate(columns):
            if objects.owners[number] == row:
                gains[place, column] = _IN_PLACE_GAIN
            elif int(row) in objects.near[number]:
                gains[place, column] += _NEAR_GAIN - _ELSEWHERE_GAIN
            elif (change[place, column] > _MAX_SIZE_CHANGE
                  or not (judged.is_gone[row] or row in objects.owners
                          or (judged.is_doubtful[row]
                              and ways_m[place, column] < _MAX_DOUBTED_MOVE_M))
                  or (int(row), int(objects.landmarks.classes[number])) not in names):
                gains[place, column] = -np.inf
    return gains


def _assign(gains: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64]
            ) -> tuple[NDArray[np.int64], dict[int, tuple[int, ...]]]:
    """Return the object of each row, -1 for none, and the rivals of the rows."""
    useful = np.maximum(np.nan_to_num(gains, neginf=0.0), 0.0)
    chosen = np.full(len(rows), -1, dtype=np.int64)
    rivals = {}
    for place, column in zip(*linear_sum_assignment(useful, maximize=True), strict=True):
        if useful[place, column] <= 0.0:
            continue
        chosen[place] = columns[column]
        close = gains[:, column] > gains[place, column] - _AMBIGUOUS_GAIN
        close[place] = False
        if close.any():
            rivals[int(columns[column])] = tuple(int(row) for row in rows[close])
    return chosen, rivals
